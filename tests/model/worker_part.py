"""A worker of the model: its process, the rollouts that it holds, and those in progress.

Rule: after each event the worker does what its program does: give up work that nobody wants, start the next work, send what
is due. To finish work is an event.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from millrace.protocol.messages import Collect, Describe, Evaluate, HeartbeatReply, Permit, Rollout, ToLearner, ToWorker
from millrace.protocol.rules import Rule
from millrace.workers.conversation.held import HeldRollouts, Permitted, RolloutLane
from millrace.workers.conversation.session import (
    CloseLanes,
    EvaluationTask,
    Leave,
    RolloutTask,
    SendMessage,
    Session,
    StartSession,
    WorkAnswer,
    WorkerEffect,
    _SessionState,
)
from tests.model import process_part
from tests.model.conversation import Content
from tests.model.message_content import (
    described,
    fields_of,
    incarnation,
    record_of,
    rollout_content,
    rollout_of,
    session,
    weights,
)
from tests.model.process_part import Process
from tests.model.settings import Settings
from tests.support.conversation.fake_ends import fake_evaluated, fake_rollout, held_count, place_of

SAVED: dict[type, set[str]] = {
    Session: {"identity", "state", "run", "session", "_attempt", "_unanswered_s", "due_s", "_current"},
    _SessionState: {"rollouts", "weights", "in_progress", "replies"},
    HeldRollouts: {"_lanes"},
    RolloutLane: {"incarnation", "sequence", "asked", "answered"},
}
NOT_SAVED: dict[type, set[str]] = {
    Session: {"_statistics", "_join_timeout_s", "_rejoin_timeout_s", "_joining_s", "_backoff_s", "_reason"},
    _SessionState: {"evaluations", "orders", "descriptions"},
    HeldRollouts: set(),
    RolloutLane: set(),
}


@dataclass
class Worker(Process):
    """One state of a worker, which an event changes."""

    settings: Settings
    task: RolloutTask | EvaluationTask | Describe | None = None
    places: dict[int, tuple[int, int]] = field(default_factory=dict)
    """of the lanes that are open: the incarnation, and how many rollouts their env copies have made"""

    def end(self) -> None:
        super().end()
        self.task = None
        self.places = {}

    def handle(self, message: ToWorker, now: float) -> list[ToLearner]:
        assert self.session is not None
        held = self.session._current
        replies, before = held.replies, set(held.weights)
        effects = self.session.handle(message, now)
        assert (before & _asked(held)).issubset(held.weights), (
            f"{Rule.HOLDS_WEIGHTS}: a worker drops weights that its tickets name"
        )
        if isinstance(message, Collect | Evaluate) and message.session == self.session.session:
            assert {*message.keep, *_asked(held)}.issuperset(held.weights), (
                f"{Rule.HOLDS_WEIGHTS}: a worker keeps weights that no order lists"
            )
        if isinstance(message, HeartbeatReply) and held.replies > replies:
            listed = {each.lane for each in message.received}
            assert all(lane.lane in listed for lane in held.lanes()), (
                f"{Rule.UNLISTED}: a worker keeps a lane that is not its own"
            )
        return self.turn(effects, now)

    def finish(self, now: float) -> list[ToLearner]:
        assert self.session is not None
        assert self.task is not None
        task, self.task = self.task, None
        answers = self._answers(task)
        held = self.session._current
        before = set(held.weights)
        effects = self.session.work_ended(answers)
        assert set(held.weights) == before, f"{Rule.HOLDS_WEIGHTS}: a worker drops weights when a ticket ends"
        return self.turn(effects, now)

    def _begin(self, work: RolloutTask | EvaluationTask | Describe) -> list[ToLearner]:
        """What the worker says when this work begins."""
        self.task = work
        if isinstance(work, RolloutTask):
            assert self.session is not None
            held, version = self.session._current, work.weights.version
            lanes = held.rollouts._lanes
            for each in work.permits:
                lane = lanes[each.lane]
                assert each.sequence == lane.sequence, (
                    f"{Rule.IN_ORDER}: rollouts of a lane are not collected in their order"
                )
                asked = lane.asked[each.ticket]
                assert (asked.version, asked.permit.opponent) == (version, each.opponent), (
                    f"{Rule.VERSION}: other weights act than the order names"
                )
                assert held.weights.keys() >= _versions(asked), f"{Rule.OPPONENTS}: a rollout starts without its weights"
                self._open(each)
            startable = [
                asked.version
                for lane in lanes.values()
                for asked in lane.asked.values()
                if asked.permit.sequence == lane.sequence and _versions(asked) <= held.weights.keys()
            ]
            lowest = [each for each in startable if each == min(startable)]
            assert [version] * len(work.permits) == lowest, (
                f"{Rule.LOWEST_VERSION_FIRST}: others are collected than all of the lowest version"
            )
        return []

    def _open(self, each: Permit) -> None:
        """The env copies of a lane are here in this incarnation, or they are made, and continue its past."""
        if self.places.get(each.lane, (-1, 0))[0] != each.incarnation:
            assert each.sequence == 0, f"{Rule.PAST}: a lane goes on with env copies that are not here"
            self.places[each.lane] = each.incarnation, 0 if each.past is None else place_of(each.past.memory)

    def _answers(self, task: RolloutTask | EvaluationTask | Describe) -> Sequence[WorkAnswer]:
        """What this work leads to."""
        match task:
            case RolloutTask():
                return [self._rollout(task, each) for each in task.permits]
            case EvaluationTask():
                return [fake_evaluated(task)]
        return [described(task.session, task.ticket)]

    def _rollout(self, task: RolloutTask, each: Permit) -> Rollout:
        """What a collector would have made. Its env copies have made one rollout more."""
        incarnation, place = self.places[each.lane]
        self.places[each.lane] = incarnation, place + 1
        return fake_rollout(task.session, each.lane, each.ticket, task.weights.version, each.sequence, place + 1)

    def turn(self, effects: list[WorkerEffect], now: float) -> list[ToLearner]:
        current = self.session
        assert current is not None
        self._close(effects)
        if self.task is not None and current.is_unwanted(self.task):
            for each in self.task.permits if isinstance(self.task, RolloutTask) else ():
                self.places.pop(each.lane, None)
            self.task = None
            effects = effects + current.work_ended([])
        work = current.next_work()
        if work is not None:
            assert self.task is None, f"{Rule.LOWEST_VERSION_FIRST}: a worker does two pieces of work at the same time"
            assert isinstance(work, RolloutTask | EvaluationTask | Describe)
            effects = effects + [SendMessage(said) for said in self._begin(work)]
        effects = effects + current.tick(now)
        rounds = 1 + self.settings.max_lag
        most, held = self.settings.lanes * rounds, held_count(current)
        assert held <= most, f"{Rule.ARRIVED}: a worker holds {held} rollouts, of at most {most}"
        versions = len(current._current.weights)
        most = (
            rounds
            + 1
            + bool(self.settings.opponents) * most
            + len({order.version for order in current._current.evaluations.asked.values()})
        )
        assert versions <= most, f"{Rule.HOLDS_WEIGHTS}: a worker holds {versions} versions, of at most {most}"
        sent: list[ToLearner] = []
        for effect in effects:
            match effect:
                case SendMessage(said):
                    sent.append(said)
                case Leave():
                    self.end()
        return sent

    def _close(self, effects: list[WorkerEffect]) -> None:
        """Close the env copies that are no longer wanted."""
        for effect in effects:
            match effect:
                case StartSession():
                    self.places.clear()
                case CloseLanes(closed):
                    for lane in closed:
                        self.places.pop(lane.lane, None)


# -------------------------------------------------------------------- to tuples and back


def saved(worker: Worker, now: float) -> Content:
    task = worker.task
    more: Content = ()
    if worker.session is not None:
        held = worker.session._current
        lanes = tuple(_lane(number, lane) for number, lane in held.rollouts._lanes.items())
        places = tuple((number, incarnation(number, each), place) for number, (each, place) in sorted(worker.places.items()))
        more = lanes, tuple(sorted(held.weights)), places
    work = None
    if isinstance(task, RolloutTask):
        work = session(task.session), task.weights.version, tuple(map(fields_of, task.permits))
    return process_part.saved(worker, now, more, work)


def only_evaluates(content: Content) -> bool:
    """Whether the worker of this content only plays evaluations."""
    return bool(content[1][2])


def _asked(held: _SessionState) -> set[int]:
    """The versions that unfinished tickets name."""
    asked = [each for lane in held.rollouts._lanes.values() for each in lane.asked.values()]
    rollouts = {version for each in asked for version in _versions(each)}
    evaluations = {order.version for order in held.evaluations.asked.values()}
    return rollouts | evaluations


def _versions(asked: Permitted) -> set[int]:
    """The versions that a rollout needs."""
    opponent = asked.permit.opponent
    return {asked.version} if opponent is None else {asked.version, opponent}


def _lane(number: int, lane: RolloutLane) -> Content:
    tickets = tuple((fields_of(asked.permit), asked.version) for _, asked in sorted(lane.asked.items()))
    kept = tuple(rollout_content(rollout) for rollout in lane.answered.values())
    return number, incarnation(number, lane.incarnation), lane.sequence, tickets, kept


W = TypeVar("W", bound=Worker)


def loaded(content: Content, number: int, settings: Settings, kind: type[W]) -> W:
    """A worker of this kind at the time 0 with this content."""
    worker, more = process_part.loaded(kind, content, number, settings)
    if worker.session is None:
        return worker
    (lanes, versions, places), work = more, content[3]
    held = worker.session._current
    held.weights = {version: weights(version) for version in versions}
    for lane, of_incarnation, sequence, tickets, kept in lanes:
        here = held.rollouts._lanes[lane] = RolloutLane(of_incarnation.value, sequence)
        asked = [Permitted(record_of(Permit, permit), version) for permit, version in tickets]
        here.asked = {each.permit.ticket: each for each in asked}
        here.answered = {fields[2].value: rollout_of(fields) for fields in kept}
    worker.places = {number: (each.value, place) for number, each, place in places}
    if work is not None:
        permits = tuple(record_of(Permit, each) for each in work[2])
        worker.task = RolloutTask(work[0].value, weights(work[1]), permits, {})
    return worker
