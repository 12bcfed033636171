"""The run's description for workers: the environment's spaces, the policy that fits them, sizes and seed."""

from __future__ import annotations

import msgspec

from learner.algorithms import algorithm_class
from learner.config.config import Config
from learner.env_spaces import EnvSpaces
from protocol.env_spec import EnvSpec
from protocol.errors import UsageError
from protocol.policy.encoder import describe_encoder
from protocol.policy.layout import acting_size
from protocol.specs import PolicySpec, RunSpec
from protocol.wire.codec import check_can_be_sent
from protocol.wire.compression import why_no_zstd
from protocol.wire.socket_options import MAX_FRAME_BYTES


def run_spec(config: Config, env: EnvSpec, spaces: EnvSpaces) -> RunSpec:
    """The specification that `Welcome` carries. Raises `UsageError` if algorithm, settings and spaces do not fit together.

    `spaces` are those of `env`.
    """
    if config.compress == "zstd" and (why := why_no_zstd()):
        raise UsageError(why)
    policy = _policy_spec(config, spaces)
    if algorithm_class(config.algo).whole_episodes:
        _check_room_for_whole_episodes(config, spaces.max_episode_steps)
    run = RunSpec(
        env=env,
        policy=policy,
        rollout_steps=config.algorithm.rollout_steps,
        copies=config.envs // config.lanes,
        lanes=config.lanes,
        seed=config.seed,
        vector=config.chosen_vector(),
        compress=config.compress,
        images_dtype=config.images_dtype,
        heartbeat_s=config.heartbeat_s,
    )
    _check_weights_can_be_sent(env.id, policy, config)
    check_can_be_sent(env.id, run)
    return run


def _check_weights_can_be_sent(env: str, policy: PolicySpec, config: Config) -> None:
    """Also a space of few arrays may make a policy too large to allocate: a `Discrete` of 2**53 values."""
    size = acting_size(policy) * (4 if config.weights_dtype == "float32" else 2)
    if size > MAX_FRAME_BYTES:
        raise UsageError(
            f"environment {env}: expected a policy whose weights take at most {MAX_FRAME_BYTES:,} bytes, got {size:,}; wrap "
            "the environment so that its spaces are smaller, or choose a smaller net"
        )


def _policy_spec(config: Config, spaces: EnvSpaces) -> PolicySpec:
    policy = algorithm_class(config.algo).policy_spec(config.algorithm, spaces.observation, spaces.action)
    if config.algorithm.encoder is not None:
        encoder = describe_encoder(config.algorithm.encoder, spaces.observation, spaces.action)
        policy = msgspec.structs.replace(policy, encoder=encoder)
    if config.images_dtype != "float32" and not policy.convolves:
        raise UsageError(
            f"images_dtype {config.images_dtype}: expected float32, for this policy has no convolutions of ours"
        )
    return policy


def _check_room_for_whole_episodes(config: Config, max_episode_steps: int | None) -> None:
    """A rollout must hold the longest episode and the row before it that resets the env copy."""
    steps = config.algorithm.rollout_steps
    if max_episode_steps is not None and steps <= max_episode_steps:
        raise UsageError(
            f"rollout_steps {steps}: {config.algo} learns from whole episodes, and those of {config.env} take up to "
            f"{max_episode_steps} steps; expected at least {max_episode_steps + 1}"
        )
