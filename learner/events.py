"""What happens among the workers, for the log and for whoever decides whether the run can go on. Plain data."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Joined:
    """A worker joined."""

    worker: str
    host: str
    pid: int


@dataclass(frozen=True)
class Left:
    """A worker is gone; `tickets` of its tickets are dealt again."""

    worker: str
    why: str
    tickets: int
    on_purpose: bool


@dataclass(frozen=True)
class Turned:
    """A worker was refused."""

    worker: str
    why: str


@dataclass(frozen=True)
class Broke:
    """A worker's environment raised."""

    worker: str
    host: str
    lane: int | None
    error: str
    traceback: str


Event = Joined | Left | Turned | Broke
