"""The server through which every learner exchanges messages with its workers. A shell around link, clock and log.

Rule: the inbox is emptied before silent workers are removed, and a learner that was away listens for a while first. A
healthy worker therefore never loses its membership because the learner was busy with a long update or was suspended.

Rule: peers that never stop sending take only a limited share of the learner's time. Each turn of listening has a time limit;
nobody is left out, because ZeroMQ reads its connections in turn. New sessions are limited for each key, and so is the time
spent on answers to `Inquire`.
"""

from __future__ import annotations

import logging
import math
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import msgspec

from millrace.learner.members.coordinator import Coordinator
from millrace.learner.members.events import (
    EnvironmentRaised,
    EpisodesArrived,
    Event,
    Failed,
    LaneContinued,
    LoggedEvent,
    NamelessHello,
    PolicyRaised,
    RolloutArrived,
    RolloutRejected,
    WorkerJoined,
    WorkerLeft,
    WorkerRefused,
    WorkerStartFailed,
    WorkerToldToRejoin,
    describe,
)
from millrace.learner.members.held_up import what_they_do
from millrace.learner.members.join_limiter import JoinLimiter
from millrace.learner.members.key_revocation import KeyRevocation
from millrace.learner.members.member_log import MemberLog
from millrace.learner.members.membership import Membership, Outgoing
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.protocol.address import advertised_address, name_for_people
from millrace.protocol.bounds import one_line
from millrace.protocol.errors import BadMessage, CannotUnpack, NoWorkers
from millrace.protocol.logs.long_wait import LongWait
from millrace.protocol.messages import Hello, Inquire, Refuse, Status, ToLearner, ToWorker, Weights
from millrace.protocol.wire.codec import Buffer, encode
from millrace.protocol.wire.learner_link import LearnerLink, RefusedMessage

log = logging.getLogger("millrace.learner")

ASK_PROCESSES_S = 0.25  # interval at which to ask what the workers that this program started are doing
AWAY_S = 0.5  # a learner that has not listened for longer was away: it was busy, or its process was suspended
TURN_S = 0.2  # longest time for reading messages before the caller continues
SHORT_TURN_S = 0.003  # least time for reading messages in a turn, however short the turn is
FAIR_SHARE = 10_000  # number of messages after which every connection has been read, because ZeroMQ reads them in turn
LAST_MESSAGES_WAIT_S = 0.1  # how long to wait for the last messages of an ended process, which may still be on their way
LAST_MESSAGES_TURNS = 10  # limit on the number of such waits, because other workers keep sending
STATUS_SHARE = 20  # answers to Inquire take at most 1 / STATUS_SHARE of the time


class ServedHub(Protocol):
    """The owner of a server. The server reports each event to it."""

    def status(self, now: float) -> Status:
        """The answer to `millrace status`."""

    def happened(self, event: Event) -> None:
        """Called with each event after it was logged."""

    def sent(self, peer: bytes) -> None:
        """Called after each message that was sent. `peer` is its receiver."""


@dataclass(frozen=True)
class ServerSettings:
    """The settings in which the servers of different hubs differ."""

    grace_s: float = AWAY_S
    """For this many seconds after the learner was away, no worker is removed as silent."""
    log_tracebacks: bool = True
    """Whether to log tracebacks from environments. False if the hub raises them as exceptions."""
    log_joins: bool = True
    """Whether to log that a worker joined. False in the lobby, because the worker joins the run shortly after."""


