"""Measures the lag of rollouts, and how long new weights take to reach the environments. Pure.

The lag of a rollout is the learner's version when the rollout is used, minus the rollout's version. A worker's first-use
time is the time from the publication of weights to the arrival of the worker's first rollout collected with them. It
includes the time on the network, the time in the worker and the time that one rollout takes.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Iterable
from statistics import median

MOST_VERSIONS = 1_000  # how many versions are remembered; the oldest is forgotten first
MOST_MEASUREMENTS = 1_000  # how many measurements are remembered per worker; the oldest is forgotten first
MOST_WORKERS = 1_000  # how many workers are remembered; the one heard from least recently is forgotten first


class LagStatistics:
    """Lags and first-use times since this learner started."""

    def __init__(self) -> None:
        self.lags: Counter[int] = Counter()
        """the number of rollouts that were used, by their lag"""
        self._published_s: dict[int, float] = {}
        self._newest_used: dict[str, int] = {}  # by worker, the newest version in its rollouts
        self._first_use_s: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=MOST_MEASUREMENTS))

    def published(self, version: int, now: float) -> None:
        """Record that rollouts may be collected with this version of the weights from now on."""
        self._published_s[version] = now
        self._published_s.pop(version - MOST_VERSIONS, None)

    def arrived(self, worker: str, version: int, now: float) -> None:
        """Record the arrival of a rollout that this worker collected with this version."""
        newest = self._newest_used.pop(worker, -1)
        if version > newest and version in self._published_s:
            self._first_use_s[worker].append(now - self._published_s[version])
        self._newest_used[worker] = max(version, newest)  # moved to the end, so the first was heard from longest ago
        if len(self._newest_used) > MOST_WORKERS:
            forgotten = next(iter(self._newest_used))
            del self._newest_used[forgotten]
            self._first_use_s.pop(forgotten, None)

    def used(self, lags: Iterable[int]) -> None:
        """Count the lags of rollouts that an update used."""
        self.lags.update(lags)

    def not_used(self, lags: Iterable[int]) -> None:
        """Subtract the lags of rollouts whose update was undone."""
        self.lags.subtract(lags)
        self.lags = +self.lags  # drops counts that are 0 now

    def histogram(self) -> dict[str, int]:
        """The number of rollouts that were used, by lag, in ascending order. Keys are strings, as in JSON."""
        return {str(lag): self.lags[lag] for lag in sorted(self.lags)}

    def first_use_s(self) -> dict[str, float]:
        """For each worker, the median number of seconds from publishing weights to its first rollout with them."""
        return {worker: median(seconds) for worker, seconds in sorted(self._first_use_s.items())}
