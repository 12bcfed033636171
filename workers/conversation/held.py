"""What a worker holds: requests that it has not finished, and answers that the learner may not have received. Pure.

Rule: each request has a ticket, and is executed once. Its answer is kept, and sent again if the learner repeats the request
because the answer was lost. To limit a worker's memory use, answers are kept only for a limited time:

- A rollout is kept until the learner says that it has received it, so a worker holds at most the rollouts that the learner
  is waiting for.
- An evaluation's result is kept until there are `KEPT_RESULTS` later ones. It is not kept if its rows were sent too, because
  rows are large, and the evaluation can be executed again, with the same episodes.
- The answer to an order (Reset, Step, Call) of a vector environment is kept until the next order for its lane.
- A description of an environment is kept until the next one is requested, or the run begins.
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
    Order,
    Permit,
    Received,
    Rollout,
    versions_of,
)

KEPT_RESULTS = 8  # more than enough: a learner gives a worker at most two evaluations at a time

AskedT = TypeVar("AskedT")
AnsweredT = TypeVar("AnsweredT", bound=Rollout | Evaluated | Described | Answer)


@dataclass
class Held(Generic[AskedT, AnsweredT]):
    """Unfinished requests, and the answers that are kept, by ticket."""

    asked: dict[int, AskedT] = field(default_factory=dict, init=False)
    answered: dict[int, AnsweredT] = field(default_factory=dict, init=False)  # oldest first

    # rules ROLLOUT_ONCE, ORDER_ONCE, EVALUATE_ONCE, DESCRIBE_AGAIN
    def take(self, ticket: int, asked: AskedT) -> AnsweredT | None:
        """Accept a request. If it has been executed already, returns the answer, which must be sent again."""
        if ticket not in self.answered:
            self.asked.setdefault(ticket, asked)
        return self.answered.get(ticket)

    def keep(self, answer: AnsweredT) -> bool:
        """Keep an answer. Returns False if it is no longer wanted."""
        if self.asked.pop(answer.ticket, None) is None:
            return False
        self.answered[answer.ticket] = answer
        return True


class HeldEvaluations(Held[Evaluate, Evaluated]):
    """Orders to evaluate, which belong to no lane.

    An evaluation consists of orders with one version of the weights. Its tickets are higher than those of earlier
    evaluations.
    """

    def take(self, ticket: int, asked: Evaluate) -> Evaluated | None:  # rule EVALUATE_ENDS
        """Accept an order; see `Held.take`. Drops the orders of all evaluations but the newest, because those are over."""
        answer = super().take(ticket, asked)
        newest = max(self.asked, default=ticket)
        self.asked = {n: order for n, order in self.asked.items() if order.version == self.asked[newest].version}
        return answer

    def next(self, versions: Collection[int]) -> Evaluate | None:  # rules EVALUATE_VERSION, OPPONENTS
        """The oldest order for which this worker has the weights; None if there is none."""
        due = [ticket for ticket, order in self.asked.items() if order.versions.issubset(versions)]
        return self.asked[min(due)] if due else None

    def versions(self) -> set[int]:
        """The versions of the weights that unfinished orders need."""
        return {version for order in self.asked.values() for version in order.versions}

    def keep(self, answer: Evaluated) -> bool:
        """Keep a result, unless its rows were sent too. Returns False if it is no longer wanted."""
        order = self.asked.get(answer.ticket)
        kept = super().keep(answer)
        if order is not None and (order.send_rows or order.send_frames):
            del self.answered[answer.ticket]
        if len(self.answered) > KEPT_RESULTS:
            del self.answered[next(iter(self.answered))]
        return kept


class HeldDescriptions(Held[Describe, Described]):
    """Orders to describe an environment. Only the newest order counts. Each order has a higher ticket than the last."""

    def take(self, ticket: int, asked: Describe) -> Described | None:
        """Accept an order, and drop older ones; see `Held.take`."""
        newest = max((*self.asked, *self.answered), default=-1)
        if ticket < newest:
            return None
        if ticket > newest:
            self.asked.clear()
            self.answered.clear()
        return super().take(ticket, asked)

    def next(self) -> Describe | None:
        """The order that has not been executed yet; None if there is none."""
        return next(iter(self.asked.values()), None)


@dataclass
class _HeldLane(Held[AskedT, AnsweredT]):
    incarnation: int


LaneT = TypeVar("LaneT", bound=_HeldLane[Any, Any])


class _HeldLanes(Generic[LaneT]):
    """The requests and answers of one session, by lane. A new incarnation of a lane begins with no requests or answers."""

    _kind: type[LaneT]

    def __init__(self) -> None:
        self._lanes: dict[int, LaneT] = {}

    def _opened(self, number: int, incarnation: int) -> LaneT | None:  # rule INCARNATION
        """The lane in this incarnation; created here if it is new. None if the lane has a later incarnation."""
        lane = self._lanes.get(number)
        if lane is None or incarnation > lane.incarnation:
            lane = self._lanes[number] = self._kind(incarnation)
        return lane if lane.incarnation == incarnation else None

    def keep(self, answer: Rollout | Answer) -> bool:
        """Keep an answer. Returns False if its lane has been released in the meantime, or it is no longer wanted."""
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


class Permitted(NamedTuple):
    """A rollout that may be collected."""

    permit: Permit
    version: int
    """version of the weights with which to act"""

    @property
    def versions(self) -> set[int]:
        """The versions of the weights that this rollout needs."""
        return versions_of(self.version, [self.permit.opponent])


@dataclass
class RolloutLane(_HeldLane[Permitted, Rollout]):
    """A lane's tickets, each for one rollout, and its rollouts, which are collected in the order of their `sequence`."""

    sequence: int = 0  # sequence number of the next rollout to collect

    def keep(self, answer: Rollout) -> bool:
        """Keep a collected rollout. Returns False if its ticket was withdrawn in the meantime."""
        kept = super().keep(answer)
        self.sequence += kept
        return kept


