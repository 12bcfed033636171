"""The worker's side of the conversation. Pure: messages and `now` in, effects out; no socket, clock, thread or environment.

Rule: a rollout or an evaluation starts only when the worker has the weights that its ticket names. A lost message does no
harm, because the next Heartbeat lists all tickets and versions that this worker holds, and the learner resends what is
missing. `held.py` stores what a worker holds. A worker that is welcomed before there is a run waits in its session: it
describes environments on order, until a second Welcome contains the run. Each order lists the weights to keep; the worker
drops all others, except those that unfinished tickets name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from millrace.protocol.bounds import Stage, last_text, one_line
from millrace.protocol.messages import (
    PROTOCOL_VERSION,
    TOLD_TO_STOP,
    Answer,
    Call,
    Collect,
    Describe,
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
    Permit,
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
from millrace.protocol.specs import RunSpec, StepSpec, WaitSpec
from millrace.workers.conversation.connection_rules import REJOIN_TIMEOUT_S
from millrace.workers.conversation.held import HeldDescriptions, HeldEvaluations, HeldOrders, HeldRollouts
from millrace.workers.conversation.worker_states import (
    TABLE,
    LearnerSilent,
    StopRequested,
    WorkerFailed,
    WorkerState,
    WorkFinished,
)
from millrace.workers.exit_codes import EXIT_UNSUITABLE

HELLO_FIRST_S = 0.25
HELLO_MOST_S = 4.0
NO_LEARNER = "no learner answered"


@dataclass(frozen=True)
class SendMessage:
    """Effect: send this message."""

    message: ToLearner


@dataclass(frozen=True)
class StartSession:
    """Effect: a new session starts; close every env copy of the previous one."""

    run: WaitSpec | RunSpec | StepSpec


@dataclass(frozen=True)
class BeginRun:
    """Effect: begin the run for which this session has waited."""

    run: RunSpec | StepSpec


@dataclass(frozen=True)
class CloseLanes:
    """Effect: close the env copies of these lanes."""

    lanes: tuple[LaneIncarnation, ...]


@dataclass(frozen=True)
class Leave:
    """Effect: the conversation is over; end the worker with this exit code."""

    exit_code: int
    reason: str


WorkerEffect = SendMessage | StartSession | BeginRun | CloseLanes | Leave


@dataclass(frozen=True)
class RolloutTask:
    """Rollouts to collect together, all with these weights."""

    session: int
    weights: Weights
    permits: tuple[Permit, ...]
    held: Mapping[int, Weights]
    """All available weights, by version, including those of opponents."""


@dataclass(frozen=True)
class EvaluationTask:
    """Episodes to play with these weights."""

    weights: Weights
    order: Evaluate
    held: Mapping[int, Weights]
    """All available weights, by version."""

    @property
    def session(self) -> int:
        """The session of the order."""
        return self.order.session


@dataclass(frozen=True)
class SharedOrders:
    """Orders of a vector environment that arrive through shared memory, not as messages."""

    session: int


Work = Describe | RolloutTask | EvaluationTask | Order
WorkAnswer = Rollout | Evaluated | Described | Answer


@dataclass(frozen=True)
class WorkerIdentity:
    """The identity of this worker: its name, host and process."""

    worker: str
    host: str
    pid: int
    process_nonce: int
    """random number that distinguishes this process, or thread, from any other with the same name"""
    software: str
    evaluates: bool = False
    """whether the worker only plays evaluations"""

    def hello(self, attempt: int) -> Hello:  # rules HELLO, PROTOCOL
        """The Hello for this attempt to join.

        Attempts are counted from the nonce, so that no two processes use the same number.
        """
        return Hello(
            PROTOCOL_VERSION,
            worker=self.worker,
            host=self.host,
            pid=self.pid,
            process_nonce=self.process_nonce,
            software=self.software,
            attempt=attempt,
            evaluates=self.evaluates,
            continues=True,
        )


@dataclass(frozen=True)
class Statistics:
    """Figures about the worker that a Heartbeat reports."""

    steps: int = 0
    """env steps since the worker started"""
    stages: Mapping[Stage, float] = field(default_factory=dict)
    """seconds spent in each stage since the worker started"""
    resident_bytes: int = 0
    """resident memory of this process"""
    note: str = ""
    """what the user should know about the environment"""


@dataclass
class _SessionState:
    """The state of one session. A new object is made for each session."""

    descriptions: HeldDescriptions = field(default_factory=HeldDescriptions)
    rollouts: HeldRollouts = field(default_factory=HeldRollouts)
    evaluations: HeldEvaluations = field(default_factory=HeldEvaluations)
    orders: HeldOrders = field(default_factory=HeldOrders)
    weights: dict[int, Weights] = field(default_factory=dict)  # keys are versions
    in_progress: bool = False  # whether a piece of work is in progress
    replies: int = 0  # number of the last HeartbeatReply received

    def unfinished(self) -> tuple[int, ...]:  # rule HEARTBEAT_TICKETS
        """Tickets that have not been collected or executed yet."""
        return (*self.descriptions.asked, *self.rollouts.tickets(), *self.evaluations.asked, *self.orders.tickets())

    def lanes(self) -> tuple[LaneIncarnation, ...]:
        """The lanes of this worker."""
        return (*self.rollouts.lanes(), *self.orders.lanes())

    def next_work(self, session: int) -> Work | None:  # rule EVALUATIONS_FIRST
        """The next piece of work: a description; if none is due, an evaluation; then rollouts to collect together; then an
        order. None if there is none.
        """
        if (description := self.descriptions.next()) is not None:
            return description
        if (evaluation := self.evaluations.next(self.weights)) is not None:
            return EvaluationTask(self.weights[evaluation.version], evaluation, self.weights)
        version, permits = self.rollouts.startable(self.weights)
        if not permits:
            return self.orders.next()
        return RolloutTask(session, self.weights[version], permits, self.weights)

    def asked_versions(self) -> set[int]:
        """Versions of the weights that unfinished tickets name."""
        return self.rollouts.versions() | self.evaluations.versions()

    def missing_versions(self) -> set[int]:
        """Versions of the weights that unfinished tickets name, and that this worker doesn't have."""
        return self.asked_versions().difference(self.weights)

    def keep_weights(self, listed: Sequence[int]) -> None:  # rule HOLDS_WEIGHTS
        """Drop the weights that an order does not list, unless unfinished tickets name them.

        The exception matters if a late copy of an old order arrives.
        """
        kept = self.asked_versions().union(listed)
        self.weights = {version: weights for version, weights in self.weights.items() if version in kept}

    def keep(self, answer: WorkAnswer) -> bool:
        """Keep the answer to a piece of work. Returns False if it is no longer wanted, for example because its lane has been
        released.
        """
        match answer:
            case Rollout():
                return self.rollouts.keep(answer)
            case Evaluated():
                return self.evaluations.keep(answer)
            case Described():
                return self.descriptions.keep(answer)
        return self.orders.keep(answer)

    def release(self, lanes: Sequence[LaneIncarnation]) -> list[WorkerEffect]:  # rule RELEASE
        """Drop these lanes. Returns the effect that closes their env copies, if any lane was open."""
        released = (*self.rollouts.release(lanes), *self.orders.release(lanes))
        return [CloseLanes(released)] if released else []

    def release_unlisted(self, received: Sequence[Received]) -> list[WorkerEffect]:  # rule UNLISTED
        """Drop the lanes that the learner does not list, because their Release was lost.

        Call this only for a new HeartbeatReply, because a copy of an old one doesn't list lanes that were added later.
        """
        listed = {of_lane.lane for of_lane in received}
        return self.release([lane for lane in self.lanes() if lane.lane not in listed])


