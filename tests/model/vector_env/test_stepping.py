"""Every interleaving of messages, faults and time while a program uses a vector environment.

Rule: as in `tests/model/test_model.py`, the program itself is explored. Each order is executed once, and its result used
once; a lane has one owner; a lost lane is reported once and reset before it steps; and every call returns, or is made again.
"""

from __future__ import annotations

import sys

import pytest

from learner.vector_env.order_coordinator import OrderCoordinator, OrderedLane
from tests.model.mutations import check_that_they_fit, find
from tests.model.search import explore
from tests.model.vector_env import learner_half, worker_half
from tests.model.vector_env.mutations import MUTATIONS, OF_THE_LEARNER, OF_THE_WORKER
from tests.model.vector_env.stepping import Stepping
from workers.conversation.held import HeldOrders, OrderLane

LIST = "tests.model.vector_env.mutations"
SMALL = [
    Stepping(workers=1, lanes=1, calls=("reset", "step", "call", "step"), faults=1),
]
LARGE = [
    Stepping(workers=1, lanes=1, calls=("reset", "step", "call", "step"), faults=2),
    Stepping(workers=2, lanes=1, calls=("reset", "step"), faults=2),
    Stepping(workers=2, lanes=1, calls=("reset", "step", "step"), faults=1),
    Stepping(workers=1, lanes=2, calls=("reset", "step", "call", "step"), faults=1),
    Stepping(workers=2, lanes=2, calls=("reset", "step", "step"), faults=1),
]


@pytest.mark.parametrize("run", SMALL, ids=str)
def test_one_worker_one_fault_of_any_kind(run: Stepping) -> None:
    report = explore(run)
    assert report.complete
    assert report.states > 1_000, f"the model has lost most of its states: {report}"


@pytest.mark.model
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("run", LARGE, ids=str)
def test_larger_runs(run: Stepping) -> None:
    report = explore(run)
    sys.stdout.write(f"\n{report}\n")
    assert report.complete


def test_every_field_is_in_the_state_or_left_out_on_purpose() -> None:
    learner = learner_half.Learner(SMALL[0], 0, 0.0)
    assert set(vars(learner.coordinator)) == learner_half.SAVED | learner_half.NOT_SAVED
    assert type(learner.coordinator) is OrderCoordinator
    assert set(vars(OrderedLane(0))) == {"number", "incarnation", "owner", "moving", "started"}  # no lane waits to move
    assert set(vars(HeldOrders())) == worker_half.SAVED
    assert set(vars(OrderLane(0))) == {"incarnation", "newest", "asked", "answered"}


def test_a_mistake_is_found() -> None:
    """So that it is known in every `make test` that the checker can fail."""
    assert find("a lost order is not sent again", LIST).endswith("a worker that is heard does not answer")


@pytest.mark.model
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", MUTATIONS)
def test_every_mistake_is_found(name: str) -> None:
    find(name, LIST)


def test_every_mutation_fits_the_program() -> None:
    assert min(len(OF_THE_LEARNER), len(OF_THE_WORKER)) >= 5
    check_that_they_fit(MUTATIONS)
