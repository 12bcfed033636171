"""What a worker holds: requests that it has not finished, and answers that the learner may not have received. Pure.

Rule: each request has a ticket, and is executed once. The answer is kept, and sent again if the learner repeats the request
because the answer was lost. How long answers are kept bounds the memory of a worker:

- a rollout: until the learner says that it has received it. So a worker holds at most what the learner has outstanding.
- the result of an evaluation: until there are `KEPT_RESULTS` later ones. If its rows were sent too, it is not kept: rows are
  large, and the evaluation can be executed again, with the same episodes.
- the answer to an order (Reset, Step, Call) of a vector environment: until the next order of its lane.
- a description of an environment: until the next one is asked for, or the run begins.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, TypeVar

from millrace.protocol.messages import (
    Answer,
    Describe,
    Described,
    Evaluate,
    Evaluated,
    LaneIncarnation,
    LanePast,
    Order,
    Permit,
    Received,
    Rollout,
    versions_of,
)

KEPT_RESULTS = 8  # a learner gives a worker at most two evaluations at a time, so only the last two results can be missing

AskedT = TypeVar("AskedT")
AnsweredT = TypeVar("AnsweredT", bound=Rollout | Evaluated | Described | Answer)


@dataclass
class Held(Generic[AskedT, AnsweredT]):
    """Unfinished requests, and the answers that are kept, by ticket."""

    asked: dict[int, AskedT] = field(default_factory=dict, init=False)
    answered: dict[int, AnsweredT] = field(default_factory=dict, init=False)  # oldest first

    # rules ROLLOUT_ONCE, ORDER_ONCE, EVALUATE_ONCE, DESCRIBE_AGAIN
    def take(self, ticket: int, asked: AskedT) -> AnsweredT | None:
        """Take a request. Returns an answer to send again, if any."""
        if ticket not in self.answered:
            self.asked.setdefault(ticket, asked)
        return self.answered.get(ticket)

    def keep(self, answer: AnsweredT) -> bool:
        """Keep an answer; False if it is not wanted any more."""
        if self.asked.pop(answer.ticket, None) is None:
            return False
        self.answered[answer.ticket] = answer
        return True


class HeldEvaluations(Held[Evaluate, Evaluated]):
    """Evaluations, which belong to no lane. One evaluation uses one version, and has higher tickets than earlier ones."""

    def take(self, ticket: int, asked: Evaluate) -> Evaluated | None:  # rule EVALUATE_ENDS
        """Take an order. Earlier evaluations than that of the highest ticket are over: the rest of them is dropped."""
        answer = super().take(ticket, asked)
        newest = max(self.asked, default=ticket)
        self.asked = {n: order for n, order in self.asked.items() if order.version == self.asked[newest].version}
        return answer

    def next(self, versions: Collection[int]) -> Evaluate | None:  # rules EVALUATE_VERSION, OPPONENTS
        """The oldest order whose weights this worker has."""
        due = [ticket for ticket, order in self.asked.items() if order.versions.issubset(versions)]
        return self.asked[min(due)] if due else None

    def versions(self) -> set[int]:
        """The requested versions."""
        return {version for order in self.asked.values() for version in order.versions}

    def keep(self, answer: Evaluated) -> bool:
        """Keep a result, unless it has rows; False if it is not wanted any more."""
        order = self.asked.get(answer.ticket)
        kept = super().keep(answer)
        if order is not None and (order.send_rows or order.send_frames):
            del self.answered[answer.ticket]
        if len(self.answered) > KEPT_RESULTS:
            del self.answered[next(iter(self.answered))]
        return kept


class HeldDescriptions(Held[Describe, Described]):
    """Orders to describe an environment. Only the newest counts: tickets rise with every order."""

    def take(self, ticket: int, asked: Describe) -> Described | None:
        """Take an order. Returns the answer to send again, if any."""
        newest = max((*self.asked, *self.answered), default=-1)
        if ticket < newest:
            return None
        if ticket > newest:
            self.asked.clear()
            self.answered.clear()
        return super().take(ticket, asked)

    def next(self) -> Describe | None:
        """The order that has not been executed yet."""
        return next(iter(self.asked.values()), None)


@dataclass
class _HeldLane(Held[AskedT, AnsweredT]):
    incarnation: int


LaneT = TypeVar("LaneT", bound=_HeldLane[Any, Any])


class _HeldLanes(Generic[LaneT]):
    """What is held in one session, by lane. A later incarnation of a lane begins empty."""

    _kind: type[LaneT]

    def __init__(self) -> None:
        self._lanes: dict[int, LaneT] = {}

    def _opened(self, number: int, incarnation: int) -> LaneT | None:  # rule INCARNATION
        """The lane in this incarnation; None if it has a later one."""
        lane = self._lanes.get(number)
        if lane is None or incarnation > lane.incarnation:
            lane = self._lanes[number] = self._kind(incarnation)
        return lane if lane.incarnation == incarnation else None

    def keep(self, answer: Rollout | Answer) -> bool:
        """Keep an answer; False if its lane was released meanwhile, or it is not wanted any more."""
        lane = self._lanes.get(answer.lane)
        return lane is not None and lane.keep(answer)

    def tickets(self) -> tuple[int, ...]:
        """The tickets of unfinished requests."""
        return tuple(ticket for lane in self._lanes.values() for ticket in lane.asked)

    def lanes(self) -> tuple[LaneIncarnation, ...]:
        """The lanes of this worker."""
        return tuple(LaneIncarnation(number, lane.incarnation) for number, lane in self._lanes.items())

    def release(self, lanes: Sequence[LaneIncarnation]) -> list[LaneIncarnation]:
        """Drop these lanes. Returns those that this worker had, in this or an earlier incarnation."""
        released = []
        for old in lanes:
            lane = self._lanes.get(old.lane)
            if lane is not None and lane.incarnation <= old.incarnation:
                del self._lanes[old.lane]
                released.append(LaneIncarnation(old.lane, lane.incarnation))
        return released


@dataclass(frozen=True)
class Assignment:
    """One rollout to collect."""

    ticket: int
    lane: int
    incarnation: int
    """If the worker has another incarnation of the lane, the lane starts on new env copies."""
    sequence: int
    round: int
    """Decides the random numbers of the actions."""
    opponent: int | None = None
    """The opponent that plays the other teams in the episodes that begin in it."""
    past: LanePast | None = None
    """The past that the lane continues if it isn't open in this incarnation; None: it begins its first episodes."""


