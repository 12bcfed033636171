"""The arrays that hold the newest observations, rewards and episode ends of all env copies, or of their seats.

If there is shared memory, the arrays are in it, and local workers write the results of their steps there themselves. Results
that arrive as messages are written to the same arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from millrace.learner.vector_env.batch_layout import BatchLayout
from millrace.learner.vector_env.sent_lanes import Infos
from millrace.protocol.arrays import Array, Bools
from millrace.protocol.envs.spaces import make_unflatten
from millrace.protocol.messages import Stepped
from millrace.protocol.specs import SEAT_LEAVES, StepSpec
from millrace.protocol.wire.shared_memory import SharedMemory


class BatchArrays:
    """The newest results of all env copies, in N rows."""

    def __init__(
        self, spec: StepSpec, layout: BatchLayout, observation_space: gymnasium.Space[Any], memory: SharedMemory | None
    ) -> None:
        """`observation_space` is the space of a single row. `memory` is shared with local workers."""
        N = layout.rows[-1].stop
        self._layout = layout
        self._nest = make_unflatten(observation_space)
        self._leaves: tuple[Array, ...]  # [N, *leaf] each
        self.reward: Array  # [N] float64
        self.terminated: Array  # [N] bool
        self.truncated: Array  # [N] bool
        if memory is not None:
            self._leaves = memory.obs
            self.reward = memory.reward
            self.terminated = memory.terminated
            self.truncated = memory.truncated
        else:
            self._leaves = tuple(np.zeros((N, *leaf.shape), leaf.dtype) for leaf in spec.leaves)
            self.reward = np.zeros(N)
            self.terminated = np.zeros(N, bool)
            self.truncated = np.zeros(N, bool)
        count = len(spec.observation)
        self._observation = self._leaves[:count]
        self._seats = self._leaves[count:]

    def store(self, lane: int, answer: Stepped) -> None:
        """Write the results that a lane sent in a message."""
        rows = self._layout.rows[lane]
        for array, leaf in zip(self._leaves, answer.obs, strict=True):
            array[rows] = leaf
        self.reward[rows] = answer.reward
        self.terminated[rows] = answer.terminated
        self.truncated[rows] = answer.truncated

    def truncate(self, lane: int) -> None:
        """Truncate the episodes of a lane at their newest observations, with reward 0."""
        rows = self._layout.rows[lane]
        self.reward[rows] = 0.0
        self.terminated[rows] = False
        self.truncated[rows] = True
        for array in self._seats:
            array[rows] = 0

    @property
    def over(self) -> Bools:
        """[copies] True where the episode has ended. With seats, it has ended when no agent is left."""
        if not self._seats:
            return self.terminated | self.truncated
        return np.logical_not(self._seats[0].reshape(self._layout.count, -1).any(1))

    def of_seats(self, rows: slice | Sequence[int]) -> Infos:
        """Infos of these rows: which rows act next, which are complete, and the rewards that belong to no transition."""
        found = {leaf.path: array[rows].copy() for leaf, array in zip(SEAT_LEAVES, self._seats, strict=True)}
        return found | {f"_{name}": np.ones(len(array), bool) for name, array in found.items()}

    def observation(self, *, copy: bool) -> Any:
        """Observations of all rows, nested as in the space. Unless `copy`, the next step overwrites them."""
        return self._nest([array.copy() for array in self._observation] if copy else self._observation)

    def observation_of_some(self, rows: Sequence[int]) -> Any:
        """Copies of the newest observations of these rows, nested as in the space: [len(rows), *leaf] each."""
        return self._nest([array[list(rows)] for array in self._observation])

    def observation_of(self, row: int) -> Any:
        """A copy of the newest observation of this row, nested as in the space."""
        return self._nest([array[row].copy() for array in self._observation])
