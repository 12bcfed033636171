"""The last 100 training episodes and their means. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from protocol.rollout import Episode

WINDOW_EPISODES = 100


class EpisodeWindow:
    """The last 100 episodes."""

    def __init__(self, episodes: Sequence[Episode] = ()) -> None:
        self.return_mean: float | None = None
        """Mean return, or None before the first episode has ended."""
        self.length_mean: float | None = None
        """Mean length in env steps, or None before the first episode has ended."""
        self._episodes: deque[Episode] = deque(maxlen=WINDOW_EPISODES)
        self.extend(episodes)

    @staticmethod
    def from_state(state: list[Any]) -> EpisodeWindow:
        """The window whose `state` this is."""
        return EpisodeWindow(msgspec.convert(state, list[Episode]))

    def state(self) -> list[Any]:
        """The episodes as plain data, for a checkpoint."""
        state: list[Any] = msgspec.to_builtins(list(self._episodes))
        return state

    def extend(self, episodes: Sequence[Episode]) -> None:
        """Add episodes that have just ended, in order."""
        if not episodes:
            return  # as after most updates of short rollouts: the means need not be computed again
        self._episodes.extend(episodes)
        self.return_mean = float(np.mean([episode.reward for episode in self._episodes]))
        self.length_mean = float(np.mean([episode.length for episode in self._episodes]))

    @property
    def full(self) -> bool:
        """True once there are 100."""
        return len(self._episodes) == WINDOW_EPISODES
