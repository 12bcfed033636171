"""A sum tree: draws indices in proportion to their weights, and changes weights, in logarithmic time. Vectorized in numpy.

Rule: every inner node is the sum of its two children and is recomputed when one of them changes. The tree is therefore a
function of its leaves, bit for bit, and rounding errors do not accumulate.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from millrace.protocol.arrays import Doubles, Ints


class SumTree:
    """`size` weights, initially 0. Node i has the children 2i and 2i + 1; the leaves are the nodes from `size` on.

    `size` need not be a power of two. If it isn't, leaves are at two depths, but every node except the root still has one
    parent.
    """

    def __init__(self, size: int) -> None:
        self._size = max(size, 2)
        self._nodes: Doubles = np.zeros(2 * self._size)
        self._depth = (2 * self._size - 1).bit_length() - 1  # depth of the deepest leaf; the root has depth 0

    @staticmethod
    def memory_bytes(size: int) -> int:
        """Memory of a tree of `size` weights, in bytes."""
        return 2 * max(size, 2) * np.dtype(np.float64).itemsize

    @property
    def total(self) -> float:
        """The sum of all weights."""
        return float(self._nodes[1])

    @property
    def weights(self) -> Doubles:
        """A view of the weights [size]. Don't write to it."""
        return self._nodes[self._size :]

    def set(self, index: Ints, weight: npt.NDArray[Any] | float) -> None:
        """Set the weights at these indices. They must not be negative. If an index occurs twice, its last weight counts."""
        nodes = self._nodes
        i = index + self._size
        nodes[i] = weight
        for _ in range(self._depth):
            i = np.maximum(i >> 1, 1)
            nodes[i] = nodes[2 * i] + nodes[2 * i + 1]

    def find(self, mass: Doubles) -> Ints:
        """The first indices at which the cumulative sum of the weights exceeds `mass` [B], which must be in [0, total).

        An index of weight 0 is never returned.
        """
        nodes = self._nodes
        i = np.ones(len(mass), np.int64)
        mass = mass.copy()
        for _ in range(self._depth):
            inner = i < self._size
            child = np.where(inner, 2 * i, i)
            left = nodes[child]
            right = nodes[np.where(inner, child + 1, child)]
            to_right = inner & (mass >= left) & (right > 0)
            mass -= np.where(to_right, left, 0)
            i = child + to_right
        return i - self._size

    def draw(self, generator: np.random.Generator, count: int) -> Ints:
        """Draw `count` indices in proportion to their weights, one from each of `count` equal segments of the sum."""
        return self.find((np.arange(count) + generator.random(count)) * (self.total / count))
