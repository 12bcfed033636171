"""An environment's description: a worker makes it from an env copy, and the learner, which has no copy, reads it.

Rule: a description is only data. Reading it makes spaces and records, imports nothing and runs no environment code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec as GymnasiumSpec

from millrace.protocol.arrays import Array
from millrace.protocol.bounds import LARGEST, MAX_NAME, MAX_TEXT, one_line
from millrace.protocol.envs.advice.space_advice import observation_advice
from millrace.protocol.envs.seats import SeatedEnv
from millrace.protocol.envs.space_generators import generator_states, restore_generators
from millrace.protocol.envs.space_records import describe_space, make_space
from millrace.protocol.errors import BadMessage, UsageError, first_line, joined
from millrace.protocol.space_spec import MAX_SEATS, MAX_WRAPPERS, EnvDescription, SpaceSpec, check_size
from millrace.protocol.wire import plain_values

MAX_METADATA_BYTES = 1 << 16


@dataclass(frozen=True)
class DescribedEnv:
    """The properties of an environment that the learner knows."""

    observation_space: gymnasium.Space[Any]
    action_space: gymnasium.Space[Any]
    metadata: dict[str, Any] = field(default_factory=dict)
    """the entries of `Env.metadata` that are plain data"""
    spec: GymnasiumSpec | None = None
    """gymnasium's own spec; None if there is none, or JSON cannot represent it"""
    max_episode_steps: int | None = None
    """time limit of an episode in env steps; None if there is none"""
    render_mode: str | None = None
    wrappers: frozenset[str] = frozenset()
    """the class names of the environment's wrappers (`class_name`)"""
    seats: tuple[str, ...] = ()
    """the names of the agents, if it is an environment with seats; the spaces above are then those of each seat"""
    takes_turns: bool = False
    """whether a seat may have to wait for others between two of its actions"""


def describe_env(env: gymnasium.Env[Any, Any]) -> EnvDescription:
    """The description of an env copy. Raises `UsageError` if its spaces are not supported or too large to send.

    Rule: `read_description` accepts everything that this returns.
    """
    try:
        observation = describe_space(env.observation_space, "observation space")
    except UsageError as error:
        raise UsageError(joined(str(error), observation_advice(env))) from error
    seats, takes_turns = agents_of(env)
    description = EnvDescription(
        observation=observation,
        action=describe_space(env.action_space, "action space"),
        metadata=_metadata(env.metadata),
        spec=_spec_as_text(env.spec),
        longest_episode=_longest_episode(env.spec),
        render_mode=one_line(env.render_mode or "", MAX_NAME),
        generators=generator_states(env.observation_space, env.action_space),
        wrappers=_wrappers(env)[:MAX_WRAPPERS],
        seats=seats,
        takes_turns=takes_turns,
    )
    try:
        check_size(description)
        read_description(description)  # what the learner would refuse is refused here, where the environment is known
    except BadMessage as error:
        raise UsageError(str(error)) from error
    return description


def read_description(description: EnvDescription) -> DescribedEnv:
    """The properties of the environment that a description describes.

    The description must have passed `millrace.protocol.space_spec.check_size`, which decoding calls. Raises `BadMessage`,
    and no other error, if it doesn't describe an environment.
    """
    if description.metadata.nbytes > MAX_METADATA_BYTES or description.metadata.dtype != np.uint8:
        raise BadMessage(f"metadata: expected at most {MAX_METADATA_BYTES} bytes, got {description.metadata.nbytes}")
    metadata = plain_values.unpack(description.metadata.tobytes())
    if type(metadata) is not dict or not all(type(name) is str for name in metadata):
        raise BadMessage(f"metadata: expected a dict with names as keys, got {type(metadata).__name__}")
    seats = description.seats
    takes_turns = description.takes_turns
    if len(set(seats)) < len(seats) or (takes_turns and not seats):
        raise BadMessage(f"seats: expected agents of different names, or none, got {agents_in_words(seats, takes_turns)}")
    observation_space = _made_space(description.observation, "observation space")
    action_space = _made_space(description.action, "action space")
    restore_generators(description.generators, observation_space, action_space)
    return DescribedEnv(
        observation_space=observation_space,
        action_space=action_space,
        metadata=metadata,
        spec=_spec_from_text(description.spec),
        max_episode_steps=description.longest_episode or None,
        render_mode=description.render_mode or None,
        wrappers=frozenset(description.wrappers),
        seats=seats,
        takes_turns=takes_turns,
    )


def _made_space(spec: SpaceSpec, name: str) -> gymnasium.Space[Any]:
    try:
        return make_space(spec)
    except BadMessage as error:
        raise BadMessage(f"{name}: {error}") from error


def agents_of(env: gymnasium.Env[Any, Any]) -> tuple[tuple[str, ...], bool]:
    """The names of the environment's agents (none for a gymnasium environment), and whether they take turns.

    Raises `UsageError` if there are too many agents.
    """
    if not isinstance(env, SeatedEnv):
        return (), False
    if len(env.seats) > MAX_SEATS:
        raise UsageError(f"environment: expected at most {MAX_SEATS} agents, got {len(env.seats)}")
    return env.seats, env.takes_turns


def agents_in_words(seats: Sequence[str], takes_turns: bool) -> str:
    """The agents of an environment, for errors."""
    return one_line(f"{'agents that take turns' if takes_turns else 'agents'}: {', '.join(seats) or 'none'}", MAX_NAME)


def class_name(kind: type) -> str:
    """The name that a wrapper's class has in a description."""
    return one_line(f"{kind.__module__}:{kind.__qualname__}")


def _wrappers(env: gymnasium.Env[Any, Any]) -> tuple[str, ...]:
    kinds: dict[type, None] = {}
    while isinstance(env, gymnasium.Wrapper):
        kinds |= dict.fromkeys(kind for kind in type(env).__mro__ if issubclass(kind, gymnasium.Wrapper))
        env = env.env
    return tuple(map(class_name, kinds))


def _metadata(metadata: object) -> Array:
    """The entries that are plain data, packed, [bytes] uint8. Entries that would make the result too long are left out."""
    kept: dict[str, Any] = {}
    packed = plain_values.pack(kept)
    for name, value in metadata.items() if isinstance(metadata, dict) else ():
        try:
            longer = plain_values.pack({**kept, name: value})
        except TypeError:
            continue
        if type(name) is str and len(longer) <= MAX_METADATA_BYTES:
            kept[name] = value
            packed = longer
    return np.frombuffer(packed, np.uint8)


def _spec_as_text(spec: GymnasiumSpec | None) -> str:
    try:
        text = "" if spec is None else spec.to_json()
        if text:
            GymnasiumSpec.from_json(text)
    except Exception:  # an entry point or argument that JSON cannot represent, or a user-defined spec
        return ""
    return text if len(text) <= MAX_TEXT else ""


def _spec_from_text(text: str) -> GymnasiumSpec | None:
    if not text:
        return None
    try:
        return GymnasiumSpec.from_json(text)
    except Exception as error:  # any type of error, because the text may be anything
        raise BadMessage(f"spec: expected gymnasium's as JSON: {one_line(first_line(error), 200)}") from error


def _longest_episode(spec: GymnasiumSpec | None) -> int:
    limit = None if spec is None else spec.max_episode_steps
    return limit if isinstance(limit, int) and 0 < limit <= LARGEST else 0
