"""The specification of a run for its workers: environment, policy, sizes and seed. Imports no torch."""

from __future__ import annotations

from learner.config.rollout_config import RolloutConfig
from protocol.env_spec import EnvSpec
from protocol.errors import UsageError
from protocol.policy.layout import acting_size
from protocol.specs import ExtraArray, PolicySpec, RunSpec
from protocol.wire.codec import check_can_be_sent
from protocol.wire.compression import why_no_zstd
from protocol.wire.socket_options import MAX_FRAME_BYTES


def rollout_spec(
    config: RolloutConfig,
    env: EnvSpec,
    policy: PolicySpec,
    rollout_steps: int,
    extras: tuple[ExtraArray, ...] = (),
    *,
    masked: bool = False,
) -> RunSpec:
    """The specification that `Welcome` carries. Raises `UsageError` if it cannot be sent, or settings and policy do not fit.

    `rollout_steps`: T, the env steps of a rollout. `extras`: further arrays of each, which the user's own policy returns.
    `masked`: whether workers read masks of the allowed actions.
    """
    if masked and config.chosen_vector() == "envpool":
        raise UsageError(
            "vector envpool: its environments report no action masks; use --vector loop, or --action-masks none"
        )
    if config.compress == "zstd" and (why := why_no_zstd()):
        raise UsageError(why)
    if config.images_dtype != "float32" and not policy.convolves:
        raise UsageError(
            f"images_dtype {config.images_dtype}: expected float32, for this policy has no convolutions of ours"
        )
    run = RunSpec(
        env=env,
        policy=policy,
        rollout_steps=rollout_steps,
        copies=config.envs // config.lanes,
        lanes=config.lanes,
        seed=config.seed,
        vector=config.chosen_vector(),
        compress=config.compress,
        images_dtype=config.images_dtype,
        masked=masked,
        extras=extras,
        facts=config.fact_names(),
        heartbeat_s=config.heartbeat_s,
    )
    _check_weights_can_be_sent(env.id, policy, config)
    check_can_be_sent(env.id, run)
    return run


def _check_weights_can_be_sent(env: str, policy: PolicySpec, config: RolloutConfig) -> None:
    """Also a space of few arrays may make a policy too large to allocate: a `Discrete` of 2**53 values."""
    size = acting_size(policy) * (4 if config.weights_dtype == "float32" else 2)
    if size > MAX_FRAME_BYTES:
        raise UsageError(
            f"environment {env}: expected a policy whose weights take at most {MAX_FRAME_BYTES:,} bytes, got {size:,}; wrap "
            "the environment so that its spaces are smaller, or choose a smaller net"
        )
