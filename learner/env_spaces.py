"""The spaces and the time limit of an environment, as a run needs them. Pure; imports no torch."""

from __future__ import annotations

from typing import NamedTuple

from protocol.envs.description import DescribedEnv
from protocol.envs.spaces import action_spec, observation_leaves
from protocol.specs import ActionSpec, Leaf, PolicySpec


class EnvSpaces(NamedTuple):
    """The spaces and the time limit of an environment."""

    observation: tuple[Leaf, ...]
    action: ActionSpec
    max_episode_steps: int | None
    """Time limit of an episode in env steps; None if there is none, or it is not known."""

    @staticmethod
    def of_description(env: DescribedEnv) -> EnvSpaces:
        """Those that a worker described. Raises `UsageError` if a policy cannot use them."""
        return EnvSpaces(observation_leaves(env.observation_space), action_spec(env.action_space), env.max_episode_steps)

    @staticmethod
    def of_policy(policy: PolicySpec) -> EnvSpaces:
        """Those that a policy was made for."""
        return EnvSpaces(policy.observation, policy.action, None)
