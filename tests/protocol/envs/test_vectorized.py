"""`--vector native`: an environment's own vectorized form keeps the row format, step for step as the loop; refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv

from learner.config.config import Config
from learner.config.layers import resolve
from protocol.env_spec import EnvSpec
from protocol.envs.vectorized import make_native
from protocol.errors import UsageError
from protocol.specs import RunSpec
from tests.support.in_process.collectors import TOY, bits, collect, no_pulse, random_collector, run_of, trained
from tests.support.in_process.described import run_spec
from workers.copies.env_copies import LoopedCopies, VectorCopies, copy_seeds
from workers.envs.toy import Countdown

SHORT = {"max_episode_steps": 7}  # CartPole cannot fall so soon: every episode ends by the clock


def native(run: RunSpec) -> RunSpec:
    return msgspec.structs.replace(run, vector="native")


# ------------------------------------------------------------------------------------------------ the row format


def test_it_steps_as_the_loop_does_from_the_same_states() -> None:
    """CartPole's dynamics, rewards and ends; the row in which a copy that ended only resets, whatever it was told to do."""
    N, env = 16, EnvSpec("CartPole-v1", {"max_episode_steps": 40})
    seeds, generator = copy_seeds(1, 0, 0, N), np.random.default_rng(2)
    together = make_native(env, N)
    loop_envs = [env.make() for _ in range(N)]
    one, other = VectorCopies(together), LoopedCopies([iter(loop_envs).__next__] * N, no_pulse)
    one.reset(seeds, no_pulse)
    other.reset(seeds, no_pulse)
    began, ended = np.ones(N, bool), {"terminated": 0, "truncated": 0}
    for _ in range(300):
        for n in np.flatnonzero(began):  # both begin where the vectorized one does
            loop_envs[n].unwrapped.state = states_of(together)[n]  # type: ignore[attr-defined]
        balance = (states_of(together)[:, 2:] @ [1.0, 0.5] > 0).astype(int)
        actions = np.where(np.arange(N) < N // 2, balance, generator.integers(2, size=N))
        row, looped = one.step(actions, no_pulse), other.step(actions, no_pulse)
        assert row.terminated.tolist() == looped.terminated
        assert row.truncated.tolist() == looped.truncated
        assert row.reward.tolist() == looped.reward
        resets = row.reward == 0
        (obs,), (looped_obs,) = row.leaves, looped.leaves
        np.testing.assert_allclose(obs[~resets], np.array(looped_obs)[~resets], rtol=1e-5, atol=1e-6)
        assert (np.abs(obs[resets]) <= 0.05).all()  # a first observation
        began = resets
        for name in ended:
            ended[name] += int(np.count_nonzero(getattr(row, name)))
    assert min(ended.values()) > 10


def states_of(env: VectorEnv[Any, Any, Any]) -> Any:
    """[N, 4] float64."""
    return env.unwrapped.state.T.copy()  # type: ignore[attr-defined]


def test_time_limits_are_truncations_and_rows_are_those_of_the_loop() -> None:
    run = run_of("CartPole-v1", T=20, N=3, kwargs=SHORT)
    for k, loop, own in zip(range(3), rollouts(run), rollouts(native(run)), strict=True):
        for name in ("reward", "terminated", "truncated", "valid"):
            assert getattr(own, name).tolist() == getattr(loop, name).tolist(), (k, name)
        assert [(e.reward, e.length) for e in own.episodes] == [(e.reward, e.length) for e in loop.episodes]
        assert own.truncated.any()
        after = np.flatnonzero(~own.valid[:, 0])
        assert (np.abs(own.obs[0][after + 1]) <= 0.05).all()  # the next episode's first observation
        assert (np.abs(own.obs[0][after]).max((1, 2)) > 0.05).all()  # the last one's true last, to bootstrap from


def rollouts(run: RunSpec) -> list[Any]:
    collector = random_collector(run)
    return [collect(collector, run, k)[0] for k in range(3)]


def test_a_lane_gets_the_same_bits_alone_and_beside_others_and_others_by_its_seeds() -> None:
    run = native(run_of("CartPole-v1", T=30, N=5))
    together, apart = random_collector(run), random_collector(run)
    for k in range(3):
        found = {rollout.lane: bits(rollout) for rollout in collect(together, run, k, (2, 0, 1))}
        assert found[1] == bits(collect(apart, run, k, (1,))[0])
        assert found[1]["obs"] != found[2]["obs"]
    assert collect(together, run, lanes=(1,), incarnation=1)[0].obs[0][0].tolist() != found[1]["obs"]


# ------------------------------------------------------------------------------------------------ a run


def test_a_run_is_the_same_whatever_the_number_of_workers(tmp_path: Path) -> None:
    one, two = (trained(tmp_path, "native", workers) for workers in (1, 2))
    assert one == two


def test_auto_is_the_loop() -> None:
    env = EnvSpec("CartPole-v1")
    assert [run_spec(Config(env=env.id, vector=vector), env).vector for vector in ("auto", "loop", "native")] == [
        "loop",
        "loop",
        "native",
    ]


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
    for name, kwargs in {"Same": {"mode": "SameStep"}, "Other": {"signs": 2}}.items():
        entry = {"entry_point": lambda **_: Countdown(), "vector_entry_point": Vectorized}
        gymnasium.register(f"test/{name}-v0", kwargs=kwargs, **entry)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("env", "why"),
    [
        (EnvSpec("Pendulum-v1"), "Pendulum-v1 has no vectorized form of its own .*; use --vector loop"),
        (EnvSpec(f"{TOY}Countdown-v0"), "has no vectorized form of its own"),
        (EnvSpec.of(Countdown), "vector native: expected an id that gymnasium registers, got a callable"),
        (EnvSpec("CartPole-v1", {"sutton_barto_reward": True, "max_episode_steps": 3}), ""),
        (EnvSpec("test/Same-v0"), "autoreset_mode.*: expected .*NEXT_STEP, got .*SAME_STEP"),
        (EnvSpec("test/Other-v0"), r"its vectorized form has other spaces than itself, Box.*\(2,\).*; use --vector loop"),
    ],
    ids=["none", "none of ours", "callable", "fits", "same step", "other spaces"],
)
def test_what_cannot_be_stepped_at_once_is_refused_in_one_line(env: EnvSpec, why: str) -> None:
    config = Config(env=env.id, vector="native")
    if not why:
        assert run_spec(config, env).env.kwargs == env.kwargs
        return
    with pytest.raises(UsageError, match=why) as caught:
        run_spec(config, env)
    assert "\n" not in str(caught.value)


def test_where_the_policy_acts_beside_the_learner_copies_are_stepped_one_by_one() -> None:
    with pytest.raises(UsageError, match="inference learner: vector: expected auto or loop, got native"):
        resolve("CartPole-v1", vector="native", inference="learner")
    with pytest.raises(UsageError, match="vector: expected one of auto, loop, native, envpool, got 'sync'"):
        resolve("CartPole-v1", vector="sync")
