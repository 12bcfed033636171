"""What a process takes from rank 0, and how it refuses."""

from __future__ import annotations

import pytest

from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.run_format import versions
from millrace.learner.shards.division import Division
from millrace.learner.shards.learners import Learners
from millrace.learner.shards.messages import Begin
from millrace.learner.shards.roles import algorithm_of
from millrace.learner.torch_setup import one_thread
from millrace.protocol.errors import UsageError
from tests.support.numbers.batches import DISCRETE


def begin(device: str = "cpu") -> Begin:
    config = resolve("CartPole-v1", shards=4, lanes=4, envs=4)
    return Begin(config.to_toml(), DISCRETE, "runs/some", device, versions())


def test_shards_are_those_of_rank_0() -> None:
    """Otherwise the processes would gather tensors of different sizes, and gloo would end them with SIGABRT."""
    learners = Learners(Division(2, 1, 0))
    with one_thread():
        algorithm_of(begin(), learners)
    assert learners.division == Division(4, 1, 0)


def test_any_error_is_a_refusal_that_names_the_rank() -> None:
    """A process without a GPU, for example, gets an error of PyTorch."""
    with one_thread(), pytest.raises(UsageError, match=r"^learner: rank 0: .*device"):
        algorithm_of(begin("no such device"), Learners(Division(4, 1, 0)))