class Session:
    """State machine of one worker, from its first Hello until it leaves. Call `tick` no later than at `due_s`."""

    def __init__(
        self,
        identity: WorkerIdentity,
        now: float,
        *,
        join_timeout_s: float = 60.0,
        rejoin_timeout_s: float = REJOIN_TIMEOUT_S,
    ) -> None:
        self.identity = identity
        self.state = WorkerState.JOINING
        self.run: WaitSpec | RunSpec | StepSpec | None = None
        self.session = 0
        self._statistics = Statistics()
        self._join_timeout_s = join_timeout_s
        self._rejoin_timeout_s = rejoin_timeout_s
        self._attempt = identity.process_nonce
        self._unanswered_s = math.inf  # time of the first Heartbeat after the learner's last message
        self.due_s = self._joining_s = now
        self._backoff_s = HELLO_FIRST_S
        self._reason = ""
        self._current = _SessionState()
        self._join(now)

    # ---------------------------------------------------------------- messages and time

    def handle(self, message: ToWorker, now: float) -> list[WorkerEffect]:
        """Handle a message from the learner."""
        if isinstance(message, Drain):  # a Drain also answers the heartbeats of a worker that is already draining
            self._unanswered_s = math.inf
        if type(message) not in TABLE[self.state]:
            return []
        if not isinstance(message, Welcome) and getattr(message, "session", self.session) != self.session:
            return []  # the message is for an earlier session of this worker
        match message:
            case Welcome():
                return self._welcome(message, now)
            case Refuse(reason):
                return self.refused(reason)
            case Drain(reason):
                return self._drain(message, reason)
            case Rejoin():
                return self._rejoin(message, "the learner does not know this session", now)
        self._unanswered_s = math.inf
        current = self._current
        again: list[WorkAnswer | None] = []
        match message:
            case Describe() if isinstance(self.run, WaitSpec):
                again = [current.descriptions.take(message.ticket, message)]
            case Weights(version):
                current.weights.setdefault(version, message)  # rule HELD_ALREADY
            case Collect(_, version, permits, received) if isinstance(self.run, RunSpec):
                current.rollouts.forget_received(received)
                again = [current.rollouts.take(permit, version) for permit in permits]
                current.keep_weights(message.keep)
            case Evaluate() if isinstance(self.run, RunSpec):
                again = [current.evaluations.take(message.ticket, message)]
                current.keep_weights(message.keep)
            case Reset() | Step() | Call() if isinstance(self.run, StepSpec):
                again = [current.orders.take(message)]
            case Release(_, lanes):
                return current.release(lanes)
            case HeartbeatReply(_, number, received) if number > current.replies:  # rule LATE_REPLY
                current.replies = number
                current.rollouts.forget_received(received)
                return current.release_unlisted(received)
        return [SendMessage(answer) for answer in again if answer is not None]

    def tick(self, now: float) -> list[WorkerEffect]:
        """Do whatever is due now: send a Hello or a Heartbeat, or give up on a silent learner."""
        match self.state:
            case WorkerState.LEFT:
                return []
            case WorkerState.JOINING:
                if now - self._joining_s > self._join_timeout_s:
                    return self._leave(LearnerSilent(), 1, f"{NO_LEARNER} for {self._join_timeout_s:g} s")
                if now < self.due_s:
                    return []
                self.due_s = now + self._backoff_s
                self._backoff_s = min(2 * self._backoff_s, HELLO_MOST_S)  # rule HELLO_AGAIN
                return [SendMessage(self.identity.hello(self._attempt))]
        assert self.run is not None
        if now - self._unanswered_s > self.run.learner_timeout_s:  # rule SILENT
            return self._rejoin(LearnerSilent(), f"the learner was silent for {self.run.learner_timeout_s:.0f} s", now)
        return self.heartbeat_if_due(now)

    def heartbeat_if_due(self, now: float) -> list[WorkerEffect]:  # rule HEARTBEAT
        """The effect that sends a Heartbeat, if one is due. Nothing else changes, so this may be called at any moment."""
        if self.run is None or self.state not in (WorkerState.READY, WorkerState.DRAINING) or now < self.due_s:
            return []
        self.due_s = now + self.run.heartbeat_s
        self._unanswered_s = min(self._unanswered_s, now)
        current = self._current
        statistics = self._statistics
        heartbeat = Heartbeat(
            session=self.session,
            replies=current.replies,
            versions=tuple(sorted(current.weights)),  # rule HEARTBEAT_VERSIONS
            tickets=current.unfinished(),
            steps=statistics.steps,  # rule HEARTBEAT_STEPS
            stages=dict(statistics.stages),
            resident_bytes=statistics.resident_bytes,
            note=statistics.note,
            waits=isinstance(self.run, WaitSpec),
        )
        return [SendMessage(heartbeat)]

    def update_statistics(self, statistics: Statistics) -> None:
        """Set the figures that the next Heartbeat reports."""
        self._statistics = statistics

    # ---------------------------------------------------------------- leaving

    def stop(self) -> list[WorkerEffect]:
        """Leave after the work in progress, or, if this is the second call, immediately."""
        return [] if self.state is WorkerState.LEFT else self._drain(StopRequested(), TOLD_TO_STOP)

    def fail(self, error: str, traceback: str, lane: int | None, *, of_policy: bool = False) -> list[WorkerEffect]:
        """Report to the learner that the environment, a user-defined policy (`of_policy`), or this worker's own code
        raised an exception, and leave.
        """
        error = one_line(error)
        failure = Failure(self.session, error, last_text(traceback), lane, of_policy)
        return self._leave(WorkerFailed(), 1, error, failure)

    def decline(self, reason: str, exit_code: int = EXIT_UNSUITABLE) -> list[WorkerEffect]:  # rule DECLINED
        """Leave a run in which this worker can't take part. Pass another `exit_code` if it may be able to later."""
        return self._leave(WorkerFailed(), exit_code, reason, Goodbye(self.session, one_line(reason), ()))

    def refused(self, reason: str) -> list[WorkerEffect]:  # rules REFUSE, AFTER_REFUSE
        """Leave, because the learner, or its endpoint, permanently rejects this worker."""
        return self._leave(Refuse(reason), 2, reason)

    # ---------------------------------------------------------------- working

    def next_work(self) -> Work | None:
        """Begin the next piece of work, and return it. It is in progress until `work_ended` is called.

        None if there is no work, or a piece of work is in progress.
        """
        if self.state is not WorkerState.READY or self._current.in_progress:
            return None
        work = self._current.next_work(self.session)
        self._current.in_progress = work is not None
        return work

    def missing_versions(self) -> set[int]:
        """Versions of the weights that this worker needs for its tickets, and doesn't have."""
        return self._current.missing_versions()

    def work_ended(self, answers: Sequence[WorkAnswer]) -> list[WorkerEffect]:
        """End the work in progress, and send its answers; there are none if the work was abandoned.

        A draining worker then leaves.
        """
        current = self._current
        # In the meantime, the session may have ended, or the lane may have been released.
        kept = [each for each in answers if each.session == self.session and current.keep(each)]
        current.in_progress = False
        return [*map(SendMessage, kept), *self._leave_if_drained()]

    def is_unwanted(self, work: Work | SharedOrders) -> bool:
        """Whether this work is no longer wanted. A draining worker finishes its rollouts, but not an evaluation."""
        goes_on = (WorkerState.READY,) if isinstance(work, EvaluationTask) else (WorkerState.READY, WorkerState.DRAINING)
        return self.state not in goes_on or work.session != self.session

    # ---------------------------------------------------------------- inside

    def _join(self, now: float) -> None:  # rules REJOIN, FORGETS
        """Start to join as if for the first time, and forget everything that this worker holds."""
        self._attempt += 1
        self._joining_s = self.due_s = now
        self._backoff_s = HELLO_FIRST_S
        self._current = _SessionState()

    def _welcome(self, message: Welcome, now: float) -> list[WorkerEffect]:
        if message.attempt != self._attempt:  # rule WELCOME_ATTEMPT
            return []  # the answer to an earlier Hello
        if self.state is WorkerState.READY and message.session == self.session:
            return self._welcome_again(message.run, now)
        self.state = TABLE[self.state][type(message)]
        self._current = _SessionState()
        self.run = message.run
        self.session = message.session  # rule SESSION
        self._unanswered_s = math.inf
        self.due_s = now + message.run.heartbeat_s
        self._join_timeout_s = self._rejoin_timeout_s
        return [StartSession(message.run)]

    # rules REPEATED_WELCOME, BEGINS
    def _welcome_again(self, run: WaitSpec | RunSpec | StepSpec, now: float) -> list[WorkerEffect]:
        """Handle another Welcome of this session. Either the run for which this worker waits has begun, or the Welcome is a
        repeat; a repeat is ignored.
        """
        if not isinstance(self.run, WaitSpec) or isinstance(run, WaitSpec):
            return []
        self.run = run
        self._unanswered_s = math.inf
        self.due_s = min(self.due_s, now + run.heartbeat_s)
        self._current.descriptions = HeldDescriptions()  # unfinished descriptions are no longer wanted
        return [BeginRun(run)]

    def _rejoin(self, event: object, reason: str, now: float) -> list[WorkerEffect]:
        self.state = TABLE[self.state][type(event)]
        if self.state is WorkerState.LEFT:
            return [Leave(1, reason)]
        lanes = self._current.lanes()
        self._join(now)
        return [CloseLanes(lanes), *self.tick(now)]

    def _drain(self, event: object, reason: str) -> list[WorkerEffect]:
        self.state = TABLE[self.state][type(event)]
        self._reason = reason
        return [Leave(0, reason)] if self.state is WorkerState.LEFT else self._leave_if_drained()

    def _leave_if_drained(self) -> list[WorkerEffect]:  # rule DRAIN
        if self.state is not WorkerState.DRAINING or self._current.in_progress:
            return []
        goodbye = Goodbye(self.session, self._reason, self._current.unfinished())
        return self._leave(WorkFinished(), 0, self._reason, goodbye)

    # rule AFTER_GOODBYE
    def _leave(self, event: object, exit_code: int, reason: str, last: ToLearner | None = None) -> list[WorkerEffect]:
        """Leave, unless the worker has left already. The message `last` is sent only if there is a session."""
        if self.state is WorkerState.LEFT:
            return []
        said = [] if last is None or self.state is WorkerState.JOINING else [SendMessage(last)]
        self.state = TABLE[self.state][type(event)]
        return [*said, Leave(exit_code, reason)]
