"""How many steps a rollout needs so that an update keeps its size, in env steps, with another number of env copies. Pure.

Rule: presets and defaults were chosen and measured with updates of one size. So with more env copies, rollouts are shorter,
but not so short that the algorithm learns worse from them (`AlgorithmConfig.least_rollout`).
"""

from __future__ import annotations


def rollout_with(envs: int, size: int, least: int) -> int:
    """The number of steps in a rollout, at least `least`, with which an update of `envs` env copies has `size` env steps."""
    return max(least, size // envs)
