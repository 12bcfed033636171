"""A program that uses a vector environment: its calls, cut where they wait. It has the real `StepHub` and `LostLanes`.

Rule: each call does what `ZmqVectorEnv` does before it waits, and does the rest when `StepHub.wait_for_answers` would
return. (`ZmqVectorEnv` itself cannot be cut there; `test_caller.py` compares the two.)

Rules of safety: each result is that of the order it was asked for, from copies that executed every order before it once;
copies of a lost lane are reset before they step; a step resets a lane only after its loss was reported; and a worker that is
heard answers in time.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from learner.members.membership import Outgoing
from learner.vector_env.lost_lanes import RESET_ATTEMPTS, LostLanes
from learner.vector_env.order_coordinator import OrderCoordinator
from learner.vector_env.step_hub import StepHub
from protocol.errors import NoWorkers
from protocol.messages import Answer, LaneIncarnation
from tests.model.settings import TICK_S
from tests.model.vector_env.order_content import NEW, Copy, executed, make_order, state_in
from tests.support.fake_link import FakeLink

if TYPE_CHECKING:
    from tests.model.vector_env.stepping import Stepping

REPLACED = 99  # seed of the copies that replace lost ones


class Server:
    """In place of the hub's server: it keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[Outgoing] = []

    def send(self, messages: Iterable[Outgoing]) -> None:
        """Keep these messages."""
        self.sent += messages

    def listen(self, timeout_s: float) -> None:
        """Messages arrive as events of the model."""

    def no_workers(self, workers: int, timeout_s: float) -> NoWorkers:
        """The error when no worker has come in time."""
        return NoWorkers(f"waited {timeout_s} s")


