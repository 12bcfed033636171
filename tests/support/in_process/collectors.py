"""Support for tests of collecting: runs of one environment, collectors with random weights, comparison bit by bit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
from gymnasium.vector import SyncVectorEnv

from millrace.extras.envs.vector_copies import VectorCopies
from millrace.launch.training import train
from millrace.learner.config.layers import resolve
from millrace.learner.rollouts.evaluation_dealer import episode_seeds
from millrace.protocol.arrays import Array
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.messages import Evaluate, Permit
from millrace.protocol.policy.layout import acting_size, buffer_size
from millrace.protocol.policy.policy import Policy, make_policy
from millrace.protocol.rollout import Episode, Rollout
from millrace.protocol.rows.rollout_checks import validate
from millrace.protocol.specs import PolicySpec, RunSpec
from millrace.workers.collect.collector import Collector, OpenEnvCopies, open_env_copies
from millrace.workers.copies.env_copies import LoopedCopies
from millrace.workers.evaluate.evaluator import Evaluator
from tests.support.conversation.example_messages import example

TOY = "tests.support.envs.toy:"
VERSION, SESSION = 7, 3


def no_pulse() -> None:
    """A pulse that does nothing."""


def run_of(env: str, T: int = 8, N: int = 2, kwargs: dict[str, Any] | None = None, **policy: Any) -> RunSpec:
    """A run of this environment, on up to 8 lanes."""
    spec = EnvSpec.of(env, kwargs)
    made = spec.make()
    described = PolicySpec(observation_leaves(made.observation_space), action_spec(made.action_space), **policy)
    made.close()
    return RunSpec(spec, described, rollout_steps=T, copies=N, lanes=8, seed=1)


def run_around(env: gymnasium.Env[Any, Any], T: int) -> RunSpec:
    """A run with the spaces of this environment, with one copy."""
    policy = PolicySpec(observation_leaves(env.observation_space), action_spec(env.action_space))
    return RunSpec(EnvSpec(type(env).__name__), policy, rollout_steps=T, copies=1, lanes=8, seed=1)


def with_env(run: RunSpec, env: str, **kwargs: Any) -> RunSpec:
    """The same run, on another environment."""
    return msgspec.structs.replace(run, env=EnvSpec.of(env, kwargs))


def random_weights(spec: PolicySpec) -> tuple[Array, Array]:
    """Random parameters needed to act, and buffers, which are the same each time."""
    generator = np.random.default_rng(5)
    parameters = generator.normal(0, 0.3, acting_size(spec)).astype(np.float32)
    return parameters, generator.uniform(0.5, 1.5, buffer_size(spec)).astype(np.float32)


def random_policy(spec: PolicySpec) -> Policy:
    """A policy with these weights."""
    policy = make_policy(spec)
    policy.load(*random_weights(spec))
    return policy


def random_collector(run: RunSpec, open_copies: OpenEnvCopies = open_env_copies) -> Collector:
    """A collector that acts with random weights."""
    return Collector(run, random_policy(run.policy), open_copies)


def loop_over(makes: Sequence[Callable[[], gymnasium.Env[Any, Any]]]) -> OpenEnvCopies:
    """A loop over these copies, one of each."""
    return lambda run, lane, pulse: LoopedCopies(makes, pulse)


def sync_vector_env_over(makes: Sequence[Callable[[], gymnasium.Env[Any, Any]]]) -> OpenEnvCopies:
    """A SyncVectorEnv over these copies, one of each."""
    return lambda run, lane, pulse: VectorCopies(SyncVectorEnv(makes))


def evaluated(run: RunSpec, policy: Policy, episodes: int, seed: int) -> list[Episode]:
    """Greedy episodes that an evaluator plays, 20 side by side."""
    evaluator, seeds = Evaluator(run, policy), episode_seeds(seed, episodes)
    orders = [
        example(Evaluate, session=1, ticket=1, seeds=seeds[i : i + 20], greedy=True, most_steps=10_000)
        for i in range(0, episodes, 20)
    ]
    played = [episode for order in orders for episode in evaluator.play(order, lambda rows: None, no_pulse).episodes]
    evaluator.close()
    return played


def collect(
    collector: Collector, run: RunSpec, sequence: int = 0, lanes: Iterable[int] = (0,), incarnation: int = 0
) -> list[Rollout]:
    """Rollout number `sequence` of each lane, after a check that it keeps the row format."""
    permits = [Permit(100 + lane, lane, incarnation, sequence, sequence) for lane in lanes]
    rollouts = collector.collect(permits, VERSION, SESSION, no_pulse)
    for permit, rollout in zip(permits, rollouts, strict=True):
        validate(rollout, run)
        assert (rollout.lane, rollout.ticket, rollout.sequence) == (permit.lane, permit.ticket, sequence)
        assert (rollout.version, rollout.session) == (VERSION, SESSION)
    return rollouts


def bits(rollout: Rollout) -> dict[str, object]:
    """As bytes, everything in a rollout that must not depend on which worker collects it."""
    fields = ("action", "log_prob", "reward", "terminated", "truncated", "valid", "state")
    found: dict[str, object] = {name: getattr(rollout, name).tobytes() for name in fields}
    found["obs"] = [leaf.tobytes() for leaf in rollout.obs]
    found["episodes"] = [(episode.reward, episode.length) for episode in rollout.episodes]
    return found


def trained(folder: Path, vector: str, workers: int) -> bytes:
    """The policy file of a short run on CartPole-v1 with this kind of env copies."""
    config = resolve(
        "CartPole-v1", vector=vector, steps=1_500, workers=workers, transport="inproc", eval_episodes=1,
        run_dir=str(folder / str(workers)),
    )  # fmt: skip
    return (train(config, None, lambda progress: None) / "policy.safetensors").read_bytes()
