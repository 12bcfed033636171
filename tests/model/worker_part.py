"""A worker of the model: a real `Session`, the rollouts in progress, and what happened to the process.

Rule: a session is taken apart into plain tuples and put together again, as the learner is. After each event the worker does
what its program does: give up work that nobody wants, start the next work, send what is due. To finish work is an event.
"""

from __future__ import annotations

from dataclasses import dataclass

from protocol.messages import HeartbeatReply, ToLearner, ToWorker
from tests.model.conversation import Content, Event
from tests.model.message_content import incarnation, rollout_content, rollout_of, session, ticket, weights
from tests.model.names import ATTEMPTS, MASK, Kind, name
from tests.model.settings import FOR_EVER_S, TIMEOUT_S, Settings
from tests.support.conversation.fake_ends import fake_evaluated, fake_rollouts, held_count
from workers.conversation.held import Assignment, HeldRollouts, Permitted, RolloutLane
from workers.conversation.session import (
    EvaluationTask,
    Leave,
    RolloutTask,
    SendMessage,
    Session,
    WorkerEffect,
    WorkerIdentity,
    _SessionState,
)
from workers.conversation.worker_states import WorkerState

SAVED: dict[type, set[str]] = {
    Session: {"identity", "state", "run", "session", "_attempt", "_unanswered_s", "due_s", "_current"},
    _SessionState: {"rollouts", "weights", "in_progress", "replies"},
    HeldRollouts: {"_lanes"},
    RolloutLane: {"incarnation", "sequence", "asked", "answered"},
}
NOT_SAVED: dict[type, set[str]] = {
    Session: {"_statistics", "_join_timeout_s", "_rejoin_timeout_s", "_joining_s", "_backoff_s", "_reason"},
    _SessionState: {"evaluations", "orders", "described"},
    HeldRollouts: set(),
    RolloutLane: set(),
}
PAUSE_S = 0.5  # between two Hellos: one in every tick


@dataclass
class Worker:
    """One state of a worker, which an event changes."""

    settings: Settings
    number: int
    nonce: int
    """of its process; a later process has a larger one"""
    session: Session | None = None
    """None: its process has ended"""
    task: RolloutTask | EvaluationTask | None = None
    frozen: bool = False
    shut_out: bool = False
    """whether its key was revoked: the learner hears nothing of it"""

    # ---------------------------------------------------------------- events

    def start(self, now: float) -> list[ToLearner]:
        """A new process starts under the same name."""
        self.nonce += ATTEMPTS
        self.shut_out = False
        who = WorkerIdentity(f"w{self.number}", "host", 1, self.nonce, "model")
        self.session = Session(who, now, join_timeout_s=FOR_EVER_S, rejoin_timeout_s=FOR_EVER_S)
        return self._turn([], now)

    def end(self) -> None:
        """The process is killed, or leaves."""
        self.session = self.task = None
        self.frozen = False

    def handle(self, message: ToWorker, now: float) -> list[ToLearner]:
        assert self.session is not None
        held = self.session._current
        replies, before = held.replies, set(held.weights)
        effects = self.session.handle(message, now)
        assert (before & _needed(held, before)).issubset(held.weights), "a worker drops weights that it needs"
        if isinstance(message, HeartbeatReply) and held.replies > replies:
            listed = {each.lane for each in message.received}
            assert all(lane.lane in listed for lane in held.lanes()), "a worker keeps a lane that is not its own"
        return self._turn(effects, now)

    def finish(self, now: float) -> list[ToLearner]:
        assert self.session is not None
        assert self.task is not None
        task, self.task = self.task, None
        answers = fake_rollouts(task) if isinstance(task, RolloutTask) else [fake_evaluated(task)]
        held = self.session._current
        before = set(held.weights)
        effects = self.session.work_ended(answers)
        assert set(held.weights) == before & _needed(held, before), (
            "a worker keeps other weights than the newest and those named"
        )
        return self._turn(effects, now)

    def turn(self, now: float) -> list[ToLearner]:
        """Time has passed."""
        return [] if self.session is None or self.frozen else self._turn([], now)

    def refused(self, now: float) -> list[ToLearner]:
        """The learner's endpoint rejects its key."""
        assert self.session is not None
        return self._turn(self.session.refused("its key was revoked"), now)

    def event(self, event: Event, message: ToWorker | None, now: float) -> list[ToLearner]:
        """What the worker says after this event. `message`: what it handles, if anything."""
        match event:
            case "handle", _:
                assert message is not None
                return self.handle(message, now)
            case ("start",):
                return self.start(now)
            case ("finish",):
                return self.finish(now)
            case ("time",):
                return self.turn(now)
            case ("told",):
                return self.refused(now)
            case ("end",):
                self.end()
            case ("shut out",):
                self.shut_out = True
            case ("freeze",) | ("thaw",):
                self.frozen = event == ("freeze",)
        return []

    # ---------------------------------------------------------------- inside

    def _begin(self, work: RolloutTask | EvaluationTask) -> list[ToLearner]:
        """What the worker says when this work begins."""
        self.task = work
        if isinstance(work, RolloutTask):
            assert self.session is not None
            held, version = self.session._current, work.weights.version
            lanes = held.rollouts._lanes
            for each in work.assignments:
                lane = lanes[each.lane]
                assert each.sequence == lane.sequence, "rollouts of a lane are not collected in their order"
                assert lane.asked[each.ticket] == (each.sequence, version), "other weights act than the order names"
            startable = [
                asked.version
                for lane in lanes.values()
                for asked in lane.asked.values()
                if asked.sequence == lane.sequence and asked.version in held.weights
            ]
            lowest = [each for each in startable if each == min(startable)]
            assert [version] * len(work.assignments) == lowest, "others are collected than all of the lowest version"
        return []

    def _turn(self, effects: list[WorkerEffect], now: float) -> list[ToLearner]:
        current = self.session
        assert current is not None
        if self.task is not None and current.is_unwanted(self.task):
            self.task = None
            effects = effects + current.work_ended([])
        work = current.next_work()
        if work is not None:
            assert self.task is None, "a worker does two pieces of work at the same time"
            assert isinstance(work, RolloutTask | EvaluationTask)
            effects = effects + [SendMessage(said) for said in self._begin(work)]
        effects = effects + current.tick(now)
        rounds = 1 + self.settings.max_lag
        most, held = self.settings.lanes * rounds, held_count(current)
        assert held <= most, f"a worker holds {held} rollouts, of at most {most}"
        versions = len(current._current.weights)
        assert versions <= rounds + 1, f"a worker holds {versions} versions, of at most {rounds + 1}"
        sent: list[ToLearner] = []
        for effect in effects:
            if isinstance(effect, SendMessage):
                sent.append(effect.message)
            if isinstance(effect, Leave):
                self.end()
        return sent


