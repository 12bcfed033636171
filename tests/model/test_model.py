"""Every interleaving of messages, faults and time in small runs: no rule is ever broken, and every run reaches its target.

Rule: the real `TicketCoordinator` and the real `Session` are explored, not a description of them. Faults: a message is lost,
repeated or delayed; a worker is killed, frozen or shut out; the learner restarts from any of its checkpoints.
"""

from __future__ import annotations

import sys

import pytest

from learner.members.lane_placement import LanePlacement
from learner.members.membership import Membership
from learner.rollouts.lanes import LaneQueue, Ticket, TicketedLane
from learner.rollouts.ticket_coordinator import CollectingMember, TicketCoordinator
from tests.model import learner_part, worker_part
from tests.model.explore import explore
from tests.model.message_content import hello
from tests.model.settings import Settings
from tests.model.training import Training
from workers.collect.held_rollouts import HeldRollouts, _HeldLane
from workers.session import Identity, Session, _SessionState


def test_two_workers_one_lane_one_fault_of_any_kind() -> None:
    report = explore(Training(workers=2, lanes=1, updates=1, faults=1))
    assert report.complete
    assert report.states > 10_000, f"the model has lost most of its states: {report}"


@pytest.mark.model
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    "training",
    [
        Training(workers=2, lanes=2, updates=1, faults=1),
        Training(workers=2, lanes=1, updates=2, faults=1, max_lag=1),
        Training(workers=2, lanes=1, updates=2, faults=2),
    ],
    ids=str,
)
def test_larger_runs(training: Training) -> None:
    report = explore(training, processes=2)
    sys.stdout.write(f"\n{report}\n")
    assert report.complete


def test_every_field_of_the_program_is_in_the_state_or_left_out_on_purpose() -> None:
    """A field that the model does not know would make different states look the same."""
    settings = Settings(workers=1, lanes=1, updates=1, faults=0)
    learner, _ = learner_part.first_learner(settings, learner_part.Learner)
    coordinator = learner.coordinator
    session = Session(Identity("w0", "host", 1, 1, "model"), 0.0)
    known = {each: learner_part.SAVED[each] | learner_part.NOT_SAVED[each] for each in learner_part.SAVED}
    known |= {each: worker_part.SAVED[each] | worker_part.NOT_SAVED[each] for each in worker_part.SAVED}
    objects: list[object] = [
        coordinator,
        coordinator.membership,
        CollectingMember(b"w0", hello(0, 1, 1), 0, 0, 0.0),
        coordinator.lanes[0],
        Ticket(0, 0, 0, 0, b"w0"),
        coordinator._placement,
        coordinator._queue,
        session,
        session._current,
        session._current.rollouts,
        _HeldLane(0),
    ]
    types = TicketCoordinator, Membership, CollectingMember, TicketedLane, Ticket, LanePlacement, LaneQueue
    assert [type(each) for each in objects] == [*types, Session, _SessionState, HeldRollouts, _HeldLane]
    assert {type(each): set(vars(each)) for each in objects} == known
