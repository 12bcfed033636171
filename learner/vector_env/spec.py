"""A vector environment described: which copies, in which lanes, in which spaces. Makes one env copy to learn the spaces."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium
from gymnasium.vector import AutoresetMode

from protocol.envs.spaces import exact_leaves
from protocol.errors import UsageError
from protocol.specs import EnvSpec, Scalar, StepSpec

Env = str | Callable[..., gymnasium.Env[Any, Any]]


@dataclass(frozen=True)
class Described:
    """What the workers are told, and what the vector environment shows of one copy."""

    step: StepSpec
    observation_space: gymnasium.Space[Any]
    action_space: gymnasium.Space[Any]
    metadata: dict[str, Any]
    render_mode: str | None
    spec: Any
    """gymnasium's, if all copies are of one id"""


def describe(
    env: Env | Sequence[Env],
    num_envs: int | None,
    lanes: int,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    render_mode: str | None = None,
    kwargs: dict[str, Scalar] | None = None,
    learner_timeout_s: float = math.inf,
) -> Described:
    """From one environment and how many copies, or a list with one for each copy. Raises `UsageError` in one line."""
    listed = [env] * (1 if num_envs is None else num_envs) if isinstance(env, str) or callable(env) else list(env)
    if not listed or (num_envs is not None and num_envs != len(listed)):
        raise UsageError(f"num_envs expected at least 1, and as many as the listed environments, got {num_envs}")
    if not 1 <= lanes <= len(listed):
        raise UsageError(f"lanes expected 1 to num_envs ({len(listed)}), got {lanes}; each lives with one worker")
    made = {one: EnvSpec.of(one, kwargs) for one in dict.fromkeys(listed)}
    different = list({(spec.id, spec.factory): spec for spec in made.values()}.values())
    places = {(spec.id, spec.factory): n for n, spec in enumerate(different)}
    copy = different[0].make(render_mode)
    try:
        N = len(listed)
        step = StepSpec(
            envs=tuple(different),
            copies=tuple(places[made[one].id, made[one].factory] for one in listed),
            lanes=tuple(N // lanes + (lane < N % lanes) for lane in range(lanes)),
            observation=exact_leaves(copy.observation_space),
            action=_actions(copy.action_space),
            autoreset=_mode(autoreset_mode),
            render_mode=render_mode,
            learner_timeout_s=learner_timeout_s,
        )
        metadata = {**copy.metadata, "autoreset_mode": AutoresetMode(step.autoreset)}
        spec = copy.spec if len(different) == 1 and different[0].factory is None else None
        return Described(step, copy.observation_space, copy.action_space, metadata, copy.render_mode, spec)
    finally:
        copy.close()


def _actions(space: gymnasium.Space[Any]) -> Any:
    try:
        return exact_leaves(space)
    except UsageError as error:
        raise UsageError(str(error).replace("observation space", "action space")) from error


def _mode(mode: AutoresetMode | str) -> Literal["NextStep", "SameStep", "Disabled"]:
    try:
        return AutoresetMode(mode).value
    except ValueError as error:
        modes = ", ".join(one.value for one in AutoresetMode)
        raise UsageError(f"autoreset_mode expected one of {modes}, got {mode!r}") from error