class Permitted(NamedTuple):
    """A rollout that may be collected."""

    sequence: int
    version: int
    """version of the weights to act with"""
    round: int
    opponent: int | None
    past: LanePast | None
    """`round`, `opponent` and `past`: as in the `Permit`"""

    def assignment(self, ticket: int, lane: int, incarnation: int) -> Assignment:
        """What to collect on this lane."""
        return Assignment(ticket, lane, incarnation, self.sequence, self.round, self.opponent, self.past)

    @property
    def versions(self) -> set[int]:
        """The versions of the weights that it needs."""
        return versions_of(self.version, [self.opponent])


@dataclass
class RolloutLane(_HeldLane[Permitted, Rollout]):
    """A ticket asks for a rollout. They are collected in the order of their sequence."""

    sequence: int = 0  # sequence number of the next rollout

    def keep(self, answer: Rollout) -> bool:
        """Keep a collected rollout; False if its ticket was withdrawn in the meantime."""
        kept = super().keep(answer)
        self.sequence += kept
        return kept


class HeldRollouts(_HeldLanes[RolloutLane]):
    """Tickets to collect, and rollouts that the learner has not confirmed."""

    _kind = RolloutLane

    def take(self, permit: Permit, version: int) -> Rollout | None:  # rule RECEIVED
        """Take a ticket to collect with this version. Returns a rollout to send again, if any."""
        lane = self._opened(permit.lane, permit.incarnation)
        if lane is None or (permit.sequence < lane.sequence and permit.ticket not in lane.answered):
            return None  # a late repeat: the learner has this rollout
        permitted = Permitted(permit.sequence, version, permit.round, permit.opponent, permit.past)
        return lane.take(permit.ticket, permitted)

    # rules IN_ORDER, VERSION, LOWEST_VERSION_FIRST
    def startable(self, versions: Collection[int]) -> tuple[int, tuple[Assignment, ...]]:
        """The next rollouts of lanes whose weights are available.

        Returns the lowest version among them, and the rollouts with this version in lane order; none if nothing can be
        collected.
        """
        startable: dict[int, list[Assignment]] = {}
        for number, lane in sorted(self._lanes.items()):
            for ticket, asked in lane.asked.items():
                if asked.sequence == lane.sequence and asked.versions.issubset(versions):
                    startable.setdefault(asked.version, []).append(asked.assignment(ticket, number, lane.incarnation))
        version = min(startable, default=-1)
        return version, tuple(startable.get(version, ()))

    def versions(self) -> set[int]:
        """The requested versions."""
        return {version for lane in self._lanes.values() for asked in lane.asked.values() for version in asked.versions}

    def forget_received(self, received: Sequence[Received]) -> None:  # rule ROLLOUT_ONCE
        """Drop the rollouts that the learner has received."""
        for of_lane in received:
            lane = self._lanes.get(of_lane.lane)
            if lane is None or lane.incarnation != of_lane.incarnation:
                continue
            for ticket, rollout in list(lane.answered.items()):
                if rollout.sequence < of_lane.next_sequence or rollout.sequence in of_lane.out_of_order:
                    del lane.answered[ticket]


@dataclass
class OrderLane(_HeldLane[Order, Answer]):
    """Only the newest order counts: tickets rise with every order of a lane."""

    newest: int = -1  # ticket


class HeldOrders(_HeldLanes[OrderLane]):
    """Orders to execute, and the answers to the newest."""

    _kind = OrderLane

    def take(self, order: Order) -> Answer | None:  # rules ORDER_OLD, ORDER_ONCE
        """Take an order that has arrived. Returns an answer to send again, if any."""
        lane = self._opened(order.lane, order.incarnation)
        if lane is None or order.ticket < lane.newest:
            return None
        if order.ticket > lane.newest:
            lane = self._lanes[order.lane] = OrderLane(order.incarnation, order.ticket)
        return lane.take(order.ticket, order)

    def next(self) -> Order | None:
        """The oldest order that has not been executed yet."""
        waiting = [order for lane in self._lanes.values() for order in lane.asked.values()]
        return min(waiting, key=lambda order: order.ticket, default=None)
