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


def describe(event: Event) -> str:
    """One line for the log."""
    match event:
        case Joined(worker, host, pid):
            return f"worker {worker} ({host}, pid {pid}) joined"
        case Left(worker, why, tickets):
            return f"worker {worker} {why}" + (f"; {tickets} of its tickets are dealt again" if tickets else "")
        case Turned(worker, why):
            return f"worker {worker} was refused: {why}"
        case Broke(worker, host, lane, error, traceback):
            return f"worker {worker} ({host}): lane {lane}: {error}\n{traceback}"
        case Told(worker, _, late):
            counted = f"; {late} transitions that it sent are counted, not used" if late else ""
            return f"worker {worker} was told to join again: its session had ended{counted}"
        case Stale(lane, lag, transitions):
            return f"a rollout of lane {lane} was dropped: {lag} versions old, {transitions} transitions"
