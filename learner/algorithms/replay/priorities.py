"""The priorities of the slots of a replay buffer (prioritized experience replay, Schaul et al. 2016).

Rule: a new slot gets the highest priority so far, until its own error is known. Slots are drawn in proportion to their
weights. The weight of a slot is its priority to the power of alpha; a slot of weight 0 is never drawn.
"""

from __future__ import annotations

import numpy as np

from millrace.learner.algorithms.replay.sum_tree import SumTree
from millrace.protocol.arrays import Doubles, Floats, Ints

OFFSET = 1e-6  # added to each error, so that every slot can be drawn again


class Priorities:
    """The priorities of `size` slots, whose weights are initially 0."""

    def __init__(self, size: int, alpha: float) -> None:
        self.tree = SumTree(size)  # the weights
        self.highest = 1.0  # the highest priority so far
        self._alpha = alpha

    def add(self, slots: Ints) -> None:
        """Give these new slots the highest priority so far."""
        self.tree.set(slots, self.highest**self._alpha)

    def update(self, slots: Ints, error: Doubles) -> None:
        """Set the priorities of these slots [B] from their absolute errors [B]."""
        priority = error + OFFSET
        self.highest = max(self.highest, float(priority.max()))
        self.tree.set(slots, priority**self._alpha)

    def draw(self, generator: np.random.Generator, count: int, entries: int, beta: float) -> tuple[Ints, Floats]:
        """Draw `count` slots in proportion to their weights. Returns them and their importance-sampling weights [count].

        `entries` is the number of slots that have a priority. P(i) = pᵢ^α / Σ p^α;  wᵢ = (entries · P(i))^−β, divided by the
        largest w in the sample (Schaul et al. 2016, section 3.4).
        """
        slots = self.tree.draw(generator, count)
        chance = self.tree.weights[slots] / self.tree.total
        weight = (entries * chance) ** -beta
        return slots, (weight / weight.max()).astype(np.float32)

    def load(self, weights: Doubles, highest: float) -> None:
        """Give the first slots these weights, and all other slots weight 0. `highest` is the highest priority so far."""
        self.tree.set(np.arange(len(self.tree.weights)), 0.0)
        self.tree.set(np.arange(len(weights)), weights)
        self.highest = highest
