"""What the exploration of a training run rests on: its states, its reductions, and the fields that it saves.

Rule: the real `TicketCoordinator` and the real `Session` are explored, not a description of them. Faults: a message is lost,
repeated or delayed; a worker is killed, frozen or shut out; the learner restarts from any of its checkpoints. After all
faults one worker, or its link, may be gone for ever.
"""

from __future__ import annotations

from typing import Any

import pytest

from millrace.learner.members.describe_coordinator import DescribeCoordinator
from millrace.learner.members.lane_placement import LanePlacement
from millrace.learner.members.member import Member
from millrace.learner.members.membership import Membership
from millrace.learner.rollouts.evaluation_dealer import EvaluationDealer, EvaluationPlan
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.lanes import TakenRollouts, Ticket, TicketedLane
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.sent_weights import SentWeights, WeightsHeld
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.learner.vector_env.order_coordinator import OrderCoordinator, OrderedLane
from millrace.protocol.messages import Permit
from millrace.workers.conversation.held import (
    HeldDescriptions,
    HeldEvaluations,
    HeldOrders,
    HeldRollouts,
    OrderLane,
    RolloutLane,
)
from millrace.workers.conversation.session import Session, WorkerIdentity, _SessionState
from tests.model import learner_part, worker_part
from tests.model.conversation import Content
from tests.model.describing import learner_half as of_describing
from tests.model.describing import worker_half as describing_worker
from tests.model.evaluation import learner_half as of_evaluation
from tests.model.evaluation import worker_half as evaluating_worker
from tests.model.message_content import WAIT, hello
from tests.model.names import names_in, renamed, renaming
from tests.model.search import Search
from tests.model.settings import TIMEOUT_S, Settings
from tests.model.training import Training
from tests.model.vector_env import learner_half as of_vector_env
from tests.model.vector_env import worker_half as stepping_worker
from tests.model.vector_env.stepping import Stepping
from tests.model.worker_part import Worker
from tests.model.world import GONE, World
from tests.support.conversation.example_messages import example

SMALL = Training(workers=2, lanes=1, updates=2, faults=1, max_lag=1)


@pytest.fixture(scope="module")
def searched() -> Search:
    """All states of two workers and one lane, with one fault of any kind, at a lag of 1."""
    search = Search(World(SMALL))
    report = search.run()
    assert report.complete
    return search


@pytest.mark.model
def test_no_rule_is_broken_with_one_fault_of_any_kind(searched: Search) -> None:
    states = len(searched.states)
    assert states > 10_000, f"the model has lost most of its states: {states:,}"


@pytest.mark.model
def test_a_worker_holds_the_versions_that_its_tickets_name(searched: Search) -> None:
    """Else the model would not show what happens when one of two versions is lost."""
    of, held = searched.world.parts, set()
    for _, *seats, _ in searched.states:
        for seat in seats:
            worker = worker_part.loaded(of[of[seat].worker], 0, SMALL, Worker) if of[of[seat].worker] != GONE else None
            if worker is not None and worker.session is not None:
                current = worker.session._current
                held.add((tuple(current.weights), tuple(sorted(current.rollouts.versions()))))
    assert ((0, 1), (0, 1)) in held


@pytest.mark.model
def test_the_reductions_leave_out_no_state_of_the_learner_or_of_a_worker(searched: Search) -> None:
    """Every rule is about the learner or about one worker, so a broken one shows in the same states with and without."""

    def parts(search: Search) -> tuple[set[Any], set[Any]]:
        of = search.world.parts
        learners = {learner for learner, *_ in search.states}
        workers = {of[seat].worker for _, *seats, _ in search.states for seat in seats}
        return {alone(SMALL.without_checkpoints(of[each])) for each in learners}, {alone(of[each]) for each in workers}

    def alone(content: Content) -> Any:
        """Under names that do not depend on the other parts of the state."""
        return renamed(content, renaming(names_in(content, set()), {worker: worker for worker in range(SMALL.workers)}))

    not_reduced = Search(World(SMALL, reduced=False))
    assert not_reduced.run().complete
    assert parts(searched) == parts(not_reduced)
    assert len(searched.states) < len(not_reduced.states) / 2


def test_every_field_of_the_program_is_in_the_state_or_left_out_on_purpose() -> None:
    """A field that the model does not know would make different states look the same."""
    settings = Settings(workers=1, lanes=1, updates=1, faults=0)
    learner, _ = learner_part.first_learner(settings, learner_part.Learner)
    coordinator = learner.coordinator
    session = Session(WorkerIdentity("w0", "host", 1, 1, "model"), 0.0)
    known = {each: learner_part.SAVED[each] | learner_part.NOT_SAVED[each] for each in learner_part.SAVED}
    known |= {each: worker_part.SAVED[each] | worker_part.NOT_SAVED[each] for each in worker_part.SAVED}
    objects: list[object] = [
        coordinator,
        coordinator.membership,
        Member(b"w0", hello(0, 1, 1), 0, 0, 0.0),
        coordinator.rollouts,
        coordinator.weights,
        coordinator.weights.held,
        coordinator.rollouts.lanes[0],
        coordinator.rollouts.lanes[0].taken,
        Ticket(example(Permit), 0, b"w0"),
        coordinator._placement,
        coordinator.rollouts.rounds,
        session,
        session._current,
        session._current.rollouts,
        RolloutLane(0),
    ]
    types = TicketCoordinator, Membership, Member, RolloutDealer, SentWeights, WeightsHeld
    of_lanes = TicketedLane, TakenRollouts, Ticket
    more = LanePlacement, Rounds, Session, _SessionState, HeldRollouts, RolloutLane
    assert [type(each) for each in objects] == [*types, *of_lanes, *more]
    assert {type(each): set(vars(each)) for each in objects} == known
    wait = DescribeCoordinator(WAIT, 0, worker_timeout_s=TIMEOUT_S, decliners_to_end=0)
    assert set(vars(wait)) == of_describing.SAVED | of_describing.NOT_SAVED
    assert set(vars(HeldDescriptions())) == describing_worker.SAVED
    dealer = EvaluationDealer(settings.run)
    dealer.begin(EvaluationPlan((1,), copies=1, most_steps=1), version=0)
    for part in (dealer, dealer.pending):
        assert set(vars(part)) == of_evaluation.SAVED[type(part)] | of_evaluation.NOT_SAVED[type(part)]
    assert set(vars(HeldEvaluations())) == evaluating_worker.SAVED
    stepping = of_vector_env.Learner(Stepping(workers=1, lanes=1, calls=(), faults=0), 0, 0.0).coordinator
    assert type(stepping) is OrderCoordinator
    assert set(vars(stepping)) == of_vector_env.SAVED | of_vector_env.NOT_SAVED
    assert set(vars(OrderedLane(0))) == {
        *("number", "incarnation", "owner", "started", "order"),
        *("moving", "long_infos"),  # not saved: no lane waits to move, and no step goes through shared memory
    }
    assert set(vars(HeldOrders())) == stepping_worker.SAVED
    assert set(vars(OrderLane(0))) == {"incarnation", "newest", "asked", "answered"}
