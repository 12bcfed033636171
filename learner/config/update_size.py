"""How many steps a rollout needs so that an update keeps its size, in env steps, with another number of env copies. Pure.

Rule: with larger updates, an algorithm needs more env steps. So with more env copies, rollouts are shorter, but not so short
that the algorithm learns worse from them.
"""

from __future__ import annotations

from millrace.learner.config.hyperparameters import AlgorithmConfig, REINFORCEConfig

LEAST_ROLLOUT = 32  # steps of a rollout in PPO: in shorter ones, advantages depend more on the critic than on rewards


def least_rollout(algorithm: AlgorithmConfig) -> int:
    """The smallest number of steps in a rollout from which the algorithm learns as well as with its own number."""
    if isinstance(algorithm, REINFORCEConfig):  # a rollout must contain whole episodes
        return algorithm.rollout_steps
    if algorithm.replays:  # with a recurrent layer, a gradient step uses the sequences of whole rollouts
        return 1 if algorithm.core is None else algorithm.rollout_steps
    return min(LEAST_ROLLOUT, algorithm.rollout_steps)


def rollout_with(envs: int, size: int, least: int) -> int:
    """The number of steps in a rollout, at least `least`, with which an update of `envs` env copies has `size` env steps."""
    return max(least, size // envs)
