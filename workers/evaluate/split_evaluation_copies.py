"""The evaluation copies of a run with `--inference learner`: further lanes of the vector environment, of one copy each.

Rule: a lost copy costs the episodes that are being played: they are played again from their seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from protocol.arrays import Array
from workers.copies.env_loop import Pulse
from workers.copies.split_vector_env import SplitVectorEnv
from workers.evaluate.evaluation_copies import CopiesLost, CopyStep


class SplitEvaluationCopies:
    """The last copies of a vector environment."""

    def __init__(self, split: SplitVectorEnv, first_lane: int, count: int) -> None:
        """`first_lane` is the first of these lanes; the copies are the last `count`."""
        self.count = count
        self._split, self._first_lane = split, first_lane
        self._first_copy = split.env.num_envs - count
        self.observation_space = split.observation_space
        self.action_space = split.env.single_action_space

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> list[tuple[Any, ...]]:
        """Start episodes in the first copies, with a seed for each. Returns the arrays of each observation."""
        copies = slice(self._first_copy, self._first_copy + len(seeds))
        leaves = self._split.reset(copies, seeds, pulse)
        return [tuple(np.array(leaf[n]) for leaf in leaves) for n in range(len(seeds))]

    def step(self, actions: Array, copies: Sequence[int], pulse: Pulse) -> list[CopyStep]:
        """Step these copies at the same time, with actions [count, *action] of which only theirs are used."""
        lanes = [self._first_lane + n for n in copies]
        rows = slice(self._first_copy, self._first_copy + self.count)
        result = self._split.step_some(lanes, rows, actions, pulse)
        own = [self._first_copy + n for n in copies]
        if result.lost is not None and np.asarray(result.lost)[own].any():
            raise CopiesLost
        return [
            CopyStep(
                tuple(leaf[n] for leaf in result.leaves),
                result.reward[n],
                result.terminated[n],
                result.truncated[n],
                result.facts.get(n, ()),
            )
            for n in own
        ]

    def render(self, copy: int) -> Any:
        """Not supported: these copies were made without a render mode."""
        raise ValueError("render: copies of a vector environment cannot be filmed; use millrace evaluate --video")

    def close(self) -> None:
        """Do nothing: the copies belong to the vector environment."""
