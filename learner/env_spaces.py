"""An environment's spaces and time limit, in the form that a run needs. Pure; imports no torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

from gymnasium import spaces

from millrace.protocol.envs.action_masks import has_mask, without_mask, wrong_mask
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.envs.spaces import action_spec, observation_leaves, with_last
from millrace.protocol.errors import UsageError, did_you_mean
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec


class EnvSpaces(NamedTuple):
    """An environment's spaces and time limit."""

    observation: tuple[Leaf, ...]
    action: ActionSpec
    max_episode_steps: int | None
    """The time limit of an episode, in env steps; None if there is none, or if it is not known."""
    masked: bool = False
    """Whether the run uses action masks. A mask in an observation isn't part of `observation`."""
    seats: tuple[str, ...] = ()
    """The names of the agents, each of which has these spaces; empty for a gymnasium environment."""
    takes_turns: bool = False
    """Whether a seat may have to wait for other seats between two of its actions."""
    critic: tuple[Leaf, ...] = ()
    """Additional observation arrays that only the critic sees."""

    @staticmethod
    def of_description(
        env: DescribedEnv, action_masks: Literal["auto", "info", "none"] = "auto", critic_keys: Sequence[str] = ()
    ) -> EnvSpaces:
        """The spaces that a worker described.

        `critic_keys` are keys of a Dict observation that only the critic sees. Raises `UsageError` if a policy can't use
        these spaces.
        """
        observation = env.observation_space
        action = action_spec(env.action_space)
        if action_masks == "info" and not action.choices:
            raise UsageError(
                f"action_masks info: expected an action space Discrete or MultiDiscrete, got {env.action_space}"
            )
        if action_masks == "auto" and (wrong := wrong_mask(observation, env.action_space)):
            raise UsageError(wrong)
        masked = action_masks == "info" or (action_masks == "auto" and has_mask(observation, env.action_space))
        if masked:
            observation = without_mask(observation, env.action_space)
        keys = observation.spaces.keys() if isinstance(observation, spaces.Dict) else ()
        given = f"critic_keys {' '.join(critic_keys)}"
        if unknown := [key for key in critic_keys if key not in keys]:
            there = f"its keys are {', '.join(keys)}" if keys else f"the observation is not a Dict, but {observation}"
            raise UsageError(f"{given}: no key {unknown[0]}; {there}{did_you_mean(unknown[0], keys)}")
        if critic_keys and len(keys) == len(critic_keys):
            raise UsageError(f"{given}: expected one more key of the observation for the actor, got {', '.join(keys)}")
        everything = observation_leaves(with_last(observation, critic_keys))
        critic = tuple(leaf for leaf in everything if leaf.path.partition("/")[0] in critic_keys)
        if any(leaf.is_image for leaf in critic):
            raise UsageError(f"{given}: expected arrays that aren't images, got {observation}")
        leaves = everything[: len(everything) - len(critic)]
        paths = [leaf.path for leaf in leaves]
        if not leaves:
            raise UsageError(
                f"observation space {env.observation_space}: expected at least one array for the policy, got none"
            )
        if twice := sorted({path for path in paths if paths.count(path) > 1}):
            raise UsageError(f"observation space: expected a name for each array, got two that are called {twice[0]}")
        return EnvSpaces(leaves, action, env.max_episode_steps, masked, env.seats, env.takes_turns, critic)

    @staticmethod
    def of_policy(policy: PolicySpec, seats: tuple[str, ...] = ()) -> EnvSpaces:
        """The spaces that a policy was created for."""
        return EnvSpaces(policy.observation, policy.action, None, seats=seats, critic=policy.critic)
