"""Events in the life of workers. The log shows them, and the hub uses them to decide if the run continues. Plain data.

`json_name` is the `event` field of a line written by `--log-json`. Programs read these names, so they must not change. An
event without such a name isn't logged as an event.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from millrace.protocol.bounds import MAX_LINE, indented, one_line
from millrace.protocol.errors import EnvironmentFailed, PolicyFailed, joined


@dataclass(frozen=True)
class WorkerJoined:
    """A worker joined."""

    json_name: ClassVar[str] = "joined"
    worker: str
    host: str
    pid: int


@dataclass(frozen=True)
class WorkerLeft:
    """A worker is no longer a member. `tickets` is the number of its tickets, which are dealt again."""

    json_name: ClassVar[str] = "left"
    worker: str
    why: str
    tickets: int
    on_purpose: bool


@dataclass(frozen=True)
class WorkerRefused:
    """A worker was refused, and is no longer a member.

    If it was a member, `tickets` is the number of its tickets, which are dealt again.
    """

    json_name: ClassVar[str] = "refused"
    worker: str
    why: str
    tickets: int = 0


@dataclass(frozen=True)
class NamelessHello:
    """A Hello arrived over a connection without a routing id, and was refused.

    This is usually harmless: a worker that reconnected, or its successor with the same name, has taken over the routing id,
    and the Hello is left over from the older connection. A client that never sets a routing id learns so from the refusal.
    """

    json_name: ClassVar[str] = "nameless_hello"
    worker: str
    why: str


@dataclass(frozen=True)
class Failed:
    """A worker failed in user-written code. It may come back. Every such event is an instance of a subclass below."""

    json_name: ClassVar[str]
    raised_as: ClassVar[type[EnvironmentFailed | PolicyFailed]] = EnvironmentFailed
    """The class of the error that `exception` makes."""
    worker: str
    host: str
    error: str
    """The error as one line, including the lane if there is one."""
    traceback: str = ""
    lanes: tuple[int, ...] = ()
    """The lane that failed if it is known; otherwise all lanes that the worker held."""
    worked_s: float | None = None
    """Seconds from the worker's first env step to the failure; None if no env step of its process is known."""
    spare: bool = False
    """Whether the run didn't need the worker, because every lane had another worker. Such a failure doesn't count."""

    @property
    def line(self) -> str:
        """Who failed, and how."""
        return f"worker {self.worker} ({self.host}): {self.error}"

    def exception(self, why: str = "") -> EnvironmentFailed | PolicyFailed:
        """The error to raise for this failure. `why` says why this failure ends the run."""
        return self.raised_as(joined(self.line, why), self.traceback)


@dataclass(frozen=True)
class EnvironmentRaised(Failed):
    """A worker's environment raised an exception."""

    json_name: ClassVar[str] = "environment_raised"


@dataclass(frozen=True)
class PolicyRaised(Failed):
    """In a worker, a user-written policy raised an exception, returned an unusable result, crashed the process, or did not
    return in time.
    """

    json_name: ClassVar[str] = "policy_raised"
    raised_as: ClassVar[type[EnvironmentFailed | PolicyFailed]] = PolicyFailed


@dataclass(frozen=True)
class WorkerProcessFailed(Failed):
    """A worker's process ended unannounced. This counts as if its environment had raised an exception."""

    json_name: ClassVar[str] = "process_failed"


@dataclass(frozen=True)
class WorkerStartFailed:
    """A worker process that this program started ended by itself before the worker joined."""

    json_name: ClassVar[str] = "not_started"
    worker: str
    why: str
    last_lines: str = ""
    """The last lines of its output."""


@dataclass(frozen=True)
class WorkerToldToRejoin:
    """A worker was told to join again because its session had ended.

    Its message carried `late` transitions, which are counted but not used.
    """

    json_name: ClassVar[str] = "asked_to_rejoin"
    worker: str
    session: int
    late: int


