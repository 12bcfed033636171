"""A policy that cannot be sent is refused in one line, before anything of its size is allocated."""

from __future__ import annotations

import numpy as np
import pytest

from millrace.learner.config.config import Config
from millrace.learner.env_spaces import EnvSpaces
from millrace.learner.run_spec import run_spec
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.description import read_description
from millrace.protocol.errors import UsageError
from millrace.protocol.space_spec import (
    BoxSpace,
    DictSpace,
    DiscreteSpace,
    EnvDescription,
    MultiDiscreteSpace,
    SpaceSpec,
    check_size,
)
from millrace.protocol.wire.plain_values import pack

SMALL = DiscreteSpace(2, 0, "int64")
HUGE = DiscreteSpace(2**53, 0, "int64")
SPACES: dict[str, tuple[SpaceSpec, SpaceSpec]] = {
    "actions": (SMALL, HUGE),
    "observations": (HUGE, SMALL),
    "many choices": (SMALL, MultiDiscreteSpace("int64", np.full(9, 2**40), np.zeros(9, np.int64))),
    "numbers": (BoxSpace((1 << 24,), "float32", np.array(0, np.float32), np.array(1, np.float32)), SMALL),
}


@pytest.mark.parametrize("spaces", SPACES)
def test_spaces_that_would_make_a_policy_too_large_are_refused_in_one_line(spaces: str) -> None:
    description = EnvDescription(*SPACES[spaces], np.frombuffer(pack({}), np.uint8), "", 0, "")
    check_size(description)
    env = EnvSpaces.of_description(read_description(description))
    with pytest.raises(UsageError, match=r"^environment Any-v0: expected a policy whose weights take at most [\d,]+ bytes"):
        run_spec(Config(env="Any-v0"), EnvSpec("Any-v0"), env)


BOX = BoxSpace((1,), "float32", np.array(0, np.float32), np.array(1, np.float32))


@pytest.mark.parametrize(
    ("observation", "expected"),
    [
        (DictSpace((), ()), r"^observation space Dict\(\): expected at least one array for the policy, got none$"),
        (DictSpace(("a/b", "a"), (BOX, DictSpace(("b",), (BOX,)))), "expected a name for each array, .* are called a/b$"),
    ],
)
def test_observations_whose_arrays_cannot_be_named_are_refused(observation: SpaceSpec, expected: str) -> None:
    description = EnvDescription(observation, SMALL, np.frombuffer(pack({}), np.uint8), "", 0, "")
    with pytest.raises(UsageError, match=expected):
        EnvSpaces.of_description(read_description(description))


def test_a_number_of_the_environment_may_not_be_called_as_the_return_of_an_agent() -> None:
    """Both are facts of an episode, and the metrics of one name would hold one of them."""
    description = EnvDescription(BOX, SMALL, np.frombuffer(pack({}), np.uint8), "", 0, "", seats=("a", "b"))
    env, described = EnvSpec("my_module:Game"), EnvSpaces.of_description(read_description(description))
    kept = run_spec(Config(env="my_module:Game", info_keys=("return_c", "wins")), env, described)
    assert kept.facts == ("return_c", "wins", "return_a", "return_b")
    for opponents in ({}, {"self_play": 1}):
        config = Config(env="my_module:Game", info_keys=("wins", "return_b"), **opponents)  # type: ignore[arg-type]
        with pytest.raises(
            UsageError, match=r"^info_keys: expected another name than return_b, which is the return of agent b$"
        ):
            run_spec(config, env, described)
