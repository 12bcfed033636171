"""A program that uses a vector environment: its calls, cut where they wait. It has the real `StepHub` and `SendRecv`.

Rule: each call does what `ZmqVectorEnv` does before it waits, looks after each event, and does the rest when nothing is
under way any more.

Rules of safety: each result is that of the order it was asked for, from copies that executed every order before it once;
copies of a lost lane are reset before they step; a step resets a lane only after its loss was reported; after one fault, a
reset is tried again; a worker that is heard answers in time; and no call waits for the answer to an earlier call's order.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, cast

import gymnasium
import numpy as np

from millrace.learner.members.membership import Outgoing
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.learner.vector_env.batch_arrays import BatchArrays
from millrace.learner.vector_env.batch_layout import BatchLayout
from millrace.learner.vector_env.order_coordinator import OrderCoordinator, SentOrder
from millrace.learner.vector_env.send_recv import SendRecv
from millrace.learner.vector_env.sent_lanes import Asked, AskedReset, Sent
from millrace.learner.vector_env.step_hub import StepHub
from millrace.protocol.errors import NoWorkers, WorkerLost
from millrace.protocol.messages import Answer, LaneIncarnation
from millrace.protocol.rules import Rule
from millrace.protocol.wire.learner_link import LearnerLink
from tests.model.settings import TICK_S
from tests.model.vector_env.order_content import NEW, Copy, executed, make_order, state_in
from tests.support.conversation.fake_link import FakeLink

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


class OneReplacementSeed(SendRecv):
    """Gives all copies that replace lost ones the same seed."""

    def _replacement_seeds(self, lane: int) -> tuple[int | None, ...]:
        return (REPLACED,)


class EveryTick:
    """In place of `WatchedTime`: all time counts."""

    def look(self, now: float) -> float:
        return now


class Caller:
    """One state of the program, which an event changes."""

    def __init__(self, coordinator: OrderCoordinator, settings: Stepping, now: float) -> None:
        self.operations, self.now = settings.calls, now
        self.timeout_s = settings.call_timeout_s
        self.faults = settings.faults
        self.oldest = settings.most_ticks
        self.coordinator, self.server = coordinator, Server()
        link, clock = cast(LearnerLink, FakeLink()), lambda: self.now
        self.hub = StepHub(link, coordinator.spec, first_session=0, processes=WorkerProcesses(), clock=clock)
        self.hub.coordinator = coordinator
        self.hub._server = self.server  # type: ignore[assignment]
        self.hub._listen_due_s = float("inf")
        self._take = self.hub.take
        self.hub.take = self._taken  # type: ignore[method-assign]
        self.layout = BatchLayout(coordinator.spec.lanes)
        batch = BatchArrays(coordinator.spec, self.layout, gymnasium.spaces.Box(-1, 1000, (1,), np.float32), None)
        self.send_recv = OneReplacementSeed(self.hub, self.layout, batch, autoreset="NextStep", timeout_s=self.timeout_s)
        self.send_recv._watched = EveryTick()  # type: ignore[assignment]
        self.at = 0
        """index of the call that is made, or made next"""
        self.waits = False
        """whether a call is made"""
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
            case "interrupted reset" | "abandoned reset" as reset:
                self.send_recv.reset(lanes, [self.at] * len(lanes), None)
                if reset == "interrupted reset":
                    self.send_recv.begin_anew()
                else:
                    self.send_recv.abandon(lanes)
                self.at += 1
                return
            case "reset":
                self.send_recv.reset(lanes, [self.at] * len(lanes), None)
            case "step":
                assert self.send_recv._lost_lanes.awaiting_reset <= self.told, (
                    "a step resets a lane whose loss was not reported"
                )
                actions = [np.zeros(len(lanes), np.int64)], True
                self.send_recv.step(lanes, actions, self.layout.rows, together=True)
            case "call":
                self.send_recv.call(dict.fromkeys(lanes, make_order("call", 0)))
        self.waits = True
        self.turn()

    def turn(self) -> None:
        """Send what can be sent, and go on if nothing is under way any more."""
        if not self.waits:
            return
        self.hub._send_waiting_orders()
        try:
            self.send_recv.look(self.timeout_s)
            self.hub._send_waiting_orders()
            if under_way := self.send_recv._sent.under_way:
                orders = [self.coordinator.lanes[lane].order for lane in under_way]
                assert all(order.wanted for order in orders if isinstance(order, SentOrder)), (
                    "a call waits for the answer to an earlier call's order"
                )
                return
            ready = self.send_recv.recv_all()
            self.told |= {self.layout.lane_of(n) for n in ready.losses}
            self.at += 1
        except (NoWorkers, WorkerLost) as error:
            gave_up_reset = isinstance(error, WorkerLost) and self.operations[self.at] == "reset"
            assert not gave_up_reset or self.faults > 1, "a reset is given up after one fault"
            self.send_recv.abandon(self.layout.lanes)
            self.told |= self.send_recv._lost_lanes.awaiting_reset  # by the error
            self.at += isinstance(error, WorkerLost) and self.operations[self.at] == "call"  # others are tried again
        self.waits = False

    def pass_time(self) -> None:
        """Time has passed."""
        if not self.waits:
            return
        self.server.send(self.coordinator.remove_silent(self.now))
        self.hub._send_waiting_orders()
        for lane in self.coordinator.lanes:
            if not isinstance(lane.order, SentOrder):
                continue
            ticket = lane.order.order.ticket
            age = self.ages[ticket] = min(self.ages.get(ticket, 0) + 1, self.oldest)
            member = self.coordinator.owner(lane.number)
            heard = member is not None and self.now - member.heard_s <= TICK_S
            assert age < self.oldest or not heard, f"{Rule.ORDER_AGAIN}: a worker that is heard does not answer"
        self.turn()

    # ---------------------------------------------------------------- inside

    def _taken(self) -> dict[int, Answer | bytes]:
        """What has come, each result of which is looked at once."""
        found = self._take()
        for lane, answer in found.items():
            self._look_at(lane, answer)
        return found

    def _look_at(self, lane: int, answer: Answer | bytes) -> None:
        sent = self.send_recv._sent.sent[lane]
        assert not isinstance(answer, bytes)
        incarnation, before = self.copies.get(lane, (-1, NEW))
        assert answer.incarnation <= self.coordinator.lanes[lane].incarnation, (
            f"{Rule.INCARNATION}: a result of a later incarnation"
        )
        assert answer.incarnation >= incarnation, f"{Rule.INCARNATION}: a result of an earlier incarnation"
        before = before if answer.incarnation == incarnation else NEW
        possible = [before]
        if self.at and self.operations[self.at - 1] == "abandoned reset" and before != NEW:
            possible.append((self.at - 1, 0))  # the worker may have executed the reset before the next order came
        kind, seed = self.kind(lane, sent) if sent.asked is not Asked.CALL else ("call", 0)
        order = make_order(kind, seed)(0, 0, LaneIncarnation(lane, answer.incarnation))
        expected = [executed(order, each) for each in possible]
        assert state_in(answer) in expected, (
            f"{Rule.ORDER_ONCE}: lane {lane}: expected the result {expected}, got {state_in(answer)}"
        )
        self.copies[lane] = answer.incarnation, state_in(answer)
        if kind == "reset":
            self.told.discard(lane)

    def kind(self, lane: int, sent: Sent) -> tuple[str, int]:
        """Kind and seed of the order that the lane was sent."""
        if isinstance(sent.asked, AskedReset):
            return "reset", sent.asked.seeds[0] or 0
        if sent.asked is Asked.CALL:
            return "call", 0
        return ("reset", REPLACED) if lane in self.send_recv._lost_lanes.awaiting_reset else ("step", 0)
