"""Every interleaving of messages, faults and time in small runs with evaluations.

Rule: as in `tests/model/test_model.py`, the program itself is explored: each evaluation is of one version, all its episodes
count once, no ticket for a rollout is dealt meanwhile, and every run goes on after it and reaches its target.
"""

from __future__ import annotations

import sys

import pytest

from learner.rollouts.evaluation_tickets import EvaluationTickets
from tests.model.evaluation import learner_half, worker_half
from tests.model.evaluation.evaluating import Evaluating
from tests.model.evaluation.mutations import MUTATIONS, OF_THE_LEARNER, OF_THE_WORKER
from tests.model.mutations import check_that_they_fit, find
from tests.model.search import explore
from tests.support.conversation.fake_ends import run_spec
from workers.conversation.held import HeldEvaluations

LIST = "tests.model.evaluation.mutations"
SMALL = [
    Evaluating(workers=1, lanes=1, updates=1, faults=1),
    Evaluating(workers=1, lanes=1, updates=1, faults=1, episodes=1, rows=True),
]
LARGE = [
    Evaluating(workers=2, lanes=1, updates=1, faults=1),
    Evaluating(workers=2, lanes=1, updates=1, faults=1, evaluated=(1,)),
    Evaluating(workers=2, lanes=1, updates=1, faults=1, episodes=1, rows=True),
    Evaluating(workers=1, lanes=2, updates=2, faults=1, max_lag=1, evaluated=(1, 2)),
    Evaluating(workers=2, lanes=1, updates=2, faults=1, max_lag=1, evaluated=(1,)),
    Evaluating(workers=1, lanes=1, updates=1, faults=2),
]


@pytest.mark.parametrize("run", SMALL, ids=str)
def test_one_worker_one_fault_of_any_kind(run: Evaluating) -> None:
    report = explore(run)
    assert report.complete
    assert report.states > 1_000, f"the model has lost most of its states: {report}"


@pytest.mark.model
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("run", LARGE, ids=str)
def test_larger_runs(run: Evaluating) -> None:
    report = explore(run)
    sys.stdout.write(f"\n{report}\n")
    assert report.complete


def test_every_field_is_in_the_state_or_left_out_on_purpose() -> None:
    assert set(vars(EvaluationTickets(run_spec().policy))) == learner_half.SAVED | learner_half.NOT_SAVED
    assert set(vars(HeldEvaluations())) == worker_half.SAVED


def test_a_mistake_is_found() -> None:
    """So that it is known in every `make test` that the checker can fail."""
    assert find("a ticket that was put back is lost", LIST).endswith("a ticket of an evaluation is not in one place")


@pytest.mark.model
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", MUTATIONS)
def test_every_mistake_is_found(name: str) -> None:
    find(name, LIST)


def test_every_mutation_fits_the_program() -> None:
    assert min(len(OF_THE_LEARNER), len(OF_THE_WORKER)) >= 5
    check_that_they_fit(MUTATIONS)