@dataclass(frozen=True)
class EnvironmentNoted:
    """A worker has noticed something about its environment that the user should know."""

    json_name: ClassVar[str] = "environment_noted"
    worker: str
    note: str


@dataclass(frozen=True)
class LaneContinued:
    """The worker continues a lane that another worker had."""

    json_name: ClassVar[str] = "lane_continued"
    worker: str
    lane: int
    repeated_steps: int
    """The number of env steps that are replayed before the lane continues."""
    new_episodes: int
    """How many of its env copies begin new episodes instead."""
    longest: int = 0
    """The length, in steps, of the longest episode that is abandoned because it exceeds `--replay-limit`; 0 if none is."""


@dataclass(frozen=True)
class RolloutRejected:
    """A member sent a rollout that cannot be used."""

    peer: bytes
    """Routing id of the worker."""
    why: str


@dataclass(frozen=True)
class RolloutArrived:
    """A rollout has arrived and was accepted."""

    worker: str
    lane: int
    version: int


@dataclass(frozen=True)
class EpisodesArrived:
    """Episodes of an evaluation have arrived and were accepted."""

    worker: str


LoggedEvent = (
    WorkerJoined
    | WorkerLeft
    | WorkerRefused
    | WorkerStartFailed
    | NamelessHello
    | Failed
    | WorkerToldToRejoin
    | EnvironmentNoted
    | LaneContinued
)
Event = LoggedEvent | RolloutRejected | RolloutArrived | EpisodesArrived


def as_extra(event: LoggedEvent) -> dict[str, Any]:
    """The attributes of a log record that describes the event.

    They are plain data, because other programs' formatters write all attributes of a record as JSON.
    """
    return {"event": event.json_name, "event_fields": asdict(event)}


def describe(event: LoggedEvent) -> str:
    """The text of an event for the log: one line, then the traceback or the last lines of output, if there are any.

    The lines after the first are indented, so that none of them looks like a log line of its own. Control characters in a
    peer's strings are replaced.
    """
    line = one_line(_line(event), 4 * MAX_LINE)
    match event:
        case Failed(traceback=below) | WorkerStartFailed(last_lines=below) if below:
            return f"{line}\n{indented(below)}"
        case _:
            return line


def _line(event: LoggedEvent) -> str:
    match event:
        case WorkerJoined(worker, host, pid):
            return f"worker {worker} ({host}, pid {pid}) joined"
        case WorkerLeft(worker, why, tickets):
            return f"worker {worker} {why}{_dealt_again(tickets)}"
        case WorkerRefused(worker, why, tickets):
            return f"worker {worker} was refused: {why}{_dealt_again(tickets)}"
        case NamelessHello(worker, why):
            return (
                f"worker {worker} said Hello over a connection without a routing id: this is harmless if it has connected "
                f"again; a client that never sets one is refused: {why}"
            )
        case WorkerProcessFailed(spare=False):
            return joined(event.line, "this counts as a failure of the environment")
        case Failed():
            return event.line
        case WorkerStartFailed(worker, why):
            return f"worker {worker} {why}"
        case WorkerToldToRejoin(worker, _, late):
            counted = f"; {late} transitions that it sent are counted, not used" if late else ""
            return f"worker {worker} was told to join again: its session had ended{counted}"
        case EnvironmentNoted(worker, note):
            return f"worker {worker}: {note}"
        case LaneContinued(worker, lane, repeated, new, longest):
            parts = [f"{repeated:,} env steps are replayed first"] if repeated or not new else []
            if new:
                parts.append(f"{new:,} env {'copies begin new episodes' if new > 1 else 'copy begins a new episode'}")
            why = f"; the longest one has {longest:,} steps, more than --replay-limit allows" if longest else ""
            return f"lane {lane} continues on worker {worker}: {', and '.join(parts)}{why}"


def _dealt_again(tickets: int) -> str:
    return f"; {tickets} of its tickets are dealt again" if tickets else ""
