"""An environment's own vectorized form: gymnasium's `vector_entry_point`.

Rule: its autoreset mode must be NEXT_STEP: it resets in the step after the end of an episode, as a loop over env copies
does. With another mode, last and first observations of episodes could not be distinguished.
"""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.vector import AutoresetMode, VectorEnv

from protocol.env_spec import EnvSpec
from protocol.envs.spaces import action_spec, observation_leaves
from protocol.errors import UsageError
from protocol.specs import ActionSpec, Leaf


def make_native(env: EnvSpec, copies: int) -> VectorEnv[Any, Any, Any]:
    """Make a vector environment of `copies` env copies with the environment's own code. Raises `UsageError`."""
    if env.factory is not None:
        raise UsageError(f"environment {env.id}: vector native: expected an id that gymnasium registers, got a callable")
    made = env.make_vectorized(copies)
    try:
        check_resets_next_step(made)
    except UsageError:
        made.close()
        raise
    return made


def check_resets_next_step(env: VectorEnv[Any, Any, Any]) -> None:
    """Raises `UsageError` unless the autoreset mode is NEXT_STEP."""
    mode = env.metadata.get("autoreset_mode")
    if mode not in {AutoresetMode.NEXT_STEP, AutoresetMode.NEXT_STEP.value}:
        raise UsageError(
            f"vector environment {env}: metadata['autoreset_mode']: expected {AutoresetMode.NEXT_STEP}, got {mode}; "
            "make it with autoreset_mode=AutoresetMode.NEXT_STEP"
        )


def check_native(env: EnvSpec, observation: tuple[Leaf, ...], action: ActionSpec) -> None:
    """Raises `UsageError` unless the vectorized form has these spaces."""
    made = make_native(env, 1)
    try:
        check_spaces(
            env, "its vectorized form", made.single_observation_space, made.single_action_space, observation, action
        )
    finally:
        made.close()


def check_spaces(
    env: EnvSpec,
    whose: str,
    observed: gymnasium.Space[Any],
    acted: gymnasium.Space[Any],
    observation: tuple[Leaf, ...],
    action: ActionSpec,
) -> None:
    """Raises `UsageError` unless the spaces of a vectorized form equal those of one env copy."""
    if (observation_leaves(observed), action_spec(acted)) != (observation, action):
        line = (
            f"environment {env.id}: {whose} has other spaces than itself, {observed} and {acted}; {vector_alternative(env)}"
        )
        raise UsageError(line)


def vector_alternative(env: EnvSpec) -> str:
    """Advice for an id whose vectorized form cannot be used, as text for an error message."""
    if env.id.startswith("ALE/"):
        return f"take millrace/Atari-v0 --env-kwargs game {env.id[4:].partition('-')[0]}, or use --vector loop"
    return "use --vector loop"
