"""The vectorised form that an environment brings along, gymnasium's `vector_entry_point`; or in one line why it cannot.

The law: it resets in the step after an episode's end (NEXT_STEP), as a loop over copies does. Of another way of resetting
the last observations could not be told from first ones.
"""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.vector import AutoresetMode, VectorEnv

from protocol.errors import UsageError
from protocol.spaces import action_spec, observation_leaves
from protocol.specs import ActionSpec, EnvSpec, Leaf


def make_native(env: EnvSpec, copies: int) -> VectorEnv[Any, Any, Any]:
    """So many copies, stepped at once by the environment's own code. Raises `UsageError`."""
    if env.factory is not None:
        raise UsageError(f"environment {env.id}: vector native expected an id that gymnasium registers, got a callable")
    made = env.make_vectorised(copies)
    try:
        check_resets_next_step(made)
    except UsageError:
        made.close()
        raise
    return made


def check_resets_next_step(env: VectorEnv[Any, Any, Any]) -> None:
    """Raises `UsageError` for another way of resetting."""
    mode = env.metadata.get("autoreset_mode")
    if mode not in {AutoresetMode.NEXT_STEP, AutoresetMode.NEXT_STEP.value}:
        raise UsageError(
            f"vector environment {env}: metadata['autoreset_mode'] expected {AutoresetMode.NEXT_STEP}, got {mode}; "
            "make it with autoreset_mode=AutoresetMode.NEXT_STEP"
        )


def check_native(env: EnvSpec, observation: tuple[Leaf, ...], action: ActionSpec) -> None:
    """Raises `UsageError` unless its vectorised form can stand for copies with these spaces."""
    made = make_native(env, 1)
    try:
        spaces: tuple[gymnasium.Space[Any], gymnasium.Space[Any]] = made.single_observation_space, made.single_action_space
        if (observation_leaves(spaces[0]), action_spec(spaces[1])) != (observation, action):
            raise UsageError(
                f"environment {env.id}: its vectorised form has other spaces than itself, {spaces[0]} and {spaces[1]}; "
                "use --vector loop"
            )
    finally:
        made.close()
