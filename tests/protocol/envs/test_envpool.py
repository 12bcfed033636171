"""`--vector envpool`: what envpool steps keeps the row format, step for step as the loop, with exact flags; refusals."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from learner.config.config import Config
from learner.config.layers import resolve
from protocol.env_spec import EnvSpec
from protocol.envs.envpool import envpool_spec
from protocol.errors import UsageError
from protocol.specs import RunSpec
from tests.support.in_process.collectors import TOY, bits, collect, no_pulse, random_collector, run_of, trained
from tests.support.in_process.described import run_spec
from workers.copies.env_copies import LoopedCopies, StepResult, copy_seeds
from workers.copies.envpool_copies import EnvpoolCopies
from workers.envs.toy import Countdown

here = pytest.mark.skipif(find_spec("envpool") is None, reason="envpool is not here: pip install 'millrace-rl[envpool]'")


def pooled(run: RunSpec) -> RunSpec:
    return msgspec.structs.replace(run, vector="envpool")


def cartpoles(N: int, limit: int) -> EnvpoolCopies:
    return EnvpoolCopies(envpool_spec(EnvSpec("CartPole-v1", {"max_episode_steps": limit})), N)


def observations(row: StepResult) -> Any:
    return np.asarray(row.leaves[0])


# ------------------------------------------------------------------------------------------------ the row format


@here
def test_it_steps_as_the_loop_does_from_the_same_states() -> None:
    """CartPole's dynamics, rewards and ends; the row in which a copy that ended only resets, whatever it was told to do."""
    N, env = 16, EnvSpec("CartPole-v1", {"max_episode_steps": 40})
    loop_envs = [env.make() for _ in range(N)]
    one, other = cartpoles(N, 40), LoopedCopies([iter(loop_envs).__next__] * N, no_pulse)
    obs = np.asarray(one.reset(copy_seeds(1, 0, 0, N), no_pulse)[0])
    other.reset(range(N), no_pulse)
    generator, began, ended = np.random.default_rng(2), np.ones(N, bool), {"terminated": 0, "truncated": 0}
    for _ in range(300):
        for n in np.flatnonzero(began):  # both begin where envpool does
            loop_envs[n].unwrapped.state = obs[n].astype(float)  # type: ignore[attr-defined]
        balance = (obs[:, 2:] @ [1.0, 0.5] > 0).astype(int)
        actions = np.where(np.arange(N) < N // 2, balance, generator.integers(2, size=N))
        row, looped = one.step(actions, no_pulse), other.step(actions, no_pulse)
        obs = observations(row)
        assert row.terminated.tolist() == looped.terminated
        assert row.truncated.tolist() == looped.truncated
        assert row.reward.tolist() == looped.reward
        began = row.reward == 0
        np.testing.assert_allclose(obs[~began], observations(looped)[~began], rtol=1e-4, atol=1e-5)
        assert (np.abs(obs[began]) <= 0.05).all()  # a first observation
        for name in ended:
            ended[name] += int(np.count_nonzero(getattr(row, name)))
    assert min(ended.values()) > 10


FALLS = np.array([8, 10, 8, 10, 8, 10, 10, 8])  # steps of these copies when pushed to the left, and nothing else


@here
@pytest.mark.parametrize("limit", [7, 8, 9, 10, 11])
def test_an_episode_that_fails_in_the_step_of_its_time_limit_is_terminated_too(limit: int) -> None:
    copies = cartpoles(8, limit)
    copies.reset(range(8), no_pulse)
    flags = dict.fromkeys(range(8), (False, False))
    for t in range(1, 12):
        row = copies.step(np.zeros(8, int), no_pulse)
        for n in range(8):
            if flags[n] == (False, False) and t <= limit:
                flags[n] = bool(row.terminated[n]), bool(row.truncated[n])
                assert flags[n] == (t == FALLS[n], t == limit)


@here
@settings(max_examples=25, deadline=None)
@given(N=st.integers(1, 5), limit=st.integers(1, 12), seed=st.integers(0, 2**31 - 6), T=st.integers(1, 40))
def test_every_row_keeps_the_law_whatever_is_done(N: int, limit: int, seed: int, T: int) -> None:
    copies = cartpoles(N, limit)
    obs = np.asarray(copies.reset(range(seed, seed + N), no_pulse)[0])
    assert (np.abs(obs) <= 0.05).all()
    generator, ended, steps = np.random.default_rng(seed), np.zeros(N, bool), np.zeros(N, int)
    for _ in range(T):
        before = obs.copy()
        row = copies.step(generator.integers(2, size=N), no_pulse)
        obs = observations(row)
        steps = np.where(ended, 0, steps + 1)
        assert row.reward.tolist() == (~ended).tolist()  # the step after an episode's end only resets
        assert (np.abs(obs[ended]) <= 0.05).all()
        assert not (row.terminated | row.truncated)[ended].any()
        np.testing.assert_allclose(obs[~ended, 0], (before[:, 0] + 0.02 * before[:, 1])[~ended], atol=1e-6)  # a true step
        assert row.truncated.tolist() == (steps == limit).tolist()
        fallen = (np.abs(obs[:, 0]) > 2.4) | (np.abs(obs[:, 2]) > 0.20943951)
        assert row.terminated.tolist() == fallen.tolist()  # so the last observation is the episode's own
        ended = row.terminated | row.truncated
    copies.close()


@here
@pytest.mark.parametrize(("env", "kwargs"), [("CartPole-v1", {"max_episode_steps": 7}), ("Pendulum-v1", {})])
def test_time_limits_are_truncations_and_rows_are_those_of_the_loop(env: str, kwargs: dict[str, Any]) -> None:
    run = run_of(env, T=410 if env == "Pendulum-v1" else 20, N=3, kwargs=kwargs)
    (loop,), (pool,) = (collect(random_collector(each), each) for each in (run, pooled(run)))
    for name in ("terminated", "truncated", "valid"):
        assert getattr(pool, name).tolist() == getattr(loop, name).tolist(), name
    assert [episode.length for episode in pool.episodes] == [episode.length for episode in loop.episodes]
    assert pool.truncated.any()


# ------------------------------------------------------------------------------------------------ seeds, runs


@here
def test_a_lane_gets_the_same_bits_alone_and_beside_others_and_others_by_its_seeds() -> None:
    run = pooled(run_of("CartPole-v1", T=30, N=5, kwargs={"max_episode_steps": 12}))
    together, apart = random_collector(run), random_collector(run)
    for k in range(3):
        found = {rollout.lane: bits(rollout) for rollout in collect(together, run, k, (2, 0, 1))}
        assert found[1] == bits(collect(apart, run, k, (1,))[0])
        assert found[1]["obs"] != found[2]["obs"]
    firsts = [
        *collect(random_collector(run), run, lanes=(0, 1)),
        *collect(random_collector(run), run, lanes=(1,), incarnation=1),
    ]
    assert len(np.unique(np.concatenate([rollout.obs[0][0] for rollout in firsts]), axis=0)) == 15


@here
def test_a_run_is_the_same_whatever_the_number_of_workers(tmp_path: Path) -> None:
    one, two = (trained(tmp_path, "envpool", workers) for workers in (1, 2))
    assert one == two


# ------------------------------------------------------------------------------------------------ refusals


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    registry = dict(gymnasium.registry)
    monkeypatch.setattr("gymnasium.envs.registration.registry", registry)
    del registry["Acrobot-v1"]
    gymnasium.register("Acrobot-v1", entry_point=lambda **_: Countdown())


@here
@pytest.mark.parametrize(
    ("env", "why"),
    [
        (EnvSpec(f"{TOY}Countdown-v0"), "envpool has none of this name; use --vector loop"),
        (EnvSpec("Acrobot-v1"), "envpool has none of this name"),  # it means somebody else's
        (EnvSpec.of(Countdown), "vector envpool: expected an id that gymnasium registers, got a callable"),
        (
            EnvSpec("CartPole-v1", {"sutton_barto_reward": True}),
            "cannot make it: .*'sutton_barto_reward'; use --vector loop",
        ),
        (EnvSpec("CartPole-v1", {"max_episode_steps": 3}), ""),
        (EnvSpec("Pendulum-v1"), ""),
    ],
    ids=["none", "another of the name", "callable", "option", "fits", "continuous"],
)
def test_what_envpool_cannot_stand_for_is_refused_in_one_line(env: EnvSpec, why: str) -> None:
    config = Config(env=env.id, vector="envpool")
    if not why:
        assert run_spec(config, env).vector == "envpool"
        return
    with pytest.raises(UsageError, match=why) as caught:
        run_spec(config, env)
    assert "\n" not in str(caught.value)


def test_where_envpool_is_not_installed_a_line_says_how_to(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "envpool", None)
    with pytest.raises(UsageError, match=r"vector envpool needs envpool .*; pip install 'millrace-rl\[envpool\]'"):
        run_spec(Config(env="CartPole-v1", vector="envpool"), EnvSpec("CartPole-v1"))


def test_where_the_policy_acts_beside_the_learner_there_is_no_pool() -> None:
    with pytest.raises(UsageError, match="inference learner: vector: expected auto or loop, got envpool"):
        resolve("CartPole-v1", vector="envpool", inference="learner")
