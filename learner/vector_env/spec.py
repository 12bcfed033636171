"""A vector environment as data: its env copies and lanes follow from the settings, its spaces from a worker's description.

Rule: the observations of all copies have the same shapes and dtypes, because they share arrays; the same holds for actions.
Pure.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from gymnasium import Space
from gymnasium.spaces.utils import is_space_dtype_shape_equiv
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_differing_spaces, batch_space
from msgspec.structs import asdict

from millrace.learner.members.describe_coordinator import Unknown
from millrace.learner.vector_env.settings import ObservationMode, VectorEnvSettings
from millrace.protocol.env_spec import EnvSpec, PickledCallable
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.envs.spaces import leaves_with_own_dtype
from millrace.protocol.errors import EnvironmentFailed, UsageError, safe_repr
from millrace.protocol.specs import Leaf, SessionTerms, StepSpec, WaitSpec
from millrace.protocol.wire.codec import check_can_be_sent


@dataclass(frozen=True)
class VectorEnvDescription:
    """The description for workers, and the spaces and properties of a single env copy."""

    step: StepSpec
    observation_space: Space[Any]
    action_space: Space[Any]
    metadata: dict[str, Any]
    render_mode: str | None
    spec: Any
    """gymnasium's `EnvSpec` if all copies have the same registered id; otherwise None"""
    max_episode_steps: int | None = None
    """time limit of an episode of the first copy, in env steps; None if there is none"""


class RequestedCopies(SessionTerms, frozen=True, kw_only=True):
    """The env copies that the settings ask for, before their spaces are known: the part of a `StepSpec` without them."""

    envs: tuple[EnvSpec, ...]
    """the different environments, each listed once"""
    copies: tuple[int, ...]
    """for each copy, the index of its environment in `envs`"""
    lanes: tuple[int, ...]
    """the number of copies of each lane"""
    autoreset: Literal["NextStep", "SameStep", "Disabled"]
    render_mode: str | None
    learner_timeout_s: float
    evaluation_copies: int
    """the number of evaluation copies, which are the last ones"""

    @property
    def to_describe(self) -> Unknown:
        """The environment of the first copy, for a worker to describe. All copies must have the same spaces."""
        return Unknown(self.envs[0], render_mode=self.render_mode)

    @property
    def wait(self) -> WaitSpec:
        """The spec that is sent to workers that join before the spaces of the copies are known."""
        return WaitSpec(**{name: getattr(self, name) for name in WaitSpec.__struct_fields__})

    def description(self, env: DescribedEnv) -> VectorEnvDescription:
        """The vector environment of these copies. Raises `UsageError` for spaces that are not supported."""
        step = StepSpec(
            observation=leaves_with_own_dtype(env.observation_space),
            action=_action_leaves(env.action_space),
            seats=env.seats,
            **asdict(self),
        )
        check_can_be_sent(self.envs[0].id, step)
        metadata = {**env.metadata, "autoreset_mode": AutoresetMode(step.autoreset)}
        spec = env.spec if len(self.envs) == 1 and self.envs[0].factory is None else None
        return VectorEnvDescription(
            step, env.observation_space, env.action_space, metadata, env.render_mode, spec, env.max_episode_steps
        )


def _identity(spec: EnvSpec) -> tuple[str, PickledCallable | None, str]:
    """A key that is equal for specs that make the same environment. Leaves out wrappers, which all copies share."""
    return spec.id, spec.factory, repr(spec.kwargs)


def requested_copies(settings: VectorEnvSettings, learner_timeout_s: float = math.inf) -> RequestedCopies:
    """The env copies that the settings ask for.

    A worker that hears nothing from the learner for `learner_timeout_s` joins again. Raises `UsageError` for settings that
    don't fit together.
    """
    envs = settings.envs
    lanes = settings.lane_count
    N = len(envs)
    if not envs or (settings.num_envs is not None and settings.num_envs != N):
        raise UsageError(f"num_envs: expected at least 1 and, with a list, its length ({N}), got {settings.num_envs}")
    if not 1 <= lanes <= N:
        raise UsageError(f"lanes: expected 1 to num_envs ({N}), got {lanes}; each lane lives in one worker")
    keys = [env if isinstance(env, str) else id(env) for env in envs]  # gymnasium's specs cannot be hashed
    env_specs = {
        key: EnvSpec.of(env, settings.kwargs, settings.wrappers) for key, env in dict(zip(keys, envs, strict=True)).items()
    }
    specs = [env_specs[key] for key in keys]
    specs += [specs[0].for_evaluation()] * settings.single_lanes
    different = list({_identity(spec): spec for spec in specs}.values())
    index = {_identity(spec): n for n, spec in enumerate(different)}
    return RequestedCopies(
        envs=tuple(different),
        copies=tuple(index[_identity(spec)] for spec in specs),
        lanes=settings.lane_sizes,
        autoreset=_autoreset_mode(settings.autoreset_mode),
        render_mode=settings.render_mode,
        learner_timeout_s=learner_timeout_s,
        evaluation_copies=N if settings.evaluates else settings.single_lanes,
        **asdict(settings.terms),
    )


def observation_spaces(
    mode: ObservationMode, first: tuple[Space[Any], Space[Any]], copies: Sequence[DescribedEnv | None], seats: int = 1
) -> tuple[Space[Any], Space[Any]]:
    """The observation spaces of a single row and of the batch.

    `first` are the observation and the action space of copy 0. `copies` has None for a copy that its client did not
    describe. `seats` is the number of seats of each copy. Raises `EnvironmentFailed` for a copy that does not fit.
    """
    observation, action = first
    single = observation if isinstance(mode, str) else mode[1]
    fits = operator.eq if mode == "same" else is_space_dtype_shape_equiv
    for n, copy in enumerate(copies):
        if copy is not None and not (fits(copy.observation_space, single) and copy.action_space == action):
            raise EnvironmentFailed(
                f"copy {n}: its observations {copy.observation_space} and actions {copy.action_space} are not those of "
                f"copy 0, {single} and {action}; all copies must have the same, and each machine the same version of the "
                "environment; observation_mode='different' allows other bounds of observations"
            )
    match mode:
        case "same":
            return single, batch_space(single, len(copies) * seats)
        case "different":
            return single, batch_differing_spaces(
                [copy.observation_space if copy else single for copy in copies for _ in range(seats)]
            )
        case (batch, _):
            return single, batch


def _action_leaves(space: Space[Any]) -> tuple[Leaf, ...]:
    try:
        return leaves_with_own_dtype(space)
    except UsageError as error:
        raise UsageError(str(error).replace("observation space", "action space")) from error


def _autoreset_mode(mode: AutoresetMode | str) -> Literal["NextStep", "SameStep", "Disabled"]:
    try:
        return AutoresetMode(mode).value
    except ValueError as error:
        modes = ", ".join(known.value for known in AutoresetMode)
        raise UsageError(f"autoreset_mode: expected one of {modes}, got {safe_repr(mode)}") from error
