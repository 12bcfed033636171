"""The interface for prior data: a dataset (`--prior`) that an algorithm learns from in addition to its run's rollouts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from millrace.protocol.rollout import Batch


class PriorData(Protocol):
    """A dataset of complete episodes, in a fixed order.

    >>> import numpy as np
    >>> from millrace.algorithms import PriorData
    >>> def mean_reward(prior: PriorData) -> float:
    ...     return float(np.mean(np.concatenate([batch.reward for batch in prior.batches()])))
    """

    @property
    def rows(self) -> int:
        """Number of transitions."""

    @property
    def episodes(self) -> int:
        """Number of episodes."""

    def batches(self) -> Iterator[Batch]:
        """Yield each episode as a batch of one column [T, 1]. Every call starts again with the first episode.

        Raises `UsageError` if an episode cannot be used.
        """
