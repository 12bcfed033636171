"""Membership of workers: joining, sessions, names, refusals, leaving. Pure: messages and `now` in, messages out.

Rule: when a session ends, the learner forgets the worker's data, except totals and a limited number of refusals. The number
of members is limited.

Rule: workers that join before the run begins keep their sessions in the run (`take_over`). A worker that was asked for a
description and has not answered gets no work until it has begun the run, because it may be hanging.

Rule: a process has one session at a time. A repeated Hello is answered with the same Welcome. A Hello from a new attempt, or
from another process with the same name, ends the previous session. A process that lost its name in this way may join again.
If processes keep taking a name from each other, the one that loses it at the third takeover is refused. A process that was
refused stays refused. A worker that is silent for too long is removed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

from millrace.learner.members.events import (
    EnvironmentRaised,
    Event,
    Failed,
    NamelessHello,
    PolicyRaised,
    WorkerJoined,
    WorkerLeft,
    WorkerProcessFailed,
    WorkerRefused,
    WorkerToldToRejoin,
)
from millrace.learner.members.member import Member, SharingSupervisor
from millrace.protocol.address import key_of_peer, name_for_people, worker_name
from millrace.protocol.bounds import Stage, Stages, escaped, one_line
from millrace.protocol.messages import (
    PROTOCOL_VERSION,
    Alive,
    Drain,
    Failure,
    Goodbye,
    Heartbeat,
    HeartbeatReply,
    Hello,
    Refuse,
    Rejoin,
    Rollout,
    ToLearner,
    ToWorker,
    Welcome,
    WorkerActivity,
    WorkerExit,
    WorkerStatus,
)
from millrace.protocol.specs import RunSpec, StepSpec, WaitSpec

REMEMBERED = 1_000  # how many refused processes, and how many silent workers, are remembered; this bounds memory
MAX_MEMBERS = 4_096
MOST_TAKEOVERS = 3  # how many times in a row live processes may take a name from each other
NAMELESS = "its connection has no routing id: expected the worker's name, set as the socket's routing id before it connects"

Outgoing = tuple[bytes, ToWorker]
"""The routing id of a worker, and a message for it."""


@dataclass(frozen=True)
class Answered:
    """The answer to a member's Failure, or to a message that isn't from a member's current session."""

    out: list[Outgoing]
    """The messages of the answer."""
    changed: bool = False
    """Whether a worker joined or members were removed. If so, work may have to be dealt."""


class Gone(NamedTuple):
    """How a membership ended."""

    why: str
    """The reason, as the words after the worker's name."""
    on_purpose: bool = False
    """Whether the worker said Goodbye."""
    refusal: str | None = None
    """The reason that is sent to the worker, if it is refused."""
    failed_lane: int | None = None
    """The lane whose environment failed, if the worker reported this as a Failure."""
    hung: bool = False
    """Whether its process was ended because a call took too long."""


K = TypeVar("K")
V = TypeVar("V")


