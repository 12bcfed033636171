"""Copies that are stepped at once give what a loop gives, step for step; what they can't do is refused."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import gymnasium
import msgspec
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from hypothesis import given
from hypothesis import strategies as st

from millrace.extras.envs.envpool import envpool_spec
from millrace.extras.envs.envpool_copies import EnvpoolCopies
from millrace.extras.envs.vector_copies import VectorCopies
from millrace.extras.envs.vectorized import make_native
from millrace.learner.config.config import Config
from millrace.learner.config.layers import resolve
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import UsageError
from millrace.protocol.lane_past import LanePast
from millrace.protocol.messages import Permit
from millrace.protocol.specs import RunSpec
from millrace.workers.copies.env_copies import LoopedCopies, StepResult, copy_seed
from tests.support.envs.toy import Countdown
from tests.support.examples import examples
from tests.support.in_process.collectors import TOY, bits, collect, no_pulse, random_collector, run_of, trained
from tests.support.in_process.described import run_spec

Vector = Literal["native", "envpool"]
here = pytest.mark.skipif(find_spec("envpool") is None, reason="envpool is not here: pip install envpool")
POOL = pytest.param("envpool", marks=here)
BOTH = pytest.mark.parametrize("vector", ["native", POOL])


def at_once(run: RunSpec, vector: Vector) -> RunSpec:
    return msgspec.structs.replace(run, vector=vector)


def cartpoles(N: int, limit: int, vector: Vector = "envpool") -> EnvpoolCopies | VectorCopies:
    env = EnvSpec("CartPole-v1", {"max_episode_steps": limit})
    return EnvpoolCopies(envpool_spec(env), N) if vector == "envpool" else VectorCopies(make_native(env, N))


def observations(row: StepResult) -> Any:
    return np.asarray(row.leaves[0])


# ------------------------------------------------------------------------------------------------ the row format


@pytest.mark.parametrize(("vector", "rtol"), [("native", 1e-5), pytest.param("envpool", 1e-4, marks=here)])
def test_it_steps_as_the_loop_does_from_the_same_states(vector: Vector, rtol: float) -> None:
    """CartPole's dynamics, rewards and ends; the row in which a copy that ended only resets, whatever it was told to do."""
    N, env = 16, EnvSpec("CartPole-v1", {"max_episode_steps": 40})
    loop_envs = [env.make() for _ in range(N)]
    one, other = cartpoles(N, 40, vector), LoopedCopies([iter(loop_envs).__next__] * N, no_pulse)
    obs = np.asarray(one.reset([copy_seed(1, 0, 0, n) for n in range(N)], no_pulse)[0])
    other.reset(range(N), no_pulse)
    generator, began, ended = np.random.default_rng(2), np.ones(N, bool), {"terminated": 0, "truncated": 0}
    for _ in range(300):
        for n in np.flatnonzero(began):  # both begin where the copies that are stepped at once do
            loop_envs[n].unwrapped.state = obs[n].astype(float)  # type: ignore[attr-defined]
        balance = (obs[:, 2:] @ [1.0, 0.5] > 0).astype(int)
        actions = np.where(np.arange(N) < N // 2, balance, generator.integers(2, size=N))
        row, looped = one.step(actions, no_pulse), other.step(actions, no_pulse)
        obs = observations(row).copy()
        assert row.terminated.tolist() == looped.terminated
        assert row.truncated.tolist() == looped.truncated
        assert row.reward.tolist() == looped.reward
        began = row.reward == 0
        np.testing.assert_allclose(obs[~began], observations(looped)[~began], rtol=rtol, atol=rtol / 10)
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
@examples(25)
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


@BOTH
def test_time_limits_are_truncations_and_rows_are_those_of_the_loop(vector: Vector) -> None:
    run = run_of("CartPole-v1", T=20, N=3, kwargs={"max_episode_steps": 7})  # too few steps to fall
    collectors = [random_collector(each) for each in (run, at_once(run, vector))]
    for k in range(3):
        (loop,), (own,) = (collect(collector, run, k) for collector in collectors)
        for name in ("reward", "terminated", "truncated", "valid"):
            assert getattr(own, name).tolist() == getattr(loop, name).tolist(), (k, name)
        assert [(e.reward, e.length) for e in own.episodes] == [(e.reward, e.length) for e in loop.episodes]
        assert own.truncated.any()
        after = np.flatnonzero(~own.valid[:, 0])
        assert (np.abs(own.obs[0][after + 1]) <= 0.05).all()  # the next episode's first observation
        assert (np.abs(own.obs[0][after]).max((1, 2)) > 0.05).all()  # the last one's true last, to bootstrap from


@here
def test_the_time_limit_of_an_environment_that_only_the_clock_ends() -> None:
    run = run_of("Pendulum-v1", T=410, N=3)
    (loop,), (pool,) = (collect(random_collector(each), each) for each in (run, at_once(run, "envpool")))
    for name in ("terminated", "truncated", "valid"):
        assert getattr(pool, name).tolist() == getattr(loop, name).tolist(), name
    assert [episode.length for episode in pool.episodes] == [episode.length for episode in loop.episodes]
    assert pool.truncated.any()


# ------------------------------------------------------------------------------------------------ seeds, runs


@BOTH
def test_a_lane_gets_the_same_bits_alone_and_beside_others_and_others_by_its_seeds(vector: Vector) -> None:
    run = at_once(run_of("CartPole-v1", T=30, N=5, kwargs={"max_episode_steps": 12}), vector)
    together, apart = random_collector(run), random_collector(run)
    for k in range(3):
        found = {rollout.lane: bits(rollout) for rollout in collect(together, run, k, (2, 0, 1))}
        assert found[1] == bits(collect(apart, run, k, (1,))[0])
        assert found[1]["obs"] != found[2]["obs"]
    firsts = [
        *collect(random_collector(run), run, lanes=(0, 1)),
        *random_collector(run).collect([Permit(0, 1, 1, 0, 0, past=LanePast.unknown(1, 5))], 0, 1, no_pulse),
    ]
    assert len(np.unique(np.concatenate([rollout.obs[0][0] for rollout in firsts]), axis=0)) == 15


@BOTH
def test_a_run_is_the_same_whatever_the_number_of_workers(tmp_path: Path, vector: Vector) -> None:
    one, two = (trained(tmp_path, vector, workers) for workers in (1, 2))
    assert one == two


def test_the_loop_is_the_default() -> None:
    env = EnvSpec("CartPole-v1")
    assert run_spec(Config(env=env.id), env).vector == "loop"
    assert run_spec(Config(env=env.id, vector="native"), env).vector == "native"


# ------------------------------------------------------------------------------------------------ refusals


class Vectorized(VectorEnv[Any, Any, Any]):
    """A vectorized form of the countdown that cannot stand for it: it resets in another way, or has other spaces."""

    def __init__(self, num_envs: int, mode: str = "NextStep", signs: int = 1) -> None:
        self.metadata = {"autoreset_mode": AutoresetMode(mode)}
        self.num_envs = num_envs
        self.single_observation_space = spaces.Box(0, 1, (signs,), np.float32)
        self.single_action_space = spaces.Discrete(2)


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    registry = dict(gymnasium.registry)
    monkeypatch.setattr("gymnasium.envs.registration.registry", registry)
    del registry["Acrobot-v1"]
    gymnasium.register("Acrobot-v1", entry_point=lambda **_: Countdown())
    for name, kwargs in {"Same": {"mode": "SameStep"}, "Other": {"signs": 2}}.items():
        entry = {"entry_point": lambda **_: Countdown(), "vector_entry_point": Vectorized}
        gymnasium.register(f"test/{name}-v0", kwargs=kwargs, **entry)  # type: ignore[arg-type]


SUTTON = EnvSpec("CartPole-v1", {"sutton_barto_reward": True, "max_episode_steps": 3})


@pytest.mark.parametrize(
    ("vector", "env", "why"),
    [
        ("native", EnvSpec("Pendulum-v1"), "Pendulum-v1 has no vectorized form of its own .*; use --vector loop"),
        ("native", EnvSpec(f"{TOY}Countdown-v0"), "has no vectorized form of its own"),
        ("native", EnvSpec.of(Countdown), "vector native: expected an id that gymnasium registers, got a callable"),
        ("native", SUTTON, ""),
        ("native", EnvSpec("test/Same-v0"), "autoreset_mode.*: expected .*NEXT_STEP, got .*SAME_STEP"),
        (
            "native",
            EnvSpec("test/Other-v0"),
            r"vector native: its copies have other spaces than itself, Box.*\(2,\).*; use --vector loop",
        ),
        ("envpool", EnvSpec(f"{TOY}Countdown-v0"), "envpool has no environment of this name; use --vector loop"),
        ("envpool", EnvSpec("Acrobot-v1"), "envpool has no environment of this name"),  # it means somebody else's
        ("envpool", EnvSpec.of(Countdown), "vector envpool: expected an id that gymnasium registers, got a callable"),
        ("envpool", SUTTON, "cannot make it: .*'sutton_barto_reward'; use --vector loop"),
        ("envpool", EnvSpec("CartPole-v1", {"max_episode_steps": 3}), ""),
        ("envpool", EnvSpec("Pendulum-v1"), ""),
    ],
)
def test_what_cannot_be_stepped_at_once_is_refused_in_one_line(vector: Vector, env: EnvSpec, why: str) -> None:
    if vector == "envpool":
        pytest.importorskip("envpool")
    config = Config(env=env.id, vector=vector)
    if not why:
        found = run_spec(config, env)
        assert (found.vector, found.env.kwargs) == (vector, env.kwargs)
        return
    with pytest.raises(UsageError, match=why) as caught:
        run_spec(config, env)
    assert "\n" not in str(caught.value)


def test_where_envpool_is_not_installed_a_line_says_how_to(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "envpool", None)
    with pytest.raises(UsageError, match=r"vector envpool needs envpool .*; pip install envpool"):
        run_spec(Config(env="CartPole-v1", vector="envpool"), EnvSpec("CartPole-v1"))


def test_where_the_policy_acts_beside_the_learner_copies_are_stepped_one_by_one() -> None:
    for vector in ("native", "envpool"):
        with pytest.raises(UsageError, match=f"inference learner: vector: expected loop, got {vector}"):
            resolve("CartPole-v1", vector=vector, inference="learner")
