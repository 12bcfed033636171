"""Measures the lag of rollouts, and how long new weights take to reach the environments. Pure.

The lag of a rollout is the learner's version minus the rollout's version, when the rollout is used. The first-use time of a
worker runs from publishing weights to the arrival of its first rollout under them. It contains the time on the network, the
time in the worker and the time that one rollout takes.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Iterable
from statistics import median

MOST_VERSIONS = 1_000  # the oldest is forgotten
MOST_MEASUREMENTS = 1_000  # of each worker; the oldest is forgotten
MOST_WORKERS = 1_000  # the one that was heard least recently is forgotten


class LagStatistics:
    """Lags and first-use times since this learner started."""

    def __init__(self) -> None:
        self.lags: Counter[int] = Counter()
        """rollouts that were used, by their lag"""
        self._published_s: dict[int, float] = {}
        self._newest_used: dict[str, int] = {}  # by worker: the newest version that a rollout of it was acted under
        self._first_use_s: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=MOST_MEASUREMENTS))

    def published(self, version: int, now: float) -> None:
        """From now on, rollouts may be acted under these weights."""
        self._published_s[version] = now
        self._published_s.pop(version - MOST_VERSIONS, None)

    def arrived(self, worker: str, version: int, now: float) -> None:
        """A rollout of this worker arrived. It was acted under this version."""
        newest = self._newest_used.pop(worker, -1)
        if version > newest and version in self._published_s:
            self._first_use_s[worker].append(now - self._published_s[version])
        self._newest_used[worker] = max(version, newest)  # at the end, so that the first was heard least recently
        if len(self._newest_used) > MOST_WORKERS:
            forgotten = next(iter(self._newest_used))
            del self._newest_used[forgotten]
            self._first_use_s.pop(forgotten, None)

    def used(self, lags: Iterable[int]) -> None:
        """Rollouts with these lags went into an update."""
        self.lags.update(lags)

    def not_used(self, lags: Iterable[int]) -> None:
        """Rollouts with these lags were to go into an update, which failed."""
        self.lags.subtract(lags)
        self.lags = +self.lags  # without those that are 0 now

    def histogram(self) -> dict[str, int]:
        """Number of rollouts that were used, by lag, from the smallest; a JSON object has strings for keys."""
        return {str(lag): self.lags[lag] for lag in sorted(self.lags)}

    def first_use_s(self) -> dict[str, float]:
        """For each worker, the median number of seconds from publishing weights to its first rollout under them."""
        return {worker: median(seconds) for worker, seconds in sorted(self._first_use_s.items())}
