"""A worker as the learner sees it: what it has reported, and the work that it was given. Plain data and derived figures.

Rule: a worker may report anything, so each figure is bounded. Times are bounded by the session's length, and late actions by
a number that no loop can reach. The list of tickets in a heartbeat is not kept, because it may be long.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Set
from dataclasses import dataclass, field
from typing import NamedTuple

import msgspec

from millrace.protocol.bounds import Stages
from millrace.protocol.call_timeouts import OUR_CODE
from millrace.protocol.messages import Heartbeat, Hello, WorkerActivity, WorkerStatus

MEASURE_S = 0.5  # heartbeats closer together than this don't measure a worker's speed, because several may be read at once
MAX_LATE_ACTIONS = 1_000_000  # a larger number of late actions between two heartbeats is not believed
SUPERVISOR_WORD_S = 5.0  # how long a supervisor's statement is valid


@dataclass(eq=False)
class SharingSupervisor:
    """A supervisor, as the learner sees it, that shares the weights it receives among its workers. Members refer to it."""

    peer: bytes
    heard_s: float = 0.0
    """Time of its last message."""
    replies: int = 0
    """Number of heartbeat replies that were sent to it."""
    received: int = 0
    """Number of the last reply that it has received. Messages sent before that reply have arrived or are lost."""


class SentTicket(NamedTuple):
    """What the learner remembers of a ticket that it has sent to a worker."""

    replies: int
    """The value of the member's `replies` when the ticket was last sent."""
    versions: Set[int] = frozenset()
    """The versions of all weights that the worker needs for it."""


@dataclass(frozen=True)
class Speed:
    """How fast a worker steps.

    A step may take minutes, and a client may count the steps of a rollout only when the rollout is complete. Therefore, the
    speed is measured between the last two heartbeats that reported more steps than before. The speed falls once the next
    measurement is overdue.
    """

    steps: int
    """Env steps in the heartbeat of the last measurement."""
    at_s: float
    """Time when that heartbeat arrived."""
    gained: int = 0
    """Env steps between the previous measurement and this one."""
    seconds: float = 1.0
    """Seconds between the previous measurement and this one."""

    def after(self, steps: int, now: float) -> Speed:
        """The speed after a measurement with a later heartbeat."""
        return Speed(steps, now, steps - self.steps, now - self.at_s)

    def steps_per_s(self, now: float) -> float:
        """Env steps per second."""
        return self.gained / max(self.seconds, now - self.at_s)


