"""How a check is written: a generator that sends messages and waits for events. Pure: no socket, process or clock.

A check yields a `Wait` and gets the event that it waited for, or None when the time is over. It raises `Broken` if the
client breaks a rule, and `Skipped` if there is nothing to check with this client. It acts through a `Learner`.
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
    """There was nothing to check. The text says why."""


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
    """LearnerEffect: close the socket, which drops every connection and all queued messages."""


@dataclass(frozen=True)
class Listen:
    """LearnerEffect: open the socket again, at the same address."""


LearnerEffect = SendFrames | StartClient | AskToStop | EndClient | CutConnection | Listen

# -------------------------------------------------------------------------------------------------------------- events


@dataclass(frozen=True)
class Heard:
    """ClientEvent: a message arrived, which may be unreadable."""

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
    """A `Wait.wanted` that accepts no event, so the wait lasts for its whole time."""
    return False


@dataclass(frozen=True)
class Wait:
    """Wait until `wanted` returns True for an event, for at most `for_s` seconds."""

    for_s: float
    wanted: Callable[[ClientEvent], bool] = nothing


Script = Generator[Wait, ClientEvent | None, T]
"""The type of a check, or of a part of one: a generator that yields waits and returns a value of type T."""


def brief(message: Any) -> str:
    """A message in a few words: its type, and its most important fields."""
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