class Membership:
    """The members, by their routing ids."""

    def __init__(
        self,
        run: WaitSpec | RunSpec | StepSpec,
        on_removed: Callable[[Member, Gone], None],
        first_session: int,
        is_spare: Callable[[Member], bool] = lambda member: False,
    ) -> None:
        """`on_removed` is called with each member that was removed, and how its membership ended. It must take back the
        member's work.

        `is_spare` says whether the run doesn't need a member, so that its failures don't count.
        """
        self.members: dict[bytes, Member] = {}
        self.events: list[Event] = []
        self.draining: str | None = None
        """why the workers were asked to leave; None if they were not"""
        self.progress = {False: 0, True: 0}
        """how many times a member has reported more env steps, or more finished environment calls, than before. Key False is
        for members that may collect, True for those that only evaluate
        """
        self.has_policy_code = isinstance(run, RunSpec) and bool(run.policy_code)
        """whether a user-defined policy acts in the workers; if not, a failure is never blamed on the policy"""
        self._run = run
        self._on_removed = on_removed
        self.is_spare = is_spare
        self._first_session = self._next_session = first_session
        self._joins = 0
        self._none_silent_before_s = -math.inf  # before this time, no member can have been silent for too long
        self._of_process: dict[tuple[str, int], Member] = {}  # the members by name and process_nonce
        self._removed_for_silence: dict[str, int] = {}  # process_nonce by worker, until it joins again; oldest first
        self._stages_of_left: Stages = {}  # total seconds that members that have left spent in each stage
        self._refused: dict[bytes, tuple[int, str]] = {}  # by peer, the nonce of the process that was refused, and why

    def active(self) -> list[Member]:
        """The members that may be given work, in the order in which they joined."""
        return [each for each in self.members.values() if not (each.draining or each.describes)]

    def collectors(self) -> list[Member]:
        """The members that may have lanes."""
        return [member for member in self.members.values() if not member.hello.evaluates]

    def status(self, now: float) -> tuple[WorkerStatus, ...]:
        """A row of `millrace status` for each member, in the order in which they joined."""
        return tuple(member.status(now) for member in sorted(self.members.values(), key=lambda member: member.join_number))

    def stages(self) -> Stages:
        """Total seconds in each stage, of all members and of those that have left."""
        total = dict(self._stages_of_left)
        for member in self.members.values():
            _add(total, member.stages())
        return total

    def take_events(self) -> list[Event]:
        """Return and clear the events since the last call."""
        events = self.events
        self.events = []
        return events

    def hear(self, peer: bytes, message: ToLearner, now: float) -> Member | Answered:
        """The member in whose session this message was sent, if the caller must answer it; otherwise, the answer."""
        match message:
            case Hello():
                out, joined = self.join(peer, message, now)
                return Answered(out, joined is not None)
            case Alive():
                out, exits = self.hear_supervisor(peer, message, now)
                return Answered(out, bool(exits))
        member = self.member_of_session(peer, message, now)
        if member is None:
            return Answered(self.answer_ended_session(peer, message))
        if isinstance(message, Failure):
            self._fail(member, message)
            return Answered([], changed=True)
        return member

    def member_of_session(self, peer: bytes, message: ToLearner, now: float) -> Member | None:
        """The member that sent this message in its current session, or None. Records when the member was last heard from."""
        member = self.members.get(peer)
        if member is None or isinstance(message, Hello | Alive) or member.session != message.session:
            return None
        member.heard_s = now
        if isinstance(message, Heartbeat) and message.steps > (member.heartbeat.steps if member.heartbeat else 0):
            self.progress[member.hello.evaluates] += 1
        return member

    def answer_ended_session(self, peer: bytes, message: ToLearner) -> list[Outgoing]:
        """The answer to a message from a session that has ended: a request to join again, unless the worker is leaving."""
        if isinstance(message, Hello | Alive | Goodbye | Failure):  # rule UNKNOWN_SESSION
            return []
        return self.ask_to_rejoin(peer, message.session, message.env_steps if isinstance(message, Rollout) else 0)

    def ask_to_rejoin(self, peer: bytes, session: int, late: int = 0) -> list[Outgoing]:
        """The answer to a message from a session that has ended. `late`: the number of transitions in the message."""
        self.events.append(WorkerToldToRejoin(name_for_people(peer), session, late))
        return [(peer, Rejoin(session))]

    def is_session_of(self, peer: bytes, session: int) -> bool:
        """Whether this peer is a member, in this session."""
        member = self.members.get(peer)
        return member is not None and member.session == session

    def join(self, peer: bytes, hello: Hello, now: float) -> tuple[list[Outgoing], Member | None]:
        """Answer a Hello. Returns the answer, and the member if one joined."""
        turned_away = self._turned_away(peer, hello)
        if turned_away is not None:
            return turned_away, None
        takeovers = 0
        earlier = self.members.get(peer)
        if earlier is not None:
            same_process = earlier.hello.process_nonce == hello.process_nonce
            if same_process and hello.attempt == earlier.hello.attempt:  # rule REPEATED_HELLO
                earlier.heard_s = now
                return [self._welcome(earlier)], None
            if same_process and hello.attempt < earlier.hello.attempt:
                return [], None
            takeovers = earlier.takeovers + (not same_process)
            if not same_process and takeovers >= MOST_TAKEOVERS:
                why = f"another process, on {hello.host}, joined as {hello.worker}; give each worker a name of its own"
                self._remember_refusal(earlier, why)
            # rule LATER_HELLO
            self.remove(earlier, Gone("began again" if same_process else f"replaced by process {hello.pid}"))
        member = Member(peer, hello, self._next_session, self._joins, now, joined_s=now, takeovers=takeovers)
        self._next_session += 1
        self._joins += 1
        self.members[peer] = member
        self._of_process[hello.worker, hello.process_nonce] = member
        self._removed_for_silence.pop(hello.worker, None)
        self.events.append(WorkerJoined(hello.worker, hello.host, hello.pid))
        return [self._welcome(member)], member

    def take_over(self, waiting: Membership, now: float) -> list[Outgoing]:
        """Begin the run for the workers waiting for it. Their sessions continue; another Welcome sends them the run."""
        self._first_session = waiting._first_session
        self._next_session = waiting._next_session
        self._joins = waiting._joins
        self._refused = waiting._refused
        self._removed_for_silence = waiting._removed_for_silence
        for peer, member in waiting.members.items():
            member.heard_s = member.joined_s = now
            member.describes = bool(member.tickets)
            member.tickets = {}
            self.members[peer] = member
            self._of_process[member.hello.worker, member.hello.process_nonce] = member
            self.events.append(WorkerJoined(member.hello.worker, member.hello.host, member.hello.pid))
        return [self._welcome(member) for member in self.members.values()]

    def welcome_again(self, member: Member, heartbeat: Heartbeat) -> list[Outgoing]:
        """Repeat the Welcome that sends the run, if this heartbeat shows that the Welcome was lost."""
        lost = heartbeat.waits and not isinstance(self._run, WaitSpec) and heartbeat.replies > member.welcomed
        return [self._welcome(member)] if lost else []

    def leave(self, member: Member, reason: str) -> None:
        """Remove a member that said Goodbye."""
        self.remove(member, Gone(f"left: {reason}", on_purpose=True))

    def refuse(self, member: Member, why: str) -> list[Outgoing]:
        """Remove a member, and refuse its process from now on."""
        self._remember_refusal(member, why)
        return self._refuse_and_remove(member, f"refused: {why}", why)

    def revoke(self, peer: bytes, why: str) -> list[Outgoing]:
        """Remove a member at once, whatever work it has, because its key was revoked."""
        return self._refuse_and_remove(self.members[peer], f"was shut out: {why}", why)

    def hear_supervisor(self, peer: bytes, alive: Alive, now: float) -> tuple[list[Outgoing], list[WorkerExit]]:
        """Record a supervisor's statements about members.

        A statement counts only if the member has the supervisor's key, and if the supervisor knows the member's nonce.
        Returns the answer, and the process exits that led to the removal of a member.
        """
        key = key_of_peer(peer)
        found = [self.record_activity(activity, now, key) for activity in alive.running]
        removed = [worker_exit for worker_exit in alive.ended if self.record_exit(worker_exit, key)]
        if self.draining is not None:
            return [(peer, Drain(one_line(self.draining)))], removed
        members = [member for member in found if member is not None]
        answer = list[Outgoing]()
        supervisor = None
        if alive.replies is not None and members:
            known = (each.supervisor for each in members if each.supervisor and each.supervisor.peer == peer)
            supervisor = next(known, None) or SharingSupervisor(peer)
            supervisor.heard_s = now
            supervisor.received = alive.replies
            supervisor.replies += 1
            answer.append((peer, HeartbeatReply(self._first_session, supervisor.replies, ())))
        for member in members:
            member.supervisor = supervisor
        return answer, removed

    def record_activity(self, activity: WorkerActivity, now: float, key: bytes | None = None) -> Member | None:
        """Record what a member's process is doing. Returns the member.

        `key` is the key of the supervisor that reports it; None if this program is the supervisor.
        """
        member = self._of_process.get((activity.worker, activity.process_nonce))
        if member is None or (key is not None and key != key_of_peer(member.peer)):
            return None
        if member.record_activity(activity, now):
            self.progress[member.hello.evaluates] += 1
        return member

    def record_exit(self, worker_exit: WorkerExit, key: bytes | None = None) -> bool:
        """Remove the member whose process has ended. Returns whether there was one. For `key`, see `record_activity`."""
        worker = worker_exit.worker
        reason = worker_exit.reason
        member = self._of_process.get((worker, worker_exit.process_nonce))
        if member is not None and (key is None or key == key_of_peer(member.peer)):
            if worker_exit.failed:
                by_policy = worker_exit.of_policy and self.has_policy_code
                kind = PolicyRaised if by_policy else WorkerProcessFailed
                self.events.append(self._failed(kind, member, f"its process {reason}"))
            self.remove(member, Gone(reason, hung=worker_exit.hung))
            return True
        if self._removed_for_silence.get(worker) == worker_exit.process_nonce:  # this explains why it was silent
            del self._removed_for_silence[worker]
            self.events.append(WorkerLeft(worker, reason, 0, False))
        return False

    def remove_silent(self, now: float, timeout_s: float) -> list[Member]:
        """Remove the members that have been silent for longer than `timeout_s`. Returns them."""
        if now < self._none_silent_before_s:
            return []
        silent = [member for member in self.members.values() if now - member.alive_s > timeout_s]
        for member in silent:
            _remember(self._removed_for_silence, member.hello.worker, member.hello.process_nonce)
            self.remove(member, Gone(f"silent for {timeout_s:.0f} s"))
        self._none_silent_before_s = min((member.alive_s for member in self.members.values()), default=now) + timeout_s
        return silent

    def remove(self, member: Member, gone: Gone) -> None:
        """Remove a member. Nothing is sent to it."""
        # First, so that the end of its process removes it only once, even if an interrupt comes before the next line.
        self._of_process.pop((member.hello.worker, member.hello.process_nonce), None)
        del self.members[member.peer]
        _add(self._stages_of_left, member.stages())
        worker = member.hello.worker
        tickets = len(member.tickets)
        left = WorkerLeft(worker, gone.why, tickets, gone.on_purpose)
        self.events.append(left if gone.refusal is None else WorkerRefused(worker, gone.refusal, tickets))
        self._on_removed(member, gone)

    def drain(self, reason: str) -> list[Outgoing]:
        """Ask every member to leave. From now on, nobody can join."""
        self.draining = reason
        out: list[Outgoing] = []
        for member in self.members.values():
            if member.draining:
                continue
            member.draining = True
            out.append((member.peer, Drain(one_line(reason))))
        return out

    def _turned_away(self, peer: bytes, hello: Hello) -> list[Outgoing] | None:
        """The answer to a Hello that is turned away, whatever session its worker has; None for any other Hello."""
        if not worker_name(peer):
            self.events.append(NamelessHello(hello.worker, NAMELESS))
            return [(peer, Refuse(NAMELESS))]
        if why := _mistake(peer, hello):
            return self._refuse_hello(peer, hello, why)
        nonce, why = self._refused.get(peer, (-1, ""))
        if nonce == hello.process_nonce:
            return [(peer, Refuse(why))]
        if self.draining is not None:
            return [(peer, Drain(one_line(self.draining)))]  # rule HELLO_WHILE_DRAINING
        if peer not in self.members and len(self.members) >= MAX_MEMBERS:
            return self._refuse_hello(peer, hello, f"workers: expected at most {MAX_MEMBERS} at one learner")
        return None

    def _refuse_hello(self, peer: bytes, hello: Hello, why: str) -> list[Outgoing]:
        self.events.append(WorkerRefused(hello.worker, why))
        return [(peer, Refuse(one_line(why)))]

    def _fail(self, member: Member, failure: Failure) -> None:
        """Remove a member that reports a failure of the environment's code or of the user's policy."""
        by_policy = failure.of_policy and self.has_policy_code
        kind = PolicyRaised if by_policy else EnvironmentRaised
        self.events.append(self._failed(kind, member, failure.error, failure.traceback, failure.lane))
        self.remove(member, Gone("failed", failed_lane=failure.lane))

    def _failed(
        self, kind: type[Failed], member: Member, error: str, traceback: str = "", lane: int | None = None
    ) -> Failed:
        """The event of a member's failure: in `lane` if the member has this lane, otherwise in all of its lanes."""
        return kind(
            worker=member.hello.worker,
            host=member.hello.host,
            error=error,
            traceback=escaped(traceback),
            lanes=(lane,) if lane in member.lanes else tuple(sorted(member.lanes)),
            worked_s=member.worked_s,
            spare=self.is_spare(member),
        )

    def _welcome(self, member: Member) -> Outgoing:
        member.welcomed = member.replies
        return member.peer, Welcome(member.session, member.hello.attempt, self._run)

    def _refuse_and_remove(self, member: Member, why: str, refusal: str) -> list[Outgoing]:
        self.remove(member, Gone(why, refusal=refusal))
        return [(member.peer, Refuse(one_line(refusal)))]

    def _remember_refusal(self, member: Member, why: str) -> None:
        _remember(self._refused, member.peer, (member.hello.process_nonce, one_line(why)))


def _mistake(peer: bytes, hello: Hello) -> str:
    """What is wrong with a Hello; empty if nothing is."""
    if hello.protocol != PROTOCOL_VERSION:  # rule OTHER_PROTOCOL
        return f"protocol: expected {PROTOCOL_VERSION}, got {hello.protocol}; install the learner's version of millrace"
    if hello.worker.encode() != worker_name(peer):
        return f"name: expected {name_for_people(peer)!r}, as in its routing id, got {hello.worker[:40]!r}"
    return ""


def _remember(table: dict[K, V], key: K, value: V) -> None:
    """Store a value in a table of limited size, dropping the oldest entry if the table is full."""
    table[key] = value
    if len(table) > REMEMBERED:
        del table[next(iter(table))]


def _add(total: Stages, stages: Mapping[Stage, float]) -> None:
    for stage, seconds in stages.items():
        total[stage] = total.get(stage, 0.0) + seconds
