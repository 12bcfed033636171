"""The last 100 training episodes and their means. Pure."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import msgspec
import numpy as np

from millrace.learner.run_folder.results import FactMean, fact_means
from millrace.protocol.rollout import Episode

WINDOW_EPISODES = 100


class EpisodeWindow:
    """The last 100 episodes."""

    def __init__(self, episodes: Sequence[Episode] = (), facts: Sequence[str] = ()) -> None:
        """`facts` are the names of the episodes' facts."""
        self.facts: dict[str, FactMean] = fact_means(facts, ())
        """The means of the episodes' facts, by name."""
        self._names = facts
        self.return_mean: float | None = None
        """The mean return; None before the first episode has ended."""
        self.length_mean: float | None = None
        """The mean length in env steps; None before the first episode has ended."""
        self._episodes: deque[Episode] = deque(maxlen=WINDOW_EPISODES)
        self.extend(episodes)

    @staticmethod
    def from_state(episodes: list[Episode], had: Sequence[str] = (), facts: Sequence[str] = ()) -> EpisodeWindow:
        """The window with these episodes. `had` are the names of their facts; new episodes have `facts`."""
        if tuple(had) != tuple(facts):
            by_name = (dict(zip(had, one.facts, strict=False)) for one in episodes)
            renamed = (tuple(of_one.get(name, math.nan) for name in facts) for of_one in by_name)
            episodes = [msgspec.structs.replace(one, facts=new) for one, new in zip(episodes, renamed, strict=True)]
        return EpisodeWindow(episodes, facts)

    def state(self) -> list[Episode]:
        """The episodes, for a checkpoint."""
        return list(self._episodes)

    def extend(self, episodes: Sequence[Episode]) -> None:
        """Add episodes that have just ended, in order."""
        if not episodes:
            return  # common with short rollouts: the means stay the same
        self._episodes.extend(episodes)
        self.return_mean = float(np.mean([episode.reward for episode in self._episodes]))
        self.length_mean = float(np.mean([episode.length for episode in self._episodes]))
        if self._names:
            self.facts = fact_means(self._names, [episode.facts for episode in self._episodes])

    @property
    def full(self) -> bool:
        """Whether the window has all of its 100 episodes."""
        return len(self._episodes) == WINDOW_EPISODES
