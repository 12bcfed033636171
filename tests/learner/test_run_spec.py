"""A policy that cannot be sent is refused in one line, before anything of its size is allocated."""

from __future__ import annotations

import numpy as np
import pytest

from learner.config.config import Config
from learner.env_spaces import EnvSpaces
from learner.run_spec import run_spec
from protocol.env_spec import EnvSpec
from protocol.envs.description import read_description
from protocol.errors import UsageError
from protocol.space_spec import BoxSpace, DictSpace, DiscreteSpace, EnvDescription, MultiDiscreteSpace, SpaceSpec, check_size
from protocol.wire.plain_values import pack

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
