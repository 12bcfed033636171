"""The row format holds for every kind of env copies: a loop, SyncVectorEnv, gymnasium's vectorized CartPole."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from hypothesis import given
from hypothesis import strategies as st

from millrace.extras.envs.vector_copies import VectorCopies
from millrace.protocol.errors import UsageError
from millrace.protocol.rollout import Rollout
from millrace.protocol.specs import RunSpec
from millrace.workers.collect.collector import OpenEnvCopies
from tests.support.envs.toy import Scripted
from tests.support.examples import examples
from tests.support.in_process.collectors import TOY, bits, collect, loop_over, random_collector, run_of, sync_vector_env_over

SCRIPTED = run_of(f"{TOY}Scripted-v0")


def scripted(T: int, N: int) -> RunSpec:
    return RunSpec(SCRIPTED.env, SCRIPTED.policy, rollout_steps=T, copies=N, lanes=8, seed=1)


def collect_script(script: str, T: int, rollouts: int = 1) -> list[Rollout]:
    """Rollouts of one copy that plays a script."""
    run = scripted(T, 1)
    collector = random_collector(run, loop_over([partial(Scripted, script)]))
    return [collect(collector, run, k)[0] for k in range(rollouts)]


class ExpectedRows:
    """The rows that a script must give, computed step by step."""

    def __init__(self, script: str, rows: int) -> None:
        self.obs: list[list[int]] = [[0, 0]]
        self.reward: list[float] = []
        self.flags: list[tuple[bool, bool, bool]] = []  # terminated, truncated, valid
        self.ended: list[tuple[int, float, int]] = []  # row, return, length
        episode, steps, played, over = 0, 0, 0, False
        for t in range(rows):
            if over:
                episode, steps, over = episode + 1, 0, False
                self.reward.append(0.0)
                self.flags.append((False, False, False))
            else:
                letter = script[played % len(script)]
                played, steps, over = played + 1, steps + 1, letter in "tub"
                self.reward.append(steps)
                self.flags.append((letter in "tb", letter in "ub", True))
                if over:
                    self.ended.append((t, steps * (steps + 1) / 2, steps))
            self.obs.append([episode, steps])


@pytest.mark.parametrize("over", [loop_over, sync_vector_env_over])
@examples(60)
@given(scripts=st.lists(st.text(".tub", min_size=1, max_size=6), min_size=1, max_size=4), T=st.integers(1, 7))
def test_rows_and_episodes_are_those_of_the_script(over: Any, scripts: list[str], T: int) -> None:
    K, N = 3, len(scripts)
    run = scripted(T, N)
    collector = random_collector(run, over([partial(Scripted, script) for script in scripts]))
    rollouts = [collect(collector, run, k)[0] for k in range(K)]
    played = [ExpectedRows(script, K * T) for script in scripts]
    for k, rollout in enumerate(rollouts):
        rows = slice(k * T, (k + 1) * T)
        for n, expected in enumerate(played):
            assert rollout.obs[0][:, n].tolist() == expected.obs[k * T : (k + 1) * T + 1]
            assert rollout.reward[:, n].tolist() == expected.reward[rows]
            flags = zip(rollout.terminated[:, n], rollout.truncated[:, n], rollout.valid[:, n], strict=True)
            assert list(flags) == expected.flags[rows]
        ended = [(t, n, total, length) for n, copy in enumerate(played) for t, total, length in copy.ended]
        here = sorted(end for end in ended if k * T <= end[0] < (k + 1) * T)
        assert [(episode.reward, episode.length) for episode in rollout.episodes] == [end[2:] for end in here]
    assert collector.steps == sum(rollout.env_steps for rollout in rollouts)


def test_the_reset_row_is_masked_and_not_an_env_step() -> None:
    run = run_of(f"{TOY}OneStep-v0", T=6, N=1)
    collector = random_collector(run)
    (rollout,) = collect(collector, run)
    assert rollout.valid[:, 0].tolist() == [True, False] * 3
    assert rollout.truncated[:, 0].tolist() == [True, False] * 3
    assert rollout.reward[:, 0].tolist() == [1.0, 0.0] * 3
    assert [episode.length for episode in rollout.episodes] == [1, 1, 1]
    assert rollout.env_steps == collector.steps == 3


def test_terminated_and_truncated_at_once_end_one_episode() -> None:
    run = run_of(f"{TOY}Both-v0", T=4, N=1)
    (rollout,) = collect(random_collector(run), run)
    assert rollout.terminated[:, 0].tolist() == rollout.truncated[:, 0].tolist() == [False, False, True, False]
    assert [(episode.reward, episode.length) for episode in rollout.episodes] == [(6.0, 3)]


def test_obs_after_a_truncation_is_the_last_of_the_episode() -> None:
    (rollout,) = collect_script("..u", T=4)
    assert rollout.obs[0][3, 0].tolist() == [0, 3]  # bootstrap from this,
    assert rollout.obs[0][4, 0].tolist() == [1, 0]  # not from the next episode's first


def test_a_rollout_starts_where_the_last_one_ended() -> None:
    first, second, _ = collect_script("...t", T=4, rollouts=3)
    assert first.terminated[-1, 0]
    assert not second.valid[0, 0]  # the reset falls into the next rollout
    assert first.obs[0][-1].tobytes() == second.obs[0][0].tobytes()


def test_returns_continue_across_rollouts() -> None:
    rollouts = collect_script("......t", T=3, rollouts=3)
    assert [[(episode.reward, episode.length) for episode in r.episodes] for r in rollouts] == [[], [], [(28.0, 7)]]
    assert all(episode.seconds > 0 for episode in rollouts[2].episodes)


def test_returns_are_summed_before_rewards_are_rounded() -> None:
    run = run_of(f"{TOY}Countdown-v0", T=10, N=1, kwargs={"k": 10, "reward": 0.1})
    (rollout,) = collect(random_collector(run), run)
    assert rollout.reward.dtype == np.float32
    assert rollout.episodes[0].reward == sum([0.1] * 10)


class EndsInResetSteps(VectorEnv[Any, Any, Any]):
    """Copy n ends at every step n, 2n, …, even at a step that only resets it. Every reward is 5."""

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.single_observation_space = gymnasium.spaces.Box(0, np.inf, (1,), np.float32)
        self.single_action_space = gymnasium.spaces.Discrete(2)
        self._steps = 0

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        return np.zeros((self.num_envs, 1), np.float32), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self._steps += 1
        ended = self._steps % np.arange(1, self.num_envs + 1) == 0
        five = np.full(self.num_envs, 5.0)
        return np.full((self.num_envs, 1), self._steps, np.float32), five, ended, np.zeros(self.num_envs, bool), {}


def test_a_vector_environment_that_ends_on_the_reset_step() -> None:
    run = run_of(f"{TOY}Countdown-v0", T=5, N=2)  # it has the same spaces
    collector = random_collector(run, lambda run, lane, pulse: VectorCopies(EndsInResetSteps(2)))
    rollout, following = (collect(collector, run, k)[0] for k in range(2))
    assert rollout.terminated.T.tolist() == [[True] * 5, [False, True, False, True, False]]
    assert rollout.valid.T.tolist() == [[True, False, False, False, False], [True, True, False, True, False]]
    assert rollout.reward.T.tolist() == [[5, 0, 0, 0, 0], [5, 5, 0, 5, 0]]
    assert rollout.steps_that_reset.T.tolist() == [[False] + [True] * 5, [False, False, True, False, True, False]]
    assert following.steps_that_reset[0].tolist() == rollout.steps_that_reset[-1].tolist()
    assert [(episode.reward, episode.length) for episode in rollout.episodes] == [(5, 1), (10, 2), (5, 1)]
    assert rollout.env_steps == 4
    assert collector.steps == 4 + following.env_steps


def test_a_loop_and_sync_vector_env_collect_the_same_bits() -> None:
    run = run_of("CartPole-v1", T=60, N=3)
    loop, sync = random_collector(run), random_collector(run, sync_vector_env_over([run.env.make] * 3))
    for k in range(3):
        pairs = zip(collect(loop, run, k, lanes=(0, 1)), collect(sync, run, k, lanes=(0, 1)), strict=True)
        assert all(bits(one) == bits(other) for one, other in pairs)


def test_gymnasiums_vectorized_cartpole_keeps_the_law() -> None:
    run = run_of("CartPole-v1", T=100, N=4)
    collector = random_collector(run, native_cartpole)
    lengths = 0
    for k in range(3):
        for rollout in collect(collector, run, k, lanes=(0, 1)):
            assert (rollout.reward == rollout.valid).all()  # CartPole pays 1 a step
            assert all(episode.reward == episode.length > 5 for episode in rollout.episodes)
            lengths += sum(episode.length for episode in rollout.episodes)
    assert 0 < lengths <= collector.steps < 2 * 3 * 100 * 4


def native_cartpole(run: RunSpec, lane: int, pulse: object) -> VectorCopies:
    return VectorCopies(gymnasium.make_vec("CartPole-v1", run.copies))


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
def test_other_autoreset_modes_are_refused(mode: AutoresetMode) -> None:
    env = SyncVectorEnv([Scripted] * 2, autoreset_mode=mode)
    with pytest.raises(UsageError, match=r"autoreset_mode.*: expected .*NEXT_STEP, got .*; make it with"):
        VectorCopies(env)


def test_a_vector_environment_of_another_size_is_refused() -> None:
    run = scripted(4, 3)
    open_two: OpenEnvCopies = sync_vector_env_over([Scripted] * 2)
    with pytest.raises(UsageError, match="expected 3 copies, got 2"):
        collect(random_collector(run, open_two), run)
