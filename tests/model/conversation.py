"""What the model knows of the two halves of a conversation: tuples in, tuples out.

Rule: `World` has the network, time and the faults; a `Conversation` has what stands at the two ends, which is the program's
own code. Each end is one nested tuple; so is each message. Equal tuples are equal states.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

Content = tuple[Any, ...]
Action = tuple[Any, ...]
"""What happens, and to which worker or version."""


class Facts(NamedTuple):
    """What decides which actions are possible, of a learner or a worker."""

    reached: bool = False
    """whether the learner has reached its target"""
    updating: bool = False
    """whether the learner can go on by itself: the action `publish`"""
    checkpoints: int = 0
    members: tuple[int, ...] = ()
    """in the order in which they joined"""
    nonce: int = 0
    """of the worker's process"""
    alive: bool = False
    frozen: bool = False
    shut_out: bool = False
    cut_off: bool = False
    working: bool = False
    rejoins: bool = False
    """whether the worker looks for its learner again"""


class Conversation(Protocol):
    """The two ends. Each method raises what the program, or a rule of safety, raises."""

    @property
    def workers(self) -> int:
        """Number of workers."""
        ...

    @property
    def faults(self) -> int:
        """Number of faults, of any kinds, at any moments."""
        ...

    def start(self) -> tuple[Content, list[Content]]:
        """A learner that has started, and each worker, none of which has."""
        ...

    def learner(self, content: Content, event: Action, message: Content | None) -> tuple[Content, list[tuple[int, Content]]]:
        """The learner after this event, and what it sends to which worker. `message`: what is received, if anything.

        Events: ("receive", worker, …), ("publish",), ("time",), ("revoke", worker), ("ended", worker, nonce),
        ("restart", version).
        """
        ...

    def worker(self, content: Content, number: int, event: Action, message: Content | None) -> tuple[Content, list[Content]]:
        """The worker after this event, and what it sends. `message`: what it handles, if anything.

        Events: ("handle", …), ("start",), ("finish",), ("time",), ("told",), ("end",), ("dead for ever",),
        ("cut off for ever",), ("shut out",), ("freeze",), ("thaw",).
        """
        ...

    def facts(self, content: Content) -> Facts:
        """The facts of a learner, a worker, or a message (which has none)."""
        ...