@dataclass
class Member:
    """A worker as the learner sees it."""

    peer: bytes
    """Routing id of the worker."""
    hello: Hello
    session: int
    join_number: int
    """Number of this member in the order of joining."""
    heard_s: float
    """Time of the worker's last message."""
    joined_s: float = 0.0
    """Time when the worker joined."""
    takeovers: int = 0
    """How many times in a row another process has taken this name from a live process."""
    strikes: int = 0
    """The number of the worker's rollouts and messages that could not be used."""
    draining: bool = False
    """Whether the learner has asked it to leave."""
    lanes: set[int] = field(default_factory=set)
    tickets: dict[int, SentTicket] = field(default_factory=dict)
    """The tickets that the worker holds, by number."""
    replies: int = 0
    """Number of heartbeat replies that were sent to the worker."""
    welcomed: int = 0
    """The value of `replies` when the run was sent to the worker."""
    describes: bool = False
    """Whether the worker may still be busy with a description that was requested before the run. True until the worker
    reports that it has begun the run.
    """
    heartbeat: Heartbeat | None = None
    """Newest heartbeat."""
    stages_before: Stages = field(default_factory=dict)
    """Seconds that the worker's process spent in each stage before this session."""
    speed: Speed | None = None
    """The worker's speed; None before its first heartbeat."""
    ended_steps: int = 0
    """The env steps that its process made before this session, plus those in its rollouts and evaluations that arrived."""
    first_step_s: float | None = None
    """Time when its process was first known to have taken an env step, because it reported one or sent a rollout."""
    activity: WorkerActivity | None = None
    """What the worker is doing, according to its supervisor's last statement."""
    activity_s: float = 0.0
    """Time of the supervisor's last statement."""
    in_env_code_s: float = -math.inf
    """Time when the supervisor last reported that the worker was running code of the environment or of a user-written
    policy. Up to that time, the worker doesn't count as silent.
    """
    supervisor: SharingSupervisor | None = None
    """The worker's supervisor, if that supervisor shares weights."""

    @property
    def shared_by(self) -> SharingSupervisor | None:
        """The supervisor that shares weights with the worker, unless the supervisor has fallen silent."""
        found = self.supervisor
        return found if found is not None and self.heard_s - found.heard_s < SUPERVISOR_WORD_S else None

    @property
    def role(self) -> str:
        """The worker's role: draining, evaluating (it only evaluates), active (it has lanes), or spare (it has none)."""
        if self.draining:
            return "draining"
        return "evaluating" if self.hello.evaluates else "active" if self.lanes else "spare"

    @property
    def has_counted(self) -> bool:
        """Whether the next heartbeat's counts may include work that the process did before it joined this run."""
        return not self.hello.is_first_attempt if self.heartbeat is None else self.heartbeat.waits

    @property
    def alive_s(self) -> float:
        """Time at which the worker was last known to be alive and well."""
        return max(self.heard_s, self.in_env_code_s)

    @property
    def worked_s(self) -> float | None:
        """Seconds from its first known env step until it was last known to be alive; None without a known step."""
        return None if self.first_step_s is None else max(0.0, self.alive_s - self.first_step_s)

    @property
    def steps_under_way(self) -> int:
        """The env steps that were made for its unfinished tickets, as of its newest heartbeat."""
        return 0 if self.heartbeat is None else max(0, self.heartbeat.steps - self.ended_steps)

    def needs(self, tickets: Collection[int]) -> set[int]:
        """The versions of all weights that the worker needs for these tickets. Tickets that it doesn't hold are ignored."""
        return {version for ticket in self.tickets.keys() & tickets for version in self.tickets[ticket].versions}

    def has_stepped(self) -> None:
        """Record that its process has taken an env step."""
        if self.first_step_s is None:
            self.first_step_s = self.heard_s

    def record_activity(self, activity: WorkerActivity, now: float) -> bool:
        """Record a supervisor's statement. Returns whether environment calls have returned since the previous statement."""
        before = self.activity
        self.activity = activity
        self.activity_s = now
        if activity.doing not in OUR_CODE:
            self.in_env_code_s = now
        return activity.env_calls > (0 if before is None else before.env_calls)

    def record_heartbeat(self, heartbeat: Heartbeat) -> list[int]:
        """Record a heartbeat. Returns the tickets that were lost on the way to the worker.

        A ticket is lost if it was sent before a reply that the worker has received, and the worker does not hold it.
        """
        has_counted = self.has_counted
        if has_counted:
            self.stages_before = heartbeat.stages
        if has_counted or not heartbeat.tickets:  # the worker has no unfinished work of this session
            self.ended_steps = heartbeat.steps
        self.heartbeat = msgspec.structs.replace(heartbeat, tickets=())  # a peer may list many, and the heartbeat is kept
        if heartbeat.steps:
            self.has_stepped()
        if self.speed is None:
            self.speed = Speed(heartbeat.steps, self.heard_s)
        elif heartbeat.steps != self.speed.steps and self.heard_s - self.speed.at_s >= MEASURE_S:
            self.speed = self.speed.after(heartbeat.steps, self.heard_s)
        held = set(heartbeat.tickets)
        return [ticket for ticket, sent in self.tickets.items() if ticket not in held and heartbeat.replies > sent.replies]

    def begins(self, heartbeat: Heartbeat) -> None:
        """If this heartbeat shows that a worker that was describing an environment has begun the run, record that."""
        if not heartbeat.waits:
            self.describes = False

    def new_late_actions(self, heartbeat: Heartbeat) -> int:
        """The number of late actions since the last heartbeat. Late actions from before this session don't count.

        Returns 0 for a number that no loop can reach between two heartbeats.
        """
        if self.heartbeat is not None:
            before = self.heartbeat.late_actions
        else:
            before = 0 if self.hello.is_first_attempt else heartbeat.late_actions
        more = heartbeat.late_actions - before
        return more if 0 <= more <= MAX_LATE_ACTIONS else 0

    def stages(self) -> Stages:
        """Seconds in each stage during this session, from the newest heartbeat. None exceeds the length of the session.

        Waiting time of a member that only evaluates is not counted, because such a member doesn't wait for training.
        """
        lasted_s = self.heard_s - self.joined_s
        return {
            stage: max(0.0, min(seconds - self.stages_before.get(stage, 0.0), lasted_s))
            for stage, seconds in (self.heartbeat.stages if self.heartbeat is not None else {}).items()
            if not (self.hello.evaluates and stage == "wait")
        }

    def status(self, now: float) -> WorkerStatus:
        """The worker's row in the output of `millrace status`."""
        heartbeat = self.heartbeat
        said_s = now - self.activity_s
        activity = self.activity if said_s < SUPERVISOR_WORD_S else None
        return WorkerStatus(
            worker=self.hello.worker,
            host=self.hello.host,
            pid=self.hello.pid,
            state=self.role,
            lanes=tuple(sorted(self.lanes)),
            tickets=len(self.tickets),
            steps=heartbeat.steps if heartbeat else 0,
            steps_per_s=0.0 if self.speed is None else self.speed.steps_per_s(now),
            version=max(heartbeat.versions, default=-1) if heartbeat else -1,
            silent_s=max(0.0, now - self.heard_s),
            resident_bytes=heartbeat.resident_bytes if heartbeat else 0,
            strikes=self.strikes,
            doing=activity.doing if activity else "",
            doing_s=activity.for_s + max(0.0, said_s) if activity else 0.0,
            late_actions=heartbeat.late_actions if heartbeat else 0,
        )
