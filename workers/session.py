"""The worker's half of the conversation. Pure: messages and `now` in, effects out; no socket, clock, thread or environment.

The law: a ticket is collected once and its rollout is kept until the learner says it has it; asked again for it, the same
rollout is said again. A rollout starts only under weights at least as new as its ticket asks for. Whatever is lost on the
way is repaired by the next Heartbeat, because it lists all that this worker holds.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from protocol.messages import (
    PROTOCOL_VERSION,
    Answer,
    Call,
    Collect,
    Drain,
    Failure,
    Goodbye,
    Heartbeat,
    HeartbeatReply,
    Hello,
    LaneLife,
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
from protocol.specs import RunSpec, StepSpec
from workers.states import TABLE, Broke, Emptied, Silence, State, Terminate
from workers.step.orders import Orders

HELLO_FIRST_S, HELLO_MOST_S = 0.25, 4.0
NO_LEARNER = "no learner answered"
REMEMBERED_TICKETS = 64  # finished ones, so that a late repeat of their Collect is known for what it is


@dataclass(frozen=True)
class Say:
    """Effect: send this."""

    message: ToLearner


@dataclass(frozen=True)
class Begin:
    """Effect: a new session; forget every env copy of the last one."""

    run: RunSpec | StepSpec


@dataclass(frozen=True)
class Close:
    """Effect: close the env copies of these lanes."""

    lanes: tuple[LaneLife, ...]


@dataclass(frozen=True)
class Leave:
    """Effect: the conversation is over."""

    exit_code: int
    reason: str


Effect = Say | Begin | Close | Leave


@dataclass(frozen=True)
class Assignment:
    """One rollout to collect."""

    ticket: int
    lane: int
    incarnation: int
    """if it is not the one that lives here, the lane begins afresh"""
    sequence: int


@dataclass(frozen=True)
class Task:
    """Rollouts to collect side by side, all under these weights."""

    session: int
    weights: Weights
    assignments: tuple[Assignment, ...]


@dataclass(frozen=True)
class Identity:
    """Who this worker is."""

    worker: str
    host: str
    pid: int
    life: int
    """drawn at random: no two processes, or threads, have the same"""
    software: str


@dataclass
class _Lane:
    incarnation: int
    sequence: int = 0
    held: dict[int, int] = field(default_factory=dict)  # ticket -> oldest version that will do
    kept: dict[int, Rollout] = field(default_factory=dict)  # ticket -> finished, and not known to have arrived
    done: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED_TICKETS))


@dataclass
class _Stay:
    """What is held within one session; nothing of it outlives the session."""

    lanes: dict[int, _Lane] = field(default_factory=dict)
    orders: Orders = field(default_factory=Orders)
    weights: Weights | None = None
    in_hand: tuple[int, ...] = ()  # tickets being collected
    replies: int = 0
    said_version: int = -1  # newest version that a message of ours has named

    @property
    def version(self) -> int:
        return -1 if self.weights is None else self.weights.version


class Session:
    """One worker's side, from its first Hello to its last word."""

    def __init__(
        self, identity: Identity, now: float, *, join_timeout_s: float = 60.0, rejoin_timeout_s: float = 600.0
    ) -> None:
        self.identity = identity
        self.state = State.JOINING
        self.run: RunSpec | StepSpec | None = None
        self.session = 0
        self.steps = 0
        """env steps since the worker started; the shell keeps it"""
        self.stages: dict[str, float] = {}
        """seconds in each stage; the shell keeps it"""
        self.resident_bytes = 0
        """memory of this process; the shell keeps it"""
        self._patience_s = join_timeout_s
        self._rejoin_timeout_s = rejoin_timeout_s
        self._attempt = 0
        self._heard_s = self._due_s = self._joining_s = now
        self._backoff_s = HELLO_FIRST_S
        self._reason = ""
        self._stay = _Stay()
        self._join(now)

    # ---------------------------------------------------------------- in

    def handle(self, message: ToWorker, now: float) -> list[Effect]:
        """What the learner said."""
        if isinstance(message, Drain):  # said again to one that drains already: a sign of life
            self._heard_s = now
        if type(message) not in TABLE[self.state]:
            return []
        if not isinstance(message, Welcome) and getattr(message, "session", self.session) != self.session:
            return []  # said to an earlier session of ours
        match message:
            case Welcome():
                return self._welcome(message, now)
            case Refuse(reason):
                return self._leave(message, 2, reason)
            case Drain(reason):
                return self._drain(message, reason)
            case Rejoin():
                return self._rejoin(message, "the learner does not know this session", now)
        self._heard_s = now
        match message:
            case Weights(version):
                if version > self._stay.version:
                    self._stay.weights = message
            case Collect(_, version, permits, received) if isinstance(self.run, RunSpec):
                closed = self._arrived(received)
                return closed + [effect for permit in permits for effect in self._permit(permit, version)]
            case Reset() | Step() | Call() if isinstance(self.run, StepSpec):
                return [Say(answer) for answer in self._stay.orders.take(message)]
            case Release(_, lanes):
                return self._release(lanes)
            case HeartbeatReply(_, number, received):
                self._stay.replies = max(number, self._stay.replies)
                return self._arrived(received)
        return []

    def tick(self, now: float) -> list[Effect]:
        """What is due: Hello, Heartbeat (also to acknowledge new weights), or giving up on a silent learner."""
        match self.state:
            case State.LEFT:
                return []
            case State.JOINING:
                if now - self._joining_s > self._patience_s:
                    return self._leave(Silence(), 1, f"{NO_LEARNER} for {self._patience_s:g} s")
                if now < self._due_s:
                    return []
                self._due_s = now + self._backoff_s
                self._backoff_s = min(2 * self._backoff_s, HELLO_MOST_S)
                who = self.identity
                return [Say(Hello(PROTOCOL_VERSION, who.worker, who.host, who.pid, who.life, who.software, self._attempt))]
        assert self.run is not None
        if now - self._heard_s > self.run.learner_timeout_s:
            return self._rejoin(Silence(), f"the learner was silent for {self.run.learner_timeout_s:.0f} s", now)
        return self.breathe(now)

    def breathe(self, now: float) -> list[Effect]:
        """A Heartbeat, if one is due; nothing else comes of it, so that it may be said in the middle of anything."""
        if self.run is None or self.state not in (State.READY, State.DRAINING):
            return []
        if now < self._due_s and self._stay.said_version == self._stay.version:
            return []
        self._due_s = now + self.run.heartbeat_s
        self._stay.said_version = self._stay.version
        return [Say(self._heartbeat())]

    def next_due_s(self) -> float:
        """When `tick` wants to be called at the latest."""
        return self._due_s

    def terminate(self) -> list[Effect]:
        """Leave: after the rollout in hand, or at once when asked twice."""
        return [] if self.state is State.LEFT else self._drain(Terminate(), "told to stop")

    def broke(self, error: str, traceback: str, lane: int | None) -> list[Effect]:
        """The environment, or this worker, raised: tell the learner, and leave."""
        told: list[Effect] = []
        if self.state in (State.READY, State.DRAINING):
            told.append(Say(Failure(self.session, error, traceback, lane)))
        return [] if self.state is State.LEFT else told + self._leave(Broke(), 1, error)

    def decline(self, reason: str) -> list[Effect]:
        """Leave a run that this worker will not take part in."""
        return [Say(Goodbye(self.session, reason, ())), *self._leave(Broke(), 2, reason)]

    def turned_away(self, reason: str) -> list[Effect]:
        """The learner's end does not let this worker in, and will not."""
        return [] if self.state is State.LEFT else self._leave(Refuse(reason), 2, reason)

    # ---------------------------------------------------------------- collecting

    def next_task(self) -> Task | None:
        """The oldest startable ticket of every lane, to be collected together; None when there is none."""
        if self.state is not State.READY or self._stay.weights is None or self._stay.in_hand:
            return None
        chosen = []
        for number, lane in sorted(self._stay.lanes.items()):
            startable = [ticket for ticket, version in lane.held.items() if version <= self._stay.version]
            if startable:
                chosen.append(Assignment(min(startable), number, lane.incarnation, lane.sequence))
        if not chosen:
            return None
        self._stay.in_hand = tuple(assignment.ticket for assignment in chosen)
        return Task(self.session, self._stay.weights, tuple(chosen))

    def finished(self, rollouts: Sequence[Rollout]) -> list[Effect]:
        """The task in hand is done."""
        self._stay.in_hand = ()
        effects: list[Effect] = []
        for rollout in rollouts:
            lane = self._stay.lanes.get(rollout.lane)
            if rollout.session != self.session or lane is None or rollout.ticket not in lane.held:
                continue  # the session ended, or the lane was released, while it was collected
            del lane.held[rollout.ticket]
            lane.kept[rollout.ticket] = rollout
            lane.sequence += 1
            self._stay.said_version = max(self._stay.said_version, rollout.version)
            effects.append(Say(rollout))
        if self.state is State.DRAINING:
            effects += self._goodbye()
        return effects

    # ---------------------------------------------------------------- stepping in lock-step

    def next_order(self) -> Order | None:
        """The oldest order that is not obeyed yet; it is in hand until `answered`."""
        if self.state is not State.READY or self._stay.in_hand:
            return None
        order = self._stay.orders.next()
        self._stay.in_hand = () if order is None else (order.ticket,)
        return order

    def answered(self, answer: Answer) -> list[Effect]:
        """The order in hand is obeyed."""
        self._stay.in_hand = ()
        said: list[Effect] = [Say(answer)] if answer.session == self.session and self._stay.orders.obeyed(answer) else []
        return said + (self._goodbye() if self.state is State.DRAINING else [])

    def abandoned(self, session: int) -> bool:
        """True when nobody wants any more what was asked for in this session."""
        return self.state in (State.JOINING, State.LEFT) or session != self.session

    def in_memory(self) -> int:
        """How many tickets and rollouts are held: at most what the learner has outstanding, so memory is bounded."""
        return sum(len(lane.held) + len(lane.kept) for lane in self._stay.lanes.values())

    # ---------------------------------------------------------------- inside

    def _join(self, now: float) -> None:
        """Begin to join, as if for the first time."""
        self._attempt += 1
        self._joining_s = self._due_s = now
        self._backoff_s = HELLO_FIRST_S
        self._stay = _Stay()

    def _welcome(self, message: Welcome, now: float) -> list[Effect]:
        if message.attempt != self._attempt or (self.state is State.READY and message.session == self.session):
            return []  # an answer to an earlier Hello, or a repeat
        self._become(message)
        self._stay = _Stay()
        self.run, self.session = message.run, message.session
        self._heard_s = now
        self._due_s = now + message.run.heartbeat_s
        self._patience_s = self._rejoin_timeout_s
        return [Begin(message.run)]

    def _rejoin(self, event: object, reason: str, now: float) -> list[Effect]:
        self._become(event)
        if self.state is State.LEFT:
            return [Leave(1, reason)]
        closing = tuple(LaneLife(number, lane.incarnation) for number, lane in self._stay.lanes.items())
        closing += self._stay.orders.lives()
        self._join(now)
        return [Close(closing), *self.tick(now)]

    def _permit(self, permit: Permit, version: int) -> list[Effect]:
        lane = self._stay.lanes.get(permit.lane)
        if lane is None or permit.incarnation > lane.incarnation:
            lane = self._stay.lanes[permit.lane] = _Lane(permit.incarnation)
        if permit.incarnation < lane.incarnation or permit.ticket in lane.held or permit.ticket in lane.done:
            return []
        if permit.ticket in lane.kept:
            return [Say(lane.kept[permit.ticket])]
        lane.held[permit.ticket] = version
        return []

    def _arrived(self, received: Sequence[Received]) -> list[Effect]:
        """Let go of the rollouts that the learner has, and of lanes that live elsewhere (a Release was lost)."""
        for theirs in received:
            lane = self._stay.lanes.get(theirs.lane)
            if lane is None or lane.incarnation != theirs.incarnation:
                continue
            for ticket, rollout in list(lane.kept.items()):
                if rollout.sequence < theirs.below or rollout.sequence in theirs.ahead:
                    del lane.kept[ticket]
                    lane.done.append(ticket)
        mine = {theirs.lane for theirs in received}
        here = [LaneLife(number, lane.incarnation) for number, lane in self._stay.lanes.items()]
        return self._release([life for life in (*here, *self._stay.orders.lives()) if life.lane not in mine])

    def _release(self, lives: Sequence[LaneLife]) -> list[Effect]:
        gone = []
        for life in lives:
            lane = self._stay.lanes.get(life.lane)
            if lane is not None and lane.incarnation <= life.incarnation:
                del self._stay.lanes[life.lane]
                gone.append(LaneLife(life.lane, lane.incarnation))
        gone += self._stay.orders.release(lives)
        return [Close(tuple(gone))] if gone else []

    def _heartbeat(self) -> Heartbeat:
        return Heartbeat(
            session=self.session,
            replies=self._stay.replies,
            version=self._stay.version,
            tickets=self._unfinished(),
            steps=self.steps,
            stages=dict(self.stages),
            resident_bytes=self.resident_bytes,
        )

    def _drain(self, event: object, reason: str) -> list[Effect]:
        self._become(event)
        self._reason = reason
        if self.state is State.LEFT:
            return [Leave(0, reason)]
        return [] if self._stay.in_hand else self._goodbye()

    def _goodbye(self) -> list[Effect]:
        said = Say(Goodbye(self.session, self._reason, self._unfinished()))
        return [said, *self._leave(Emptied(), 0, self._reason)]

    def _unfinished(self) -> tuple[int, ...]:
        return (*(ticket for lane in self._stay.lanes.values() for ticket in lane.held), *self._stay.orders.held())

    def _leave(self, event: object, exit_code: int, reason: str) -> list[Effect]:
        self._become(event)
        return [Leave(exit_code, reason)]

    def _become(self, event: object) -> None:
        self.state = TABLE[self.state][type(event)]
