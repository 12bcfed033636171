"""The worker's half of the conversation. Pure: messages and `now` in, effects out; no socket, clock, thread or environment.

Rule: a rollout starts only under weights at least as new as its ticket asks for. A message that is lost does no harm,
because the next Heartbeat lists all tickets that this worker holds, and the learner sends again what is missing. What a
worker holds is in the files beside this one that begin with `held_`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from protocol.bounds import MAX_TICKETS, Stage, last_text, one_line
from protocol.messages import (
    PROTOCOL_VERSION,
    TOLD_TO_STOP,
    Answer,
    Call,
    Collect,
    Described,
    Drain,
    Evaluate,
    Evaluated,
    Failure,
    Goodbye,
    Heartbeat,
    HeartbeatReply,
    Hello,
    LaneIncarnation,
    Order,
    Received,
    Refuse,
    Rejoin,
    Release,
    Reset,
    Rollout,
    Step,
    ToLearner,
    ToWorker,
    Weights,
    Welcome,
)
from protocol.space_spec import EnvDescription
from protocol.specs import DescribeSpec, RunSpec, StepSpec
from workers.conversation.connection_rules import REJOIN_TIMEOUT_S
from workers.conversation.held_evaluations import HeldEvaluations
from workers.conversation.held_orders import HeldOrders
from workers.conversation.held_rollouts import Assignment, HeldRollouts
from workers.conversation.states import TABLE, LearnerSilent, State, StopRequested, WorkerFailed, WorkFinished
from workers.exit_codes import EXIT_UNSUITABLE

HELLO_FIRST_S, HELLO_MOST_S = 0.25, 4.0
NO_LEARNER = "no learner answered"


@dataclass(frozen=True)
class Send:
    """Effect: send this message."""

    message: ToLearner


@dataclass(frozen=True)
class StartSession:
    """Effect: a new session starts; close every env copy of the last one."""

    run: DescribeSpec | RunSpec | StepSpec


@dataclass(frozen=True)
class CloseLanes:
    """Effect: close the env copies of these lanes."""

    lanes: tuple[LaneIncarnation, ...]


@dataclass(frozen=True)
class Leave:
    """Effect: the conversation is over; end with this exit code."""

    exit_code: int
    reason: str


Effect = Send | StartSession | CloseLanes | Leave


@dataclass(frozen=True)
class Task:
    """Rollouts to collect together, all under these weights."""

    session: int
    weights: Weights
    assignments: tuple[Assignment, ...]


@dataclass(frozen=True)
class EvaluationTask:
    """Episodes to play under these weights."""

    weights: Weights
    order: Evaluate


@dataclass(frozen=True)
class Identity:
    """The identity of this worker: its name, host and process."""

    worker: str
    host: str
    pid: int
    process_nonce: int
    """random number that tells this process, or thread, from any other of the same name"""
    software: str

    def hello(self, attempt: int) -> Hello:
        """The Hello of this attempt to join. Attempts are counted from the nonce: no two processes have the same one."""
        return Hello(
            PROTOCOL_VERSION,
            worker=self.worker,
            host=one_line(self.host),
            pid=self.pid,
            process_nonce=self.process_nonce,
            software=one_line(self.software),
            attempt=attempt,
        )


@dataclass(frozen=True)
class Statistics:
    """Figures that a Heartbeat reports."""

    steps: int = 0
    """env steps since the worker started"""
    stages: Mapping[Stage, float] = field(default_factory=dict)
    """seconds in each stage"""
    resident_bytes: int = 0
    """resident memory of this process"""


@dataclass
class _SessionState:
    """All that belongs to one session. A new session starts with a new one."""

    rollouts: HeldRollouts = field(default_factory=HeldRollouts)
    evaluations: HeldEvaluations = field(default_factory=HeldEvaluations)
    orders: HeldOrders = field(default_factory=HeldOrders)
    described: Described | None = None  # sent with every Heartbeat, because one may be lost
    weights: Weights | None = None
    in_progress: tuple[int, ...] = ()  # tickets
    replies: int = 0  # number of the last HeartbeatReply
    acknowledged_version: int = -1  # newest version that a message of this worker has named

    @property
    def version(self) -> int:
        """Version of the weights; -1 before the first."""
        return -1 if self.weights is None else self.weights.version

    def unfinished(self) -> tuple[int, ...]:
        """Tickets that are not yet collected or executed."""
        return (*self.rollouts.tickets(), *self.evaluations.tickets(), *self.orders.tickets())

    def lanes(self) -> tuple[LaneIncarnation, ...]:
        """The lanes of this worker."""
        return (*self.rollouts.lanes(), *self.orders.lanes())


class Session:
    """State machine of one worker, from its first Hello until it leaves."""

    def __init__(
        self, identity: Identity, now: float, *, join_timeout_s: float = 60.0, rejoin_timeout_s: float = REJOIN_TIMEOUT_S
    ) -> None:
        self.identity = identity
        self.state = State.JOINING
        self.run: DescribeSpec | RunSpec | StepSpec | None = None
        self.session = 0
        self._statistics = Statistics()
        self._join_timeout_s = join_timeout_s
        self._rejoin_timeout_s = rejoin_timeout_s
        self._attempt = identity.process_nonce
        self._unanswered_s = math.inf  # when the first Heartbeat was sent since the learner was heard
        self._due_s = self._joining_s = now
        self._backoff_s = HELLO_FIRST_S
        self._reason = ""
        self._current = _SessionState()
        self._join(now)

    # ---------------------------------------------------------------- messages and time

    def handle(self, message: ToWorker, now: float) -> list[Effect]:
        """Handle a message of the learner."""
        if isinstance(message, Drain):  # a Drain also answers the heartbeats of a worker that drains already
            self._unanswered_s = math.inf
        if type(message) not in TABLE[self.state]:
            return []
        if not isinstance(message, Welcome) and getattr(message, "session", self.session) != self.session:
            return []  # it belongs to an earlier session of this worker
        match message:
            case Welcome():
                return self._welcome(message, now)
            case Refuse(reason):
                return self._leave(message, 2, reason)
            case Drain(reason):
                return self._drain(message, reason)
            case Rejoin():
                return self._rejoin(message, "the learner does not know this session", now)
        self._unanswered_s = math.inf
        match message:
            case Weights(version):
                if version > self._current.version:
                    self._current.weights = message
            case Collect(_, version, permits, received) if isinstance(self.run, RunSpec):
                self._current.rollouts.forget_received(received)
                again = [self._current.rollouts.take(permit, version) for permit in permits]
                return [Send(rollout) for rollout in again if rollout is not None]
            case Evaluate() if isinstance(self.run, RunSpec):
                evaluated = self._current.evaluations.take(message)
                return [] if evaluated is None else [Send(evaluated)]
            case Reset() | Step() | Call() if isinstance(self.run, StepSpec):
                answer = self._current.orders.take(message)
                return [] if answer is None else [Send(answer)]
            case Release(_, lanes):
                return self._release(lanes)
            case HeartbeatReply(_, number, received) if number > self._current.replies:
                self._current.replies = number
                self._current.rollouts.forget_received(received)
                return self._release_unlisted(received)
        return []

    def tick(self, now: float) -> list[Effect]:
        """Do what is due: Hello, Heartbeat (also to acknowledge new weights), or giving up on a silent learner."""
        match self.state:
            case State.LEFT:
                return []
            case State.JOINING:
                if now - self._joining_s > self._join_timeout_s:
                    return self._leave(LearnerSilent(), 1, f"{NO_LEARNER} for {self._join_timeout_s:g} s")
                if now < self._due_s:
                    return []
                self._due_s = now + self._backoff_s
                self._backoff_s = min(2 * self._backoff_s, HELLO_MOST_S)
                return [Send(self.identity.hello(self._attempt))]
        assert self.run is not None
        if now - self._unanswered_s > self.run.learner_timeout_s:
            return self._rejoin(LearnerSilent(), f"the learner was silent for {self.run.learner_timeout_s:.0f} s", now)
        return self.heartbeat_if_due(now)

    def heartbeat_if_due(self, now: float) -> list[Effect]:
        """A Heartbeat, if one is due. It changes nothing else, so it may be sent at any moment."""
        if self.run is None or self.state not in (State.READY, State.DRAINING):
            return []
        if now < self._due_s and self._current.acknowledged_version == self._current.version:
            return []
        self._due_s = now + self.run.heartbeat_s
        self._unanswered_s = min(self._unanswered_s, now)
        self._current.acknowledged_version = self._current.version
        described = self._current.described
        return [Send(self._heartbeat()), *([] if described is None else [Send(described)])]

    def update_statistics(self, statistics: Statistics) -> None:
        """The next Heartbeat reports these."""
        self._statistics = statistics

    def next_due_s(self) -> float:
        """Time at which `tick` must be called at the latest."""
        return self._due_s

    def stop(self) -> list[Effect]:
        """Leave: after the work in progress, or at once when called twice."""
        return [] if self.state is State.LEFT else self._drain(StopRequested(), TOLD_TO_STOP)

    def fail(self, error: str, traceback: str, lane: int | None, *, of_policy: bool = False) -> list[Effect]:
        """The environment, the user's policy (`of_policy`), or this worker raised: report it to the learner, and leave."""
        error = one_line(error)
        effects: list[Effect] = []
        if self.state in (State.READY, State.DRAINING):
            effects.append(Send(Failure(self.session, error, last_text(traceback), lane, of_policy)))
        return [] if self.state is State.LEFT else effects + self._leave(WorkerFailed(), 1, error)

    def decline(self, reason: str, exit_code: int = EXIT_UNSUITABLE) -> list[Effect]:
        """Leave a run in which this worker cannot take part, or (with another exit code) not now."""
        goodbye = Send(Goodbye(self.session, one_line(reason), ()))
        return [goodbye, *self._leave(WorkerFailed(), exit_code, reason)]

    def refused(self, reason: str) -> list[Effect]:
        """Leave, because the learner's endpoint rejects this worker for good."""
        return [] if self.state is State.LEFT else self._leave(Refuse(reason), 2, reason)

    # ---------------------------------------------------------------- describing

    def described(self, description: EnvDescription) -> list[Effect]:
        """The environment of the `DescribeSpec` is described."""
        if self.state not in (State.READY, State.DRAINING):
            return []
        self._current.described = Described(self.session, description)
        return [Send(self._current.described)]

    # ---------------------------------------------------------------- collecting

    def next_task(self) -> Task | None:
        """The oldest ticket of every lane that can start, to be collected together. None when there is none."""
        if not self._is_idle() or self._current.weights is None:
            return None
        assignments = self._current.rollouts.startable(self._current.version)
        if not assignments:
            return None
        self._current.in_progress = tuple(assignment.ticket for assignment in assignments)
        return Task(self.session, self._current.weights, assignments)

    def finished(self, rollouts: Sequence[Rollout]) -> list[Effect]:
        """The task in progress has ended with these rollouts."""
        # The session may have ended, or the lane may have been released, while it was collected.
        kept = [each for each in rollouts if each.session == self.session and self._current.rollouts.keep(each)]
        self._current.acknowledged_version = max([self._current.acknowledged_version, *(each.version for each in kept)])
        return self._work_ended(kept)

    # ---------------------------------------------------------------- evaluating

    def next_evaluation(self) -> EvaluationTask | None:
        """The oldest order to evaluate the weights held. It is in progress until `evaluated`. None when there is none."""
        if not self._is_idle() or self._current.weights is None:
            return None
        order = self._current.evaluations.next(self._current.version)
        if order is None:
            return None
        self._current.in_progress = (order.ticket,)
        return EvaluationTask(self._current.weights, order)

    def evaluated(self, answer: Evaluated | None) -> list[Effect]:
        """The evaluation in progress has ended with this answer, or with None: it was abandoned."""
        if answer is None or answer.session != self.session or not self._current.evaluations.keep(answer):
            return self._work_ended([])
        return self._work_ended([answer])

    def evaluation_abandoned(self, session: int) -> bool:
        """True when an evaluation of this session is no longer wanted. A worker that leaves does not finish it."""
        return self.state is not State.READY or session != self.session

    # ---------------------------------------------------------------- stepping in lock-step

    def next_order(self) -> Order | None:
        """The oldest order that is not yet executed. It is in progress until `answered`."""
        if not self._is_idle():
            return None
        order = self._current.orders.next()
        self._current.in_progress = () if order is None else (order.ticket,)
        return order

    def answered(self, answer: Answer) -> list[Effect]:
        """The order in progress was executed with this answer."""
        is_wanted = answer.session == self.session and self._current.orders.keep(answer)
        return self._work_ended([answer] if is_wanted else [])

    def abandoned(self, session: int) -> bool:
        """True when the work of this session is no longer wanted."""
        return self.state in (State.JOINING, State.LEFT) or session != self.session

    def held_count(self) -> int:
        """Number of tickets and rollouts that this worker holds."""
        return len(self._current.rollouts)

    # ---------------------------------------------------------------- inside

    def _join(self, now: float) -> None:
        """Start to join, as if for the first time."""
        self._attempt += 1
        self._joining_s = self._due_s = now
        self._backoff_s = HELLO_FIRST_S
        self._current = _SessionState()

    def _welcome(self, message: Welcome, now: float) -> list[Effect]:
        if message.attempt != self._attempt or (self.state is State.READY and message.session == self.session):
            return []  # the answer to an earlier Hello, or a repeat
        self._transition(message)
        self._current = _SessionState()
        self.run, self.session = message.run, message.session
        self._unanswered_s = math.inf
        self._due_s = now + message.run.heartbeat_s
        self._join_timeout_s = self._rejoin_timeout_s
        return [StartSession(message.run)]

    def _rejoin(self, event: object, reason: str, now: float) -> list[Effect]:
        self._transition(event)
        if self.state is State.LEFT:
            return [Leave(1, reason)]
        lanes = self._current.lanes()
        self._join(now)
        return [CloseLanes(lanes), *self.tick(now)]

    def _is_idle(self) -> bool:
        """Whether this worker may start a piece of work."""
        return self.state is State.READY and not self._current.in_progress

    def _work_ended(self, messages: Sequence[ToLearner]) -> list[Effect]:
        """The work in progress has ended: send its messages, and leave if this worker drains."""
        self._current.in_progress = ()
        effects: list[Effect] = [Send(message) for message in messages]
        return effects + (self._goodbye() if self.state is State.DRAINING else [])

    def _release_unlisted(self, received: Sequence[Received]) -> list[Effect]:
        """Drop the lanes that the learner does not list: their Release was lost.

        Only a new HeartbeatReply may do so: a copy of an old message does not list the lanes that came after it.
        """
        listed = {of_lane.lane for of_lane in received}
        return self._release([lane for lane in self._current.lanes() if lane.lane not in listed])

    def _release(self, lanes: Sequence[LaneIncarnation]) -> list[Effect]:
        released = (*self._current.rollouts.release(lanes), *self._current.orders.release(lanes))
        return [CloseLanes(released)] if released else []

    def _heartbeat(self) -> Heartbeat:
        return Heartbeat(
            session=self.session,
            replies=self._current.replies,
            version=self._current.version,
            tickets=self._current.unfinished()[:MAX_TICKETS],
            steps=self._statistics.steps,
            stages=dict(self._statistics.stages),
            resident_bytes=self._statistics.resident_bytes,
        )

    def _drain(self, event: object, reason: str) -> list[Effect]:
        self._transition(event)
        self._reason = reason
        if self.state is State.LEFT:
            return [Leave(0, reason)]
        return [] if self._current.in_progress else self._goodbye()

    def _goodbye(self) -> list[Effect]:
        goodbye = Send(Goodbye(self.session, one_line(self._reason), self._current.unfinished()[:MAX_TICKETS]))
        return [goodbye, *self._leave(WorkFinished(), 0, self._reason)]

    def _leave(self, event: object, exit_code: int, reason: str) -> list[Effect]:
        self._transition(event)
        return [Leave(exit_code, reason)]

    def _transition(self, event: object) -> None:
        self.state = TABLE[self.state][type(event)]