# -------------------------------------------------------------------- to tuples and back


def saved(worker: Worker, now: float) -> Content:
    nonce = name(Kind.NONCE, worker.nonce, worker.number)
    flags = worker.frozen, worker.shut_out
    current = worker.session
    if current is None:
        return nonce, flags, None, None
    held = current._current
    fields = (
        current.state,
        None if current.run is None else session(current.session),
        name(Kind.ATTEMPT, current._attempt, worker.number),
        max(current._unanswered_s - now, -TIMEOUT_S - 1.0),
        max(current.due_s - now, 0.0),
        tuple(_lane(number, lane) for number, lane in held.rollouts._lanes.items()),
        tuple(sorted(held.weights)),
        held.in_progress,
        None if current.run is None else name(Kind.REPLIES, held.replies, current.session),
    )
    task = worker.task
    if not isinstance(task, RolloutTask):
        return nonce, flags, fields, None
    return nonce, flags, fields, (session(task.session), task.weights.version, tuple(_work(a) for a in task.assignments))


def _needed(held: _SessionState, before: set[int]) -> set[int]:
    """The versions that a worker needs: the newest that has come, and those that unfinished tickets name."""
    rollouts = {asked.version for lane in held.rollouts._lanes.values() for asked in lane.asked.values()}
    evaluations = {order.version for order in held.evaluations.asked.values()}
    return rollouts | evaluations | {max({*before, *held.weights}, default=-1)}


def _lane(number: int, lane: RolloutLane) -> Content:
    tickets = tuple((ticket(each), *permitted) for each, permitted in sorted(lane.asked.items()))
    kept = tuple(rollout_content(rollout) for rollout in lane.answered.values())
    return number, incarnation(number, lane.incarnation), lane.sequence, tickets, kept


def _work(assignment: Assignment) -> Content:
    number = incarnation(assignment.lane, assignment.incarnation)
    return ticket(assignment.ticket), assignment.lane, number, assignment.sequence


def loaded(content: Content, number: int, settings: Settings) -> Worker:
    """A worker at the time 0 with this content."""
    nonce, (frozen, shut_out), fields, work = content
    worker = Worker(settings, number, nonce.value, None, None, frozen, shut_out)
    if fields is None:
        return worker
    state, of_session, attempt, heard, due, lanes, versions, in_progress, replies = fields
    who = WorkerIdentity(f"w{number}", "host", 1, nonce.value, "model")
    current = Session(who, 0.0, join_timeout_s=FOR_EVER_S, rejoin_timeout_s=FOR_EVER_S)
    current.session = MASK  # before its first session: not that of any message
    current.state, current._attempt = WorkerState(state), attempt.value
    current._unanswered_s, current.due_s, current._backoff_s = heard, due, PAUSE_S
    held = current._current
    held.weights = {version: weights(version) for version in versions}
    held.in_progress = in_progress
    if of_session is not None:
        current.run, current.session, held.replies = settings.run, of_session.value, replies.value
    for lane, of_incarnation, sequence, tickets, kept in lanes:
        here = held.rollouts._lanes[lane] = RolloutLane(of_incarnation.value, sequence)
        here.asked = {each.value: Permitted(*permitted) for each, *permitted in tickets}
        here.answered = {fields[2].value: rollout_of(fields) for fields in kept}
    worker.session = current
    if work is not None:
        assignments = tuple(Assignment(each.value, lane, inc.value, sequence) for each, lane, inc, sequence in work[2])
        worker.task = RolloutTask(work[0].value, weights(work[1]), assignments)
    return worker
