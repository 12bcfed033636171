"""Every interleaving of messages, faults and time in small runs: of training, of evaluations, and of vector environments.

Rule: the program itself is explored, not a description of it. In training every rule of tickets, lanes and weights holds,
those of opponents among them, and the run reaches its target; each evaluation is of one version, its episodes count once,
and no ticket for a rollout is dealt meanwhile, unless workers that have no lanes play it; each order of a vector
environment is executed once, a lost lane is reported once and reset before it steps, and every call returns, or is made
again. One worker of those that join before there is a run describes the environment, and all take part in the run in the
same sessions. Mistakes that are made on purpose are found.
"""

from __future__ import annotations

import sys

import pytest

from tests.model import mutations
from tests.model.conversation import Conversation
from tests.model.describing import mutations as of_describing
from tests.model.describing.describing import Describing
from tests.model.evaluation import mutations as of_evaluation
from tests.model.evaluation.evaluating import Evaluating
from tests.model.mutations import check_that_they_fit, find
from tests.model.search import explore
from tests.model.training import Training
from tests.model.vector_env import mutations as of_vector_env
from tests.model.vector_env.stepping import Stepping

LISTS = {module.__name__: module.MUTATIONS for module in (mutations, of_describing, of_evaluation, of_vector_env)}
SMALL: list[Conversation] = [
    Training(workers=2, lanes=2, updates=5, faults=0, opponents=3),
    Describing(workers=2, lanes=1, updates=1, faults=1),
    Evaluating(workers=1, lanes=1, updates=1, faults=1),
    Evaluating(workers=1, lanes=1, updates=1, faults=1, episodes=1, rows=True),
    Evaluating(workers=1, lanes=1, updates=1, faults=1, evaluated=(0, 1), evaluators=0),
    Stepping(workers=1, lanes=1, calls=("reset", "step", "call", "step"), faults=1),
    Stepping(workers=1, lanes=1, calls=("reset", "interrupted reset", "reset", "step"), faults=1),
    Stepping(workers=1, lanes=1, calls=("reset", "abandoned reset", "step"), faults=1),
]
LARGE: list[Conversation] = [
    Training(workers=2, lanes=1, updates=2, faults=2),
    Training(workers=2, lanes=1, updates=3, faults=1, max_lag=1),
    Training(workers=2, lanes=1, updates=3, faults=1, max_lag=2),
    Training(workers=2, lanes=2, updates=1, faults=1),
    Training(workers=2, lanes=2, updates=2, faults=1, max_lag=1),
    Training(workers=1, lanes=1, updates=2, faults=3),
    Training(workers=1, lanes=1, updates=3, faults=1),
    Training(workers=1, lanes=1, updates=3, faults=2, max_lag=1),
    Training(workers=2, lanes=1, updates=1, faults=2, only=("drop up", "drop down")),
    Training(workers=2, lanes=1, updates=2, faults=2, max_lag=1, only=("drop up", "drop down")),
    Training(workers=2, lanes=2, updates=5, faults=0, max_lag=1, opponents=3),
    Training(workers=1, lanes=1, updates=3, faults=2, opponents=3),
    Training(workers=2, lanes=1, updates=3, faults=1, max_lag=1, opponents=2),
    Training(workers=1, lanes=1, updates=4, faults=1, max_lag=1, opponents=2),
    Training(workers=1, lanes=2, updates=4, faults=1, max_lag=1, opponents=2),
    Describing(workers=1, lanes=1, updates=1, faults=2),
    Describing(workers=2, lanes=1, updates=1, faults=1, environments=2),
    Describing(workers=2, lanes=2, updates=1, faults=1),
    Describing(workers=2, lanes=1, updates=1, faults=2),
    Describing(workers=1, lanes=1, updates=1, faults=2, environments=2),
    Evaluating(workers=2, lanes=1, updates=1, faults=1),
    Evaluating(workers=2, lanes=1, updates=1, faults=1, evaluated=(1,)),
    Evaluating(workers=2, lanes=1, updates=1, faults=1, episodes=1, rows=True),
    Evaluating(workers=1, lanes=2, updates=2, faults=1, max_lag=1, evaluated=(1, 2)),
    Evaluating(workers=2, lanes=1, updates=2, faults=1, max_lag=1, evaluated=(1,)),
    Evaluating(workers=1, lanes=1, updates=1, faults=2),
    Evaluating(workers=1, lanes=1, updates=2, faults=2, episodes=1, evaluators=0),
    Evaluating(workers=2, lanes=1, updates=2, faults=1, episodes=1, evaluated=(0, 1), evaluators=1),
    Evaluating(workers=2, lanes=1, updates=2, faults=1, episodes=1, max_lag=1, evaluators=1),
    Evaluating(workers=3, lanes=1, updates=1, faults=1, evaluators=2, only=("kill, reported",)),
    Stepping(workers=1, lanes=1, calls=("reset", "step", "call", "step"), faults=2),
    Stepping(workers=2, lanes=1, calls=("reset", "step"), faults=2),
    Stepping(workers=2, lanes=1, calls=("reset", "step", "step"), faults=1),
    Stepping(workers=1, lanes=2, calls=("reset", "step", "call", "step"), faults=1),
    Stepping(workers=2, lanes=2, calls=("reset", "step", "step"), faults=1),
]


@pytest.mark.parametrize("run", SMALL, ids=str)
def test_small_runs_with_at_most_one_fault_of_any_kind(run: Conversation) -> None:
    report = explore(run)
    assert report.complete
    assert report.states > 1_000, f"the model has lost most of its states: {report}"


@pytest.mark.model
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("run", LARGE, ids=str)
def test_larger_runs(run: Conversation) -> None:
    report = explore(run)
    sys.stdout.write(f"\n{report}\n")
    assert report.complete


def test_a_mistake_is_found_and_told_as_a_story() -> None:
    """One mistake that only liveness shows, in every `make test`, so that it is known that the checker can fail."""
    story = find("a lost Collect is not sent again")
    assert "Collect(session 0, 0, ((ticket 0, 0, incarnation 0:0, 0, 0, None, None),)," in story
    assert " to worker 0 is lost." in story
    assert story.endswith("Then: and so on: the run never reaches its target")


@pytest.mark.parametrize(
    ("module", "name", "rule"),
    [
        (of_describing.__name__, "all workers describe", "2 workers are asked to describe, instead of 1"),
        (of_evaluation.__name__, "a ticket that was put back is lost", "a ticket of an evaluation is not in one place"),
        (of_vector_env.__name__, "a lost order is not sent again", "a worker that is heard does not answer"),
    ],
)
def test_a_mistake_is_found_in_each_conversation(module: str, name: str, rule: str) -> None:
    assert find(name, module).endswith(rule)


@pytest.mark.model
@pytest.mark.timeout(1200)
@pytest.mark.parametrize(("module", "name"), [(module, name) for module, names in LISTS.items() for name in names])
def test_every_mistake_is_found(module: str, name: str) -> None:
    find(name, module)


@pytest.mark.parametrize("module", LISTS)
def test_every_mutation_fits_the_program(module: str) -> None:
    of = [each.module.split(".")[1] for each in LISTS[module].values()]
    assert min(of.count("learner"), of.count("workers")) >= 5, "one of the two halves has too few"
    check_that_they_fit(LISTS[module])