class MemberServer:
    """Exchanges messages with the members. Removes those that are silent, have ended, or had their key revoked."""

    def __init__(
        self,
        link: LearnerLink,
        coordinator: Coordinator,
        hub: ServedHub,
        processes: WorkerProcesses,
        settings: ServerSettings | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`processes` are the worker processes that this program started."""
        self.listened_s = clock()
        """Time at which the server last listened."""
        self._link = link
        self._coordinator = coordinator
        self._hub = hub
        self._processes = processes
        self._membership = coordinator.membership
        self._settings = settings or ServerSettings()
        self._clock = clock
        self._keys = KeyRevocation(link)
        self.member_log = MemberLog(link, clock)
        """the rate-limited log about members"""
        self._remove_silent_from_s = self.listened_s
        self._ask_processes_s = self.listened_s
        self._no_members_since_s = math.inf
        self._describing_until_s = -math.inf  # until then, `wait_for` also waits for workers that describe the environment
        self._last_turned_away = ""  # why the last worker that left unexpectedly, or was refused, is gone
        self._encoded: tuple[ToWorker, Sequence[Buffer]] | None = None
        self._joins = JoinLimiter()
        self._read_since_empty = 0  # number of messages read since the inbox was last empty
        self._status: tuple[float, Sequence[Buffer]] = (-math.inf, ())  # time until which it is fresh, and its frames
        self.unexpected_errors = 0
        """number of errors in this program that peers' messages caused; each cost only the sender its membership"""

    def listen(self, timeout_s: float, short: bool = False) -> None:
        """Wait at most `timeout_s` for messages, answer them, and remove the members that are gone.

        If `short`, it answers messages for no longer than the caller has worked since the last call; the rest wait.
        """
        worked_s = self._clock() - self.listened_s
        self.receive(timeout_s, min(TURN_S, max(SHORT_TURN_S, worked_s)) if short else TURN_S)
        self._revoke_keys()
        self._remove_ended_processes(LAST_MESSAGES_WAIT_S)
        now = self._clock()
        self._record_activities(now)
        if now - self.listened_s > timeout_s + AWAY_S:
            # Messages that were sent meanwhile may still be in the kernel, because ZeroMQ's thread may have been suspended
            # together with this process.
            self._remove_silent_from_s = now + self._settings.grace_s
        self.listened_s = now
        if now >= self._remove_silent_from_s and (not self._read_since_empty or self._read_since_empty >= FAIR_SHARE):
            self._read_since_empty = 0
            self.send(self._coordinator.remove_silent(now))

    def receive(self, timeout_s: float, turn_s: float = TURN_S) -> None:
        """Wait at most `timeout_s` for messages, and answer those that have arrived, for about `turn_s` at most."""
        if not self._link.poll(timeout_s):
            self._read_since_empty = 0
            return
        until_s = self._clock() + turn_s
        for peer, message in self._link.receive():
            self._read_since_empty += 1
            now = self._clock()
            self.send(self._answer(peer, message, now), peer)
            if now > until_s:
                return
        self._read_since_empty = 0

    def send(self, messages: Sequence[Outgoing], cause: bytes | None = None) -> None:
        """Send these messages, then log the new events. `cause` is the peer whose message caused them, if any."""
        for peer, message in messages:
            self._link.send(peer, self._frames(message))  # if it fails, the worker will soon be removed as silent
            self._hub.sent(peer)
        if self._membership.events:
            self._log_events(cause)

    def take_over(self, waiting: Membership, described_in_s: float) -> None:
        """Begin the run for the workers waiting for it. `described_in_s`: how long the environment's description took.

        If the description took long, other workers may still be describing the environment. `wait_for` waits for them until
        `described_in_s` more seconds have passed, which is enough for a worker that doesn't hang. If the run began without
        such a worker, other workers would have to open its lanes, one after another.
        """
        now = self._clock()
        self._describing_until_s = now + described_in_s
        self.send(self._coordinator.take_over(waiting, now))

    def wait_for(self, workers: int, timeout_s: float, turn: Callable[[], None]) -> None:
        """Call `turn`, which must listen, until this many `workers` have joined, and none still describes the environment.

        Raises `NoWorkers` after `timeout_s`, or at once if that many can no longer join. Workers that only evaluate don't
        count. For how long it waits for descriptions, see `take_over`.
        """
        deadline_s = self._clock() + timeout_s
        wait = LongWait(self._clock())
        while True:
            now = self._clock()
            collectors = self._membership.collectors()
            joined = len(collectors)
            if joined < workers:
                self.check_left(workers, collecting=True)
                if now > deadline_s:
                    raise self.no_workers(workers, timeout_s)
            elif now >= self._describing_until_s or not any(member.describes for member in collectors):
                return
            if wait.due(now):
                told = self.what_workers_do()
                log.warning(
                    "no env steps for %.0f s, %d of %d workers have joined: %s", wait.seconds(now), joined, workers, told
                )
            turn()

    def check_members(self, timeout_s: float, *, collecting: bool = False) -> None:
        """Raise `NoWorkers` if there has been no worker for `timeout_s`, or at once if no worker can join any more.

        Call this after each turn of a wait. If `collecting`, workers that only evaluate don't count.
        """
        now = self._clock()
        if any(not (collecting and member.hello.evaluates) for member in self._membership.members.values()):
            self._no_members_since_s = math.inf
            return
        self.check_left(1, collecting=collecting)
        self._no_members_since_s = min(self._no_members_since_s, now)
        if now - self._no_members_since_s > timeout_s:
            raise self.no_workers(1, timeout_s)

    def check_left(self, workers: int, *, collecting: bool) -> None:
        """Raise `NoWorkers` if this program started all workers, no others can join, and fewer than `workers` are left."""
        left = self._processes.left(collecting=collecting)
        if left >= workers:
            return
        why = f": the last one {self._last_turned_away}" if self._last_turned_away else ""
        if workers == 1:
            raise NoWorkers(f"no worker is left, and none will be started again{why}")
        raise NoWorkers(f"waited for {workers} workers (--min-workers), and only {left:g} of them can still join{why}")

    def wait_until_all_left(self, deadline_s: float, poll_s: float) -> None:
        """Listen until no member is left, at most until the deadline. Silent workers are not removed."""
        while self._membership.members and self._clock() < deadline_s:
            self.receive(poll_s)
            self._revoke_keys()
            self._remove_ended_processes(0.0)

    def close(self) -> None:
        """Forget the hub.

        The hub and this server refer to each other, so without this call, both would keep their memory and file descriptors
        until the garbage collector runs.
        """
        del self._hub, self._processes

    def no_workers(self, workers: int, timeout_s: float) -> NoWorkers:
        """The error to raise when fewer than `workers` have joined within `timeout_s`. It says how to start a worker."""
        address = self._link.address
        reached_at = advertised_address(address, "", socket.gethostname())
        start = f"millrace worker {reached_at}{'' if self._link.keyring is None else ' --token FILE'}"
        joined = f"{len(self._membership.members)} joined{self._missing_reason()}"
        awaited = "1 worker" if workers == 1 else f"{workers} workers"
        return NoWorkers(f"waited {timeout_s:g} s for {awaited} at {address}, {joined}; start one: {start}")

    def what_workers_do(self) -> str:
        """What the workers are doing, those held up longest first. Without workers, what the learner is waiting for."""
        members = self._membership.members.values()
        processes = self._processes
        doing, wrote = what_they_do(members, processes.activities(), processes.last_lines(), self._clock())
        return "; ".join([doing or f"waiting for {self.awaited()}", *wrote])

    def awaited(self) -> str:
        """What a run without workers is waiting for, with the known reasons why workers may be missing."""
        return f"a worker to join at {self._link.address}{self._missing_reason()}"

    # ---------------------------------------------------------------- inside

    def _missing_reason(self) -> str:
        """The known reasons why workers may be missing, in parentheses; empty if there are none."""
        if self._last_turned_away:
            return f" (the last one {self._last_turned_away})"
        return f" ({self._link.refused} were not let in; the log says why)" if self._link.refused else ""

    def _answer(self, peer: bytes, message: ToLearner | Inquire | BadMessage, now: float) -> Sequence[Outgoing]:
        """The answer to one message. An error costs the sender its membership, but never ends the run."""
        try:
            match message:
                case RefusedMessage():
                    return ()
                case CannotUnpack(session=session) if not self._membership.is_session_of(peer, session):
                    return self._membership.ask_to_rejoin(peer, session)  # it was packed for another run, and is no mistake
                case BadMessage():
                    self.member_log.warn_limited(peer, f"message from {name_for_people(peer)!r}: {message}")
                    return self._coordinator.reject_message(peer, str(message), now)
                case Inquire():
                    self._link.send(peer, self._status_frames(now))
                    return ()
                case Hello() if not self._joins.admits(self._link.source(peer), now):
                    return ()  # the worker will repeat its Hello
                case _:
                    return self._coordinator.receive(peer, message, now)
        except Exception as error:
            return self._refuse_after_error(peer, type(message).__name__, error)

    def _refuse_after_error(self, peer: bytes, kind: str, error: Exception) -> Sequence[Outgoing]:
        """Refuse the sender of a message that caused an unexpected error, and log the first such error with its traceback.

        This is the last safeguard: no message should cause such an error.
        """
        self.unexpected_errors += 1
        line = f"its {kind} led to an error in the learner: {type(error).__name__}"
        if self.unexpected_errors == 1:
            log.error("%r: %s; please report it", name_for_people(peer), line, exc_info=error)
        member = self._membership.members.get(peer)
        return [(peer, Refuse(line))] if member is None else self._membership.refuse(member, line)

    def _status_frames(self, now: float) -> Sequence[Buffer]:
        """The frames of a status, which are reused for `STATUS_SHARE` times as long as they took to compute."""
        if now >= self._status[0]:
            frames = status_frames(self._hub.status(now))
            took_s = self._clock() - now
            self._status = (now + STATUS_SHARE * took_s, frames)
        return self._status[1]

    def _revoke_keys(self) -> None:
        for peer, why in self._keys.revoked(self._membership.members):
            self.send(self._coordinator.revoke(peer, why))

    def _remove_ended_processes(self, last_messages_wait_s: float) -> None:
        """Remove the workers whose processes have ended, after reading their last messages, which may say why."""
        ended = list(self._processes.ended())
        until_s = self._clock() + LAST_MESSAGES_TURNS * last_messages_wait_s
        while ended and self._link.poll(last_messages_wait_s):
            self.receive(0.0)
            if self._clock() > until_s:
                break
        for worker_exit in ended:
            self.send(self._coordinator.process_ended(worker_exit))

    def _record_activities(self, now: float) -> None:
        """Record what the workers that this program started are doing."""
        if now >= self._ask_processes_s:
            self._ask_processes_s = now + ASK_PROCESSES_S
            for activity in self._processes.activities():
                self._membership.record_activity(activity, now)

    def _frames(self, message: ToWorker) -> Sequence[Buffer]:
        """The frames of a message. Weights are encoded once, however many workers there are."""
        if not isinstance(message, Weights):
            return encode(message)
        if self._encoded is None or self._encoded[0] is not message:
            self._encoded = (message, encode(message))
        return self._encoded[1]

    def _log_events(self, cause: bytes | None) -> None:
        warned_of = ""  # the worker whose failure was the last to be logged as a warning
        for event in self._membership.take_events():
            match event:
                case RolloutArrived() | EpisodesArrived():
                    pass
                case RolloutRejected(peer, why):
                    self.member_log.warn_limited(peer, f"worker {name_for_people(peer)}: {why}")
                case _:
                    expected = self._is_expected(event, warned_of)
                    if isinstance(event, Failed) and not expected:
                        warned_of = event.worker
                    why_gone = self._why_gone(event)
                    if why_gone is not None:
                        self._last_turned_away = why_gone
                    self._log_event(event, cause, expected=expected)
            self._hub.happened(event)

    def _log_event(self, event: LoggedEvent, cause: bytes | None, *, expected: bool) -> None:
        if isinstance(event, WorkerJoined) and not self._settings.log_joins:
            return
        lines = describe(event)
        if isinstance(event, Failed) and expected:
            lines = lines.partition("\n")[0]  # the exception that the hub raises has the traceback
        self.member_log.log_event(logging.INFO if expected else logging.WARNING, event, lines, cause)

    def _is_expected(self, event: LoggedEvent, warned_of: str) -> bool:
        """Whether an event needs no warning. A failure that makes a worker leave gets one warning, not two."""
        match event:
            case WorkerJoined() | WorkerToldToRejoin() | NamelessHello() | LaneContinued(new_episodes=0):
                return True
            case WorkerLeft(worker):
                return worker == warned_of or self._was_asked_to_leave(event)
            case EnvironmentRaised() | PolicyRaised():
                return not self._settings.log_tracebacks
            case _:
                return False

    def _why_gone(self, event: LoggedEvent) -> str | None:
        """Why a worker may be missing after this event, as the words after its name; None if the event is no reason."""
        match event:
            case WorkerRefused(_, why) | NamelessHello(_, why):
                return f"was refused: {one_line(why)}"
            case WorkerStartFailed(_, why):
                return why
            case WorkerLeft(_, why) if not self._was_asked_to_leave(event):
                return why
            case _:
                return None

    def _was_asked_to_leave(self, event: WorkerLeft) -> bool:
        return event.on_purpose and self._membership.draining is not None


def status_frames(status: Status) -> Sequence[Buffer]:
    """The frames of a status. If it is too long for a message, the last workers are left out, and their number is given."""
    while True:
        try:
            return encode(status)
        except ValueError:
            if not status.workers:
                raise
            kept = len(status.workers) // 2
            left_out = status.workers_left_out + len(status.workers) - kept
            status = msgspec.structs.replace(status, workers=status.workers[:kept], workers_left_out=left_out)
