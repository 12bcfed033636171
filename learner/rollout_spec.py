"""Creates the run specification that `Welcome` sends to workers, for millrace's training and for your own loop.

It imports no torch.
"""

from __future__ import annotations

from msgspec.structs import asdict

from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.env_spaces import EnvSpaces
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.kinds_of_copies import has_masks
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.layout import acting_size
from millrace.protocol.specs import ExtraArray, PolicySpec, RunSpec, seat_returns
from millrace.protocol.wire.codec import check_can_be_sent
from millrace.protocol.wire.compression import has_zstd
from millrace.protocol.wire.message_sizes import MAX_FRAME_BYTES


def rollout_spec(
    config: RolloutConfig,
    env: EnvSpec,
    policy: PolicySpec,
    rollout_steps: int,
    extras: tuple[ExtraArray, ...] = (),
    *,
    spaces: EnvSpaces,
    teams: tuple[tuple[int, ...], ...] = (),
    scripted: tuple[str, ...] = (),
) -> RunSpec:
    """The specification that `Welcome` sends to workers.

    `rollout_steps` is T, the number of steps of a rollout. `extras` are additional arrays of a rollout, which the user's own
    policy returns. `spaces` are the environment's. `teams` and `scripted` are for a run with opponents. Raises `UsageError`
    if the specification cannot be sent, or if settings, environment and policy do not fit together.
    """
    masked, seats = spaces.masked, spaces.seats
    if masked and not has_masks(config.vector):
        raise UsageError(
            f"vector {config.vector}: its environments report no action masks; use --vector loop, or --action-masks none"
        )
    if seats and config.vector != "loop":
        raise UsageError(f"vector {config.vector}: {env.id} has several agents, whose copies are looped; use --vector loop")
    returns = dict(zip(seat_returns(seats), seats, strict=True))
    if taken := [name for name in config.info_keys if name in returns]:
        agent = returns[taken[0]]
        raise UsageError(f"info_keys: expected another name than {taken[0]}, which is the return of agent {agent}")
    run = RunSpec(
        env=env,
        policy=policy,
        rollout_steps=rollout_steps,
        copies=config.envs // config.lanes,
        lanes=config.lanes,
        seed=config.seed,
        vector=config.vector,
        zstd=any(leaf.is_image for leaf in policy.observation) and has_zstd(),
        images_dtype=config.acting_dtype if policy.convolves else "float32",
        masked=masked,
        extras=extras,
        info_keys=config.info_keys,
        seats=seats,
        takes_turns=spaces.takes_turns,
        teams=teams,
        scripted=scripted,
        restart_episodes=config.restart_episodes,
        **asdict(config.terms()),
    )
    _check_weights_can_be_sent(env.id, policy, config)
    check_can_be_sent(env.id, run)
    return run


def _check_weights_can_be_sent(env: str, policy: PolicySpec, config: RolloutConfig) -> None:
    """Raise `UsageError` if the policy's weights don't fit into a message.

    Even a space with few arrays, such as a `Discrete` with 2**53 values, may make the policy too large to allocate.
    """
    size = acting_size(policy) * (4 if config.acting_dtype == "float32" else 2)
    if size > MAX_FRAME_BYTES:
        raise UsageError(
            f"environment {env}: expected a policy whose weights take at most {MAX_FRAME_BYTES:,} bytes, got {size:,}; wrap "
            "the environment so that its spaces are smaller, or choose a smaller net"
        )
