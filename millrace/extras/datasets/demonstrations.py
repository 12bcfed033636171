"""Demonstrations as arrays: observations, actions, and discounted returns. Pure.

Rule: each observation is stored once, so images take no more memory than in the dataset.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from millrace.learner.algorithms.returns import EpisodeEnds, gae
from millrace.protocol.arrays import Array, Floats
from millrace.protocol.rollout import Batch


class Demonstrations(NamedTuple):
    """B steps of episodes, which have O observations in total."""

    leaves: tuple[Array, ...]
    """[O, *leaf] for each leaf of the observation"""
    at: npt.NDArray[np.int64]
    """[B] index of the step's observation in `leaves`"""
    last: npt.NDArray[np.int64]
    """[B] index of the last observation of the step's episode"""
    action: Array
    """[B, *action], as rollouts store it"""
    returns: Floats
    """[B] Σ γⁱ r over the rest of the episode"""
    discount: Floats
    """[B] weight of the last observation's value in the return: γᵏ, or 0 if the episode was terminated"""

    @classmethod
    def of(cls, batches: Iterable[Batch], scaled: Callable[[Floats], Floats], gamma: float) -> Demonstrations:
        """All steps of these episodes, each of which is a batch of one column.

        `scaled` scales rewards as the critic needs them. `gamma` is the discount γ.
        """
        leaves: list[list[Array]] = []
        rows: list[tuple[Array, ...]] = []
        start = 0
        for batch in batches:
            steps = np.arange(len(batch.action))
            nothing = np.zeros((len(batch.action) + 1, 1), np.float32)
            end = start + len(steps)
            returns = gae(scaled(batch.reward), nothing, EpisodeEnds.of(batch), gamma, 1.0)[:, 0]
            discount = (~batch.terminated[-1] * gamma ** (len(steps) - steps)).astype(np.float32)
            rows.append((start + steps, np.full(len(steps), end), batch.action[:, 0], returns, discount))
            leaves.append([leaf[:, 0] for leaf in batch.obs])
            start = end + 1
        columns: list[Array] = [np.concatenate(column) for column in zip(*rows, strict=True)]
        return cls(tuple(map(np.concatenate, zip(*leaves, strict=True))), *columns)

    def select(self, some: Array) -> Demonstrations:
        """The steps with these indices. They share the arrays of observations."""
        columns: list[Any] = [column[some] for column in self[1:]]
        return Demonstrations(self.leaves, *columns)

    def obs(self, at: npt.NDArray[np.int64]) -> list[Array]:
        """The observations at these indices, [B, *leaf] each; `at` is `self.at` or `self.last`."""
        return [leaf[at] for leaf in self.leaves]
