"""What the learner does for one rollout must not depend on how many workers there are: counted in lines of Python."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

import pytest

from millrace.learner.members.key_revocation import KeyRevocation
from millrace.protocol.messages import Heartbeat
from tests.learner.rollouts.test_ticket_coordinator import Learner
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import process_ends

FEW, MANY = 8, 512


def lines(work: Callable[[], object]) -> int:
    """How many lines of Python it runs; a pass of a comprehension is one too."""
    count = 0

    def trace(frame: FrameType, event: str, arg: Any) -> Any:
        nonlocal count
        count += event == "line"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)
    return count


def crowd(workers: int, max_lag: int = 0) -> Learner:
    """So many workers, a lane for each, in the midst of an update."""
    learner = Learner(lanes=workers, max_lag=max_lag, publish=False)
    for number in range(workers):
        learner.joins(b"w%d" % number, pid=number)
    learner.publish(0)
    learner.update()
    learner.delivers(learner.tickets()[0])
    return learner


def of_rollout(learner: Learner, number: int | None = None) -> int:
    """Lines for the arrival of one rollout, and for a look whether an update can be made of all."""
    learner.coordinator.remove_silent(learner.now)
    while learner.coordinator.rollouts.take() is not None:  # what is there already
        pass
    number = learner.tickets()[0] if number is None else number
    rollout, peer = learner.rollout_of(number), learner.coordinator.rollouts.held[number].peer

    def arrives() -> None:
        learner.coordinator.receive(peer, rollout, learner.now)
        learner.coordinator.rollouts.take()
        learner.coordinator.remove_silent(learner.now)

    return lines(arrives)


@pytest.mark.parametrize("max_lag", [0, 2])
def test_a_rollout_costs_as_much_whatever_the_number_of_workers(max_lag: int) -> None:
    assert of_rollout(crowd(MANY, max_lag)) <= of_rollout(crowd(FEW, max_lag)) + 5


def test_an_account_costs_as_much_whatever_the_number_of_workers() -> None:
    def of_account(learner: Learner) -> int:
        (ticket,) = learner.tickets(b"w1")
        account = example(Heartbeat, session=learner.session(b"w1"), versions=(1,), tickets=(ticket,))
        return lines(lambda: learner.coordinator.receive(b"w1", account, learner.now))

    assert of_account(crowd(MANY)) <= of_account(crowd(FEW)) + 5


def test_while_a_lane_waits_to_move_the_rollouts_of_others_cost_no_more() -> None:
    def waiting(workers: int) -> Learner:
        learner = crowd(2 * workers)
        for number in range(workers):  # half of them leave; the others have two lanes each, until somebody comes
            process_ends(learner.coordinator, f"w{number}", "gone")
        learner.joins(b"newcomer", pid=9998)  # is given the lane whose rollout has come
        learner.joins(b"another", pid=9999)
        assert sum(lane.moving for lane in learner.coordinator.rollouts.lanes) == 1
        return learner

    def of_another(learner: Learner) -> int:
        (moving,) = [lane for lane in learner.coordinator.rollouts.lanes if lane.moving]
        tickets = learner.coordinator.rollouts.held.items()
        return of_rollout(learner, next(number for number, ticket in tickets if ticket.peer != moving.owner))

    assert of_another(waiting(MANY // 2)) <= of_another(waiting(FEW)) + 5


def test_silent_workers_are_removed_when_a_timeout_may_have_passed_and_not_before() -> None:
    learner = crowd(MANY)
    learner.coordinator.remove_silent(0.0)
    learner.now = 4.0
    for number in range(1, MANY):
        learner.beats(b"w%d" % number)
    assert lines(lambda: learner.coordinator.remove_silent(4.9)) < 20
    learner.coordinator.remove_silent(5.1)
    assert b"w0" not in learner.coordinator.members
    assert len(learner.coordinator.members) == MANY - 1
    assert lines(lambda: learner.coordinator.remove_silent(8.9)) < 20
    learner.coordinator.remove_silent(9.1)
    assert not learner.coordinator.members


def test_keys_are_looked_at_once_for_each_state_of_their_list() -> None:
    class Keyring:
        allowed = object()

    class Link:
        keyring = Keyring()
        asked = 0

        def rejection_reason(self, peer: bytes) -> str:
            self.asked += 1
            return "revoked" if peer == b"b" and self.keyring.allowed == "newer" else ""

    link: Any = Link()
    keys = KeyRevocation(link)
    assert keys.revoked([b"a", b"b"]) == []
    assert keys.revoked([b"a", b"b"]) == []
    assert link.asked == 2
    link.keyring.allowed = "newer"
    assert keys.revoked([b"a", b"b"]) == [(b"b", "revoked")]
    assert link.asked == 4
