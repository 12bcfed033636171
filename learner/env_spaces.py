"""The spaces and the time limit of an environment. Imports no torch."""

from __future__ import annotations

from typing import NamedTuple

from protocol.env_spec import EnvSpec
from protocol.envs.spaces import action_spec, observation_leaves
from protocol.specs import ActionSpec, Leaf


class EnvSpaces(NamedTuple):
    """The spaces and the time limit of an environment."""

    observation: tuple[Leaf, ...]
    action: ActionSpec
    max_episode_steps: int | None
    """Time limit of an episode in env steps; None if there is none."""


def env_spaces(env: EnvSpec) -> EnvSpaces:
    """Make one env copy, read its spaces and close it. Raises `UsageError` if it cannot be made or is not supported."""
    copy = env.make()
    try:
        limit = copy.spec.max_episode_steps if copy.spec else None
        return EnvSpaces(observation_leaves(copy.observation_space), action_spec(copy.action_space), limit)
    finally:
        copy.close()
