"""The arrays that hold the newest observations, rewards and episode ends of all env copies.

They lie in shared memory if there is any: local workers write a step's results there themselves. Results that arrive as
messages are written to the same arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from learner.vector_env.batch_layout import BatchLayout
from protocol.arrays import Array
from protocol.envs.spaces import make_unflatten
from protocol.messages import Stepped
from protocol.specs import StepSpec
from protocol.wire.shared_memory import SharedMemory


class BatchArrays:
    """The newest results of all env copies."""

    def __init__(
        self, spec: StepSpec, layout: BatchLayout, observation_space: gymnasium.Space[Any], memory: SharedMemory | None
    ) -> None:
        """`observation_space`: of a single env copy. `memory`: shared with local workers."""
        N = layout.num_envs
        self._layout, self._nest = layout, make_unflatten(observation_space)
        self._observation: tuple[Array, ...]  # [num_envs, *leaf] each
        self.reward: Array  # [num_envs] float64
        self.terminated: Array  # [num_envs] bool
        self.truncated: Array  # [num_envs] bool
        if memory is not None:
            self._observation, self.reward = memory.obs, memory.reward
            self.terminated, self.truncated = memory.terminated, memory.truncated
        else:
            self._observation = tuple(np.zeros((N, *leaf.shape), leaf.dtype) for leaf in spec.observation)
            self.reward, self.terminated, self.truncated = np.zeros(N), np.zeros(N, bool), np.zeros(N, bool)

    def store(self, lane: int, answer: Stepped) -> None:
        """Write what a lane sent as a message."""
        rows = self._layout.rows[lane]
        for array, leaf in zip(self._observation, answer.obs, strict=True):
            array[rows] = leaf
        self.reward[rows], self.terminated[rows], self.truncated[rows] = answer.reward, answer.terminated, answer.truncated

    def truncate(self, lane: int) -> None:
        """Truncate the episodes of a lane: reward 0 at the newest observation."""
        rows = self._layout.rows[lane]
        self.reward[rows], self.terminated[rows], self.truncated[rows] = 0.0, False, True

    def observation(self, *, copy: bool) -> Any:
        """Observations of all env copies, nested as in the space. Without `copy` the next step overwrites them."""
        return self._nest([array.copy() for array in self._observation] if copy else self._observation)

    def observation_of_some(self, copies: Sequence[int]) -> Any:
        """Copies of the newest observations of these env copies, nested as in the space: [len(copies), *leaf] each."""
        return self._nest([array[list(copies)] for array in self._observation])

    def observation_of(self, n: int) -> Any:
        """A copy of the newest observation of env copy `n`."""
        return self._nest([array[n].copy() for array in self._observation])
