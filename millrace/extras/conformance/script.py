"""How a check is written: a generator that sends messages and waits for events. Pure: no socket, process or clock.

A check yields a `Wait` and gets the event that it waited for, or None when the time is over. It raises `Broken` if a rule is
broken, and `Skipped` if this client gives it nothing to look at. `Learner` is the learner that it plays.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from millrace.protocol.errors import BadMessage
from millrace.protocol.messages import Inquire, ToLearner
from millrace.protocol.rules import Rule
from millrace.protocol.wire.codec import Buffer

T = TypeVar("T")


class Broken(Exception):
    """The client broke a rule."""

    def __init__(self, rule: Rule, expected: str, got: str) -> None:
        super().__init__(f"{rule.words.text}: expected {expected}, got {got}")
        self.rule = rule
        self.expected = expected
        self.got = got


class Skipped(Exception):
    """The check found nothing to look at. The text says why."""


# ------------------------------------------------------------------------------------------------------------- effects


@dataclass(frozen=True)
class SendFrames:
    """LearnerEffect: send these frames to this peer."""

    peer: bytes
    frames: Sequence[Buffer]


@dataclass(frozen=True)
class StartClient:
    """LearnerEffect: start the client's process."""


@dataclass(frozen=True)
class AskToStop:
    """LearnerEffect: send SIGTERM to the client."""


@dataclass(frozen=True)
class EndClient:
    """LearnerEffect: end the client, whatever it does."""


@dataclass(frozen=True)
class CutConnection:
    """LearnerEffect: close the socket; with it every connection, and what is queued."""


@dataclass(frozen=True)
class Listen:
    """LearnerEffect: open the socket again, at the same address."""


LearnerEffect = SendFrames | StartClient | AskToStop | EndClient | CutConnection | Listen

# -------------------------------------------------------------------------------------------------------------- events


@dataclass(frozen=True)
class Heard:
    """ClientEvent: a message arrived, or one that cannot be read."""

    peer: bytes
    message: ToLearner | Inquire | BadMessage


@dataclass(frozen=True)
class Ended:
    """ClientEvent: the client's process has ended."""

    code: int
    """exit code; below 0: the number of the signal"""
    last_line: str
    """the last line that it printed"""

    def __str__(self) -> str:
        return f"its end with exit code {self.code}" + (f"; it printed: {self.last_line}" if self.last_line else "")


ClientEvent = Heard | Ended


def nothing(event: ClientEvent) -> bool:
    """Wait for no event, only for the time."""
    return False


@dataclass(frozen=True)
class Wait:
    """Wait until `wanted` says yes to an event, at most `for_s`."""

    for_s: float
    wanted: Callable[[ClientEvent], bool] = nothing


Script = Generator[Wait, ClientEvent | None, T]
"""What a part of a check is: it yields waits and returns a value."""


def brief(message: Any) -> str:
    """A message in a few words: its type and its numbers."""
    if isinstance(message, BadMessage):
        return f"an unreadable message ({message})"
    shown = [
        f"{name} {value!r}"
        for name in (
            "session",
            "attempt",
            "ticket",
            "lane",
            "incarnation",
            "version",
            "sequence",
            "replies",
            "reason",
            "error",
        )
        if (value := getattr(message, name, None)) is not None and value != ""
    ]
    return f"{type(message).__name__}({', '.join(shown)})"
