"""An environment's own vectorized form: gymnasium's `vector_entry_point`.

Rule: its autoreset mode must be NEXT_STEP, which resets a copy in the step after the end of an episode, as a loop over env
copies does. In another mode, an episode's last observation couldn't be distinguished from the first one of the next episode.
"""

from __future__ import annotations

from typing import Any

from gymnasium.vector import AutoresetMode, VectorEnv

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import UsageError


def make_native(env: EnvSpec, copies: int) -> VectorEnv[Any, Any, Any]:
    """Make `copies` env copies with the environment's own vectorized code. Raises `UsageError` if it can't be used."""
    check_unwrapped_id(env, "native")
    made = env.make_vectorized(copies)
    try:
        check_resets_next_step(made)
    except UsageError:
        made.close()
        raise
    return made


def check_unwrapped_id(env: EnvSpec, vector: str) -> None:
    """Raise `UsageError` for a callable or an environment in wrappers, because these have no vectorized form."""
    if env.wrappers:
        raise UsageError(
            f"environment {env.id}: vector {vector}: wrappers are applied to single env copies; use --vector loop"
        )
    if env.factory is not None:
        raise UsageError(f"environment {env.id}: vector {vector}: expected an id that gymnasium registers, got a callable")


def check_resets_next_step(env: VectorEnv[Any, Any, Any]) -> None:
    """Raise `UsageError` unless the autoreset mode is NEXT_STEP."""
    mode = env.metadata.get("autoreset_mode")
    if mode not in {AutoresetMode.NEXT_STEP, AutoresetMode.NEXT_STEP.value}:
        raise UsageError(
            f"vector environment {env}: metadata['autoreset_mode']: expected {AutoresetMode.NEXT_STEP}, got {mode}; "
            "make it with autoreset_mode=AutoresetMode.NEXT_STEP"
        )
