"""Greedy episodes: exact on environments whose answer is known, unbiased, the same for the same seed."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from learner import evaluate as evaluate_module
from learner.config.layers import resolve
from learner.evaluate import COPIES, evaluate, load_policy
from learner.run_folder.run_folder import RunFolder
from protocol.env_spec import EnvSpec
from protocol.envs.spaces import action_spec, observation_leaves
from protocol.errors import EnvironmentFailed, UsageError
from protocol.policy.layout import acting_size, buffer_size
from protocol.specs import PolicySpec

Array = np.ndarray[Any, Any]


class Echo(gymnasium.Env[Any, Any]):
    """Shows a number; reward 1 for saying it, 0 otherwise. A copy's episodes last 3, 6, 9, … steps, or never end."""

    made: list["Echo"] = []

    def __init__(self, fails_at: int = 0, endless: bool = False) -> None:
        self.observation_space = spaces.Discrete(5)
        self.action_space = spaces.Discrete(5)
        self.seeds: list[int | None] = []
        self.closed, self.steps, self.episode, self.number = False, 0, 0, 0
        self.fails_at, self.endless = fails_at, endless
        Echo.made.append(self)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.steps, self.episode = 0, self.episode + 1
        return self._next(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        if self.steps == self.fails_at:
            raise RuntimeError("the spring broke\nin two")
        right = float(action == self.number)
        ended = not self.endless and self.steps == 3 * self.episode
        return self._next(), right, ended and self.episode % 2 == 1, ended, {}

    def _next(self) -> int:
        self.number = int(self.np_random.integers(5))
        return self.number

    def close(self) -> None:
        self.closed = True


gymnasium.register("millrace-tests/Echo-v0", entry_point=lambda **kwargs: Echo(**kwargs))


class Says:
    """A policy that says what it sees, or always the same."""

    def __init__(self, always: int | None = None) -> None:
        self.always = always
        self.rows: Counter[int] = Counter()

    def load(self, parameters: Any, buffers: Any) -> None:
        pass

    def __call__(self, leaves: Sequence[Array], state: Array | None = None) -> Any:
        (seen,) = leaves
        assert seen.shape[0] == 1
        self.rows[seen.shape[1]] += 1
        return np.eye(5, dtype=np.float32)[seen if self.always is None else np.full_like(seen, self.always)]


@pytest.fixture
def made() -> list[Echo]:
    Echo.made.clear()
    return Echo.made


ECHO = EnvSpec("millrace-tests/Echo-v0")
SPEC = PolicySpec((), action_spec(spaces.Discrete(5)))


def test_greedy_actions_reach_the_environment(made: list[Echo]) -> None:
    found = evaluate(ECHO, Says(), SPEC, episodes=2, seed=1)
    assert (found.return_mean, found.return_std, found.length_mean) == (3.0, 0.0, 3.0)  # one episode each of two copies
    wrong = evaluate(ECHO, Says(always=4), SPEC, episodes=40, seed=1)
    assert wrong.return_std > 0
    assert 0.5 < wrong.return_mean < 1.5  # one in five by chance, of 3 and 6 steps
    assert all(env.closed for env in made)


def test_each_copy_plays_its_share_and_short_episodes_gain_nothing(made: list[Echo]) -> None:
    policy = Says()
    found = evaluate(ECHO, policy, SPEC, episodes=2 * COPIES + 5, seed=1)
    assert len(made) == COPIES
    assert found.episodes == 2 * COPIES + 5
    assert Counter(env.episode for env in made) == {2: COPIES - 5, 3: 5}  # nobody starts one that is not wanted
    lengths = [3] * COPIES + [6] * COPIES + [9] * 5
    assert found.length_mean == found.return_mean == np.mean(lengths)
    assert found.return_std == np.std(lengths)
    assert policy.rows == {COPIES: 9, 5: 9}  # copies that are done are stepped no more


def test_the_same_seed_gives_the_same_episodes_and_no_two_copies_the_same(made: list[Echo]) -> None:
    first, again, other = (evaluate(ECHO, Says(always=0), SPEC, 30, seed) for seed in (1, 1, 2))
    assert first == again != other
    starts = [env.seeds[0] for env in made[:COPIES]]
    assert len(set(starts)) == COPIES
    assert starts == [env.seeds[0] for env in made[COPIES : 2 * COPIES]]
    assert all(seed is None for env in made for seed in env.seeds[1:])


def test_the_learner_pulses_at_every_step() -> None:
    beats: list[None] = []
    evaluate(ECHO, Says(), SPEC, 1, seed=1, pulse=lambda: beats.append(None))
    assert len(beats) == 3


def test_an_environment_that_raises_is_named_with_its_traceback(made: list[Echo]) -> None:
    with pytest.raises(EnvironmentFailed) as caught:
        evaluate(EnvSpec(ECHO.id, {"fails_at": 2}), Says(), SPEC, 3, seed=1)
    assert str(caught.value) == (
        "environment millrace-tests/Echo-v0 raised while the policy was evaluated: RuntimeError: the spring broke"
    )
    assert "in step" in caught.value.detail
    assert all(env.closed for env in made)


def test_a_pulse_that_raises_is_not_the_environments_fault() -> None:
    def gone() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        evaluate(ECHO, Says(), SPEC, 1, seed=1, pulse=gone)


def test_an_episode_without_end_is_cut_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluate_module, "LONGEST_EPISODE", 50)
    found = evaluate(EnvSpec(ECHO.id, {"endless": True}), Says(), SPEC, 2, seed=1)
    assert (found.episodes, found.cut, found.length_mean) == (2, 2, 50.0)


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_a_run_folder_is_enough_to_act_again(tmp_path: Path, env_id: str) -> None:
    env = EnvSpec(env_id)
    made = env.make()
    spec = PolicySpec(
        observation_leaves(made.observation_space), action_spec(made.action_space), net=(8, 8), normalize_observations=True
    )
    rng = np.random.default_rng(0)
    folder = RunFolder.create(resolve(env_id, run_dir=str(tmp_path)))
    parameters = rng.standard_normal(acting_size(spec), dtype=np.float32)
    folder.write_policy(spec, env, parameters, rng.random(buffer_size(spec), dtype=np.float32) + 0.5)
    policy, found_spec, found_env = load_policy(folder.path)
    assert (found_spec, found_env) == (spec, env)
    first = evaluate(found_env, policy, found_spec, 3, seed=1)
    assert first == evaluate(env, load_policy(folder.path)[0], spec, 3, seed=1)
    folder.write_policy(spec, env, -parameters, np.ones(buffer_size(spec), np.float32))
    assert first != evaluate(env, load_policy(folder.path)[0], spec, 3, seed=1)


def test_a_folder_without_a_policy_is_said(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such folder"):
        load_policy(tmp_path / "nowhere")
