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


@dataclass(frozen=True)
class Told:
    """A worker was told to join again: its session had ended. `late` transitions that it sent are counted, not used."""

    worker: str
    session: int
    late: int


@dataclass(frozen=True)
class Stale:
    """A rollout was dropped because it was acted on under weights older than max_lag allows."""

    lane: int
    lag: int
    transitions: int


Event = Joined | Left | Turned | Broke | Told | Stale