class HeldRollouts(_HeldLanes[RolloutLane]):
    """Tickets to collect, and rollouts that the learner has not confirmed."""

    _kind = RolloutLane

    def take(self, permit: Permit, version: int) -> Rollout | None:  # rule RECEIVED
        """Accept a ticket to collect a rollout with this version of the weights.

        If the rollout was collected already, returns it to be sent again, because it may have been lost on the way.
        """
        lane = self._opened(permit.lane, permit.incarnation)
        if lane is None or (permit.sequence < lane.sequence and permit.ticket not in lane.answered):
            return None  # a late copy of the ticket: the learner has this rollout
        return lane.take(permit.ticket, Permitted(permit, version))

    # rules IN_ORDER, VERSION, LOWEST_VERSION_FIRST
    def startable(self, versions: Collection[int]) -> tuple[int, tuple[Permit, ...]]:
        """The next rollouts to collect, among those whose weights are available.

        Returns the lowest of their versions, and the permits of the rollouts with this version, in lane order. If nothing
        can be collected, returns -1 and no permits.
        """
        startable: dict[int, list[Permit]] = {}
        for _, lane in sorted(self._lanes.items()):
            for asked in lane.asked.values():
                if asked.permit.sequence == lane.sequence and asked.versions.issubset(versions):
                    startable.setdefault(asked.version, []).append(asked.permit)
        version = min(startable, default=-1)
        return version, tuple(startable.get(version, ()))

    def versions(self) -> set[int]:
        """The versions of the weights that unfinished tickets need."""
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
    """The order of a lane, or the answer to it. Only the newest order counts, which has the highest ticket."""

    newest: int = -1  # ticket


class HeldOrders(_HeldLanes[OrderLane]):
    """Orders to execute, and the answer to the newest order of each lane."""

    _kind = OrderLane

    def take(self, order: Order) -> Answer | None:  # rules ORDER_OLD, ORDER_ONCE
        """Accept an order that has arrived. If it has been executed already, returns the answer, which must be
        sent again.
        """
        lane = self._opened(order.lane, order.incarnation)
        if lane is None or order.ticket < lane.newest:
            return None
        if order.ticket > lane.newest:
            lane = self._lanes[order.lane] = OrderLane(order.incarnation, order.ticket)
        return lane.take(order.ticket, order)

    def next(self) -> Order | None:
        """The oldest order that has not been executed yet; None if there is none."""
        waiting = [order for lane in self._lanes.values() for order in lane.asked.values()]
        return min(waiting, key=lambda order: order.ticket, default=None)
