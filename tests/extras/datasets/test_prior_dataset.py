"""A Minari dataset as batches: every transition as it was recorded, or one line about what does not fit."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from millrace.extras.datasets.prior_dataset import PriorDataset
from millrace.protocol.envs.env_actions import action_converter_of, stored_actions_of
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import UsageError
from millrace.protocol.specs import PolicySpec

minari = pytest.importorskip("minari")
BOX = spaces.Box(-1, 1, (2,), np.float32)
DICT = spaces.Dict({"a": BOX, "b": spaces.Discrete(4, start=1)})
Store = Callable[..., PolicySpec]
NAME = "toy/prior-v0"


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Store:
    """Writes a dataset of episodes (arguments of Minari's `EpisodeBuffer`). Returns the policy of its spaces."""
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))

    def write(observation: gymnasium.Space[Any], action: gymnasium.Space[Any], *episodes: dict[str, Any]) -> PolicySpec:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            minari.create_dataset_from_buffers(
                NAME,
                buffer=[EpisodeBuffer(id=n, infos={}, **episode) for n, episode in enumerate(episodes)],
                observation_space=observation,
                action_space=action,
                data_format="hdf5",
            )
        return PolicySpec(observation_leaves(observation), action_spec(action))

    return write


def episode(T: int, end: str = "terminated", seed: int = 0, **other: Any) -> dict[str, Any]:
    """T steps with a vector observation and a choice of two actions."""
    generator = np.random.default_rng(seed)
    last = np.arange(T) == T - 1
    return {
        "observations": generator.uniform(-1, 1, (T + 1, 2)).astype(np.float32),
        "actions": generator.integers(2, size=T),
        "rewards": generator.normal(size=T),
        "terminations": last & (end == "terminated"),
        "truncations": last & (end == "truncated"),
    } | other


def test_every_transition_is_there_as_it_was_recorded(store: Store) -> None:
    recorded = [episode(3), episode(5, "truncated", 1), episode(1, seed=2)]
    prior = PriorDataset(NAME, store(BOX, spaces.Discrete(2), *recorded))
    assert (prior.rows, prior.episodes) == (9, 3)
    batches = list(prior.batches())
    assert [batch.env_steps for batch in batches] == [3, 5, 1]
    for batch, had in zip(batches, recorded, strict=True):
        np.testing.assert_array_equal(batch.obs[0][:, 0], had["observations"])
        np.testing.assert_array_equal(batch.action[:, 0], had["actions"])
        np.testing.assert_array_equal(batch.reward[:, 0], had["rewards"].astype(np.float32))
        np.testing.assert_array_equal(batch.terminated[:, 0], had["terminations"])
        np.testing.assert_array_equal(batch.truncated[:, 0], had["truncations"])
        assert batch.valid.all()
        assert batch.fresh.all(), "nothing carries over from another episode"


def test_an_episode_that_the_dataset_left_open_is_truncated(store: Store) -> None:
    (batch,) = PriorDataset(NAME, store(BOX, spaces.Discrete(2), episode(4, "open"))).batches()
    assert batch.truncated[:, 0].tolist() == [False, False, False, True]
    assert not batch.terminated.any()


def test_leaves_of_a_dict_and_choices_that_do_not_begin_at_0(store: Store) -> None:
    seen = {"a": np.ones((3, 2), np.float32), "b": np.array([1, 4, 2])}
    policy = store(DICT, spaces.Discrete(2, start=5), episode(2, observations=seen, actions=np.array([5, 6])))
    (batch,) = PriorDataset(NAME, policy).batches()
    assert [leaf.shape for leaf in batch.obs] == [(3, 1, 2), (3, 1)]
    assert batch.obs[1][:, 0].tolist() == [1, 4, 2]
    assert batch.action[:, 0].tolist() == [0, 1], "stored choices count from 0"


@pytest.mark.parametrize("head", ["actor_critic", "squashed"])
@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(3, start=-1),
        spaces.MultiDiscrete([3, 2], start=[1, 5]),
        spaces.MultiBinary(3),
        spaces.Box(-2, 3, (2, 2), np.float32),
        spaces.Box(np.array([-2, 1], np.float32), np.array([3, 1], np.float32)),  # the second element is always 1
    ],
)
def test_stored_actions_are_converted_to_those_of_the_environment(space: gymnasium.Space[Any], head: Any) -> None:
    if head == "squashed" and not isinstance(space, spaces.Box):
        pytest.skip("a squashed Gaussian is for a Box alone")
    space.seed(1)
    policy = PolicySpec(observation_leaves(BOX), action_spec(space), head=head)
    actions = np.stack([space.sample() for _ in range(20)])
    stored = stored_actions_of(policy)([actions])
    assert stored.dtype == np.dtype(policy.action.stored_dtype)
    if head == "squashed":
        assert np.abs(stored).max() <= 1
        assert np.abs(stored).max() > 0.9, "the whole range is used"
    # one rounding to float32 in [-1, 1], scaled by 2.5, and one in [-2, 3]
    np.testing.assert_allclose(action_converter_of(policy)(stored), actions, atol=8 * float(np.finfo(np.float32).eps))


def refusal(policy: PolicySpec, name: str = NAME) -> str:
    with pytest.raises(UsageError) as error:
        list(PriorDataset(name, policy).batches())
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_dataset_of_another_environment_is_refused_in_one_line(store: Store) -> None:
    policy = store(BOX, spaces.Discrete(2), episode(2))
    other = PolicySpec(policy.observation, action_spec(spaces.Discrete(3)))
    assert refusal(other).startswith("prior toy/prior-v0: actions: expected ")
    wider = PolicySpec(observation_leaves(spaces.Box(-1, 1, (3,), np.float32)), policy.action)
    assert refusal(wider).startswith("prior toy/prior-v0: observations: expected ")
    assert "of the same environment" in refusal(wider)


def test_a_dataset_that_is_not_there_is_refused_with_those_that_are(store: Store) -> None:
    policy = store(BOX, spaces.Discrete(2), episode(2))
    assert refusal(policy, "toy/prio-v0") == (
        "prior toy/prio-v0: no such dataset here; there are: toy/prior-v0. `minari download` gets others"
    )


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"rewards": np.array([0.0, np.nan, 0.0])}, "episode 0: reward: expected finite values, got nan at step 1"),
        (
            {"observations": np.full((4, 2), np.inf, np.float32)},
            "episode 0: observation: expected finite values, got inf at step 0",
        ),
        ({"actions": np.array([0, 1, 2])}, "episode 0: action: expected 0 to 1, got 2 at step 2"),
        (
            {"terminations": np.array([True, False, True])},
            "episode 0: expected an end only in its last step, got one in step 0",
        ),
    ],
)
def test_rows_that_cannot_be_learned_from_are_named(store: Store, changed: dict[str, Any], says: str) -> None:
    assert says in refusal(store(BOX, spaces.Discrete(2), episode(3, **changed)))