class Caller:
    """One state of the program, which an event changes."""

    def __init__(self, coordinator: OrderCoordinator, settings: Stepping, now: float) -> None:
        self.operations, self.timeout_s, self.now = settings.calls, settings.call_timeout_s, now
        self.oldest = settings.most_ticks
        self.coordinator, self.server = coordinator, Server()
        self.hub = StepHub(FakeLink(), coordinator.spec, first_session=0, clock=lambda: self.now)  # type: ignore[arg-type]
        self.hub._coordinator = coordinator
        self.hub._server = self.server  # type: ignore[assignment]
        self.hub._listen_due_s = float("inf")
        self.lost_lanes = LostLanes()
        self.at = 0
        """index of the call that is made, or made next"""
        self.deadline_s: float | None = None
        """until when the call waits; None: no call is made"""
        self.attempt = 0
        """number of earlier attempts of this reset"""
        self.unreset: set[int] = set()
        """lanes that this reset has still to reset"""
        self.ordered: dict[int, tuple[str, int]] = {}
        """by lane: kind and seed of the order that it was sent, or is to be sent"""
        self.copies: dict[int, tuple[int, Copy]] = {}
        """by lane: incarnation and state of its copy, after the newest result"""
        self.ages: dict[int, int] = {}
        """by ticket: ticks since the order was sent, of those that are not answered"""
        self.told: set[int] = set()
        """lanes whose loss was reported, and which were not reset since"""

    # ---------------------------------------------------------------- events

    def go_on(self) -> None:
        """Make the next call."""
        lanes = range(len(self.coordinator.lanes))
        match self.operations[self.at]:
            case "reset":
                self.hub.rebalance()
                self.lost_lanes.add(self.hub.take_lost())
                self.lost_lanes.forget(lanes)
                self.unreset, self.attempt = set(lanes), 0
                self._order(dict.fromkeys(lanes, ("reset", self.at)))
            case "step":
                self.lost_lanes.add(self.hub.take_lost())
                awaiting = self.lost_lanes.awaiting_reset
                stepping = [lane for lane in lanes if lane not in self.lost_lanes.unreported]
                assert awaiting <= self.told, "a step resets a lane whose loss was not reported"
                self._order({lane: ("reset", REPLACED) if lane in awaiting else ("step", 0) for lane in stepping})
            case "call":
                self._order(dict.fromkeys(lanes, ("call", 0)))
        self.turn()

    def turn(self) -> None:
        """Send what can be sent, and go on if every order is answered or its lane is lost."""
        hub = self.hub
        while self.deadline_s is not None:
            hub._send_waiting_orders()
            if hub._waiting_orders or self.coordinator.orders:
                return
            self._answered()

    def pass_time(self) -> None:
        """Time has passed."""
        if self.deadline_s is None:
            return
        self.server.send(self.coordinator.remove_silent(self.now))
        self.hub._send_waiting_orders()
        for order in self.coordinator.orders.values():
            age = self.ages[order.ticket] = min(self.ages.get(order.ticket, 0) + 1, self.oldest)
            member = self.coordinator.owner(order.lane)
            heard = member is not None and self.now - member.heard_s <= TICK_S
            assert age < self.oldest or not heard, "a worker that is heard does not answer"
        self.give_up_if_late()

    def give_up_if_late(self) -> None:
        """Give up what was not answered in time, and go on."""
        late = self.deadline_s is not None and self.now > self.deadline_s
        if late and (self.hub._waiting_orders or self.coordinator.orders):
            try:
                self.hub._give_up(self.timeout_s)
            except NoWorkers:
                self._raised(dict(self.coordinator.answers))
        self.turn()

    # ---------------------------------------------------------------- inside

    def _order(self, kinds: Mapping[int, tuple[str, int]]) -> None:
        self.ordered = dict(kinds)
        self.hub.send_orders({lane: make_order(*kind) for lane, kind in kinds.items()})
        self.deadline_s = self.now + self.timeout_s

    def _answered(self) -> None:
        """Do what the call does after `wait_for_answers`."""
        hub, lost_lanes, answers = self.hub, self.lost_lanes, dict(self.coordinator.answers)
        self.deadline_s = None
        self._use(answers)
        if self.operations[self.at] != "call":
            lost_lanes.answered(answers.keys())
        match self.operations[self.at]:
            case "reset":
                self.unreset -= answers.keys()
                lost = hub.take_lost()
                lost_lanes.add(
                    {lane: why for lane, why in lost.items() if lane not in self.unreset and not hub.is_started(lane)}
                )
                if not self.unreset:
                    self.at += 1
                elif self.attempt == RESET_ATTEMPTS - 1:
                    self._tell(self.unreset)  # and raise WorkerLost; the program tries again
                else:
                    self.attempt += 1
                    self._order(dict.fromkeys(sorted(self.unreset), ("reset", self.at)))
            case "step":
                unanswered = [lane for lane in range(len(self.coordinator.lanes)) if lane not in answers]
                if unanswered or lost_lanes.unreported:
                    lost_lanes.add(hub.take_lost())
                    self.told |= lost_lanes.report(unanswered).keys()
                self.at += 1
            case "call":
                if any(lane not in answers for lane in self.ordered):
                    lost_lanes.add(hub.take_lost())  # and raise WorkerLost; the program goes on
                self.at += 1

    def _raised(self, answers: dict[int, Answer]) -> None:
        """The call raises `NoWorkers`; the program tries again."""
        self.deadline_s = None
        self._use(answers)
        if self.operations[self.at] == "step":
            self._tell(self.hub.take_lost())

    def _tell(self, lanes: Iterable[int]) -> None:
        self.lost_lanes.expect_reset(lanes)
        self.told |= set(lanes)

    def _use(self, answers: dict[int, Answer]) -> None:
        """The results, of which each is looked at once."""
        for lane, answer in answers.items():
            kind, seed = self.ordered[lane]
            incarnation, before = self.copies.get(lane, (-1, NEW))
            assert answer.incarnation <= self.coordinator.lanes[lane].incarnation, "a result of a later incarnation"
            assert answer.incarnation >= incarnation, "a result of an earlier incarnation"
            before = before if answer.incarnation == incarnation else NEW
            order = make_order(kind, seed)(0, 0, LaneIncarnation(lane, answer.incarnation))
            expected = executed(order, before)
            assert state_in(answer) == expected, f"lane {lane}: expected the result {expected}, got {state_in(answer)}"
            self.copies[lane] = answer.incarnation, expected
            if kind == "reset":
                self.told.discard(lane)
