"""What the model knows of the two halves of a conversation: tuples in, tuples out.

Rule: `World` has the network, time and the faults; a `Conversation` has what stands at the two ends, which is the program's
own code. Each end is one nested tuple; so is each message. Equal tuples are equal states.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

Content = tuple[Any, ...]
Event = tuple[Any, ...]
"""What happens to an end: its kind, and more of it."""


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
    working: bool = False
    rejoins: bool = False
    """whether the worker looks for its learner again"""

    @property
    def awake(self) -> bool:
        """Whether the worker can do something."""
        return self.alive and not self.frozen


class Conversation(Protocol):
    """The two ends. Each method raises what the program, or a rule of safety, raises."""

    @property
    def faults(self) -> int:
        """Number of faults, at any moments."""
        ...

    @property
    def only(self) -> tuple[str, ...]:
        """Kinds of faults; empty: all."""
        ...

    @property
    def few_losses(self) -> bool:
        """Whether all that can go wrong is so little that no worker may be given up, or give up."""
        ...

    def start(self) -> tuple[Content, list[Content]]:
        """A learner that has started, and each worker, none of which has."""
        ...

    def learner(self, content: Content, event: Event, message: Content | None) -> tuple[Content, list[tuple[int, Content]]]:
        """The learner after this event, and what it sends to which worker. `message`: what is received, if anything.

        Events: ("receive", worker, …), ("publish",), ("time",), ("revoke", worker), ("ended", worker, nonce),
        ("restart", version).
        """
        ...

    def worker(self, content: Content, number: int, event: Event, message: Content | None) -> tuple[Content, list[Content]]:
        """The worker after this event, and what it sends. `message`: what it handles, if anything.

        Events: ("handle", …), ("start",), ("finish",), ("time",), ("told",), ("end",), ("shut out",), ("freeze",),
        ("thaw",).
        """
        ...

    def is_needed(self, worker: Content) -> bool:
        """Whether the run cannot reach its target without this worker."""
        ...

    def without_checkpoints(self, learner: Content) -> Content:
        """A learner that will not restart."""
        ...

    def facts(self, content: Content) -> Facts:
        """The facts of a learner, a worker, or a message (which has none)."""
        ...
