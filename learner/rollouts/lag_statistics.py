"""Measures the lag of rollouts, and how long new weights take to reach the environments. Pure.

The lag of a rollout is the learner's version minus the rollout's version, when the rollout is used. The first-use time of a
worker runs from publishing weights to the arrival of its first rollout under them. It contains the time on the network, the
time in the worker and the time that one rollout takes.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Iterable
from statistics import median

REMEMBERED = 1_000  # the newest versions, and the newest measurements of each worker
WORKERS = 1_000  # of which measurements are kept; of more, the newest


class LagStatistics:
    """Lags and first-use times since this learner started."""

    def __init__(self) -> None:
        self.lags: Counter[int] = Counter()
        """rollouts that were used, by their lag"""
        self._published_s: dict[int, float] = {}
        self._newest_used: dict[str, int] = {}  # by worker: the newest version that a rollout of it was acted under
        self._first_use_s: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=REMEMBERED))

    def published(self, version: int, now: float) -> None:
        """New weights were sent."""
        self._published_s[version] = now
        self._published_s.pop(version - REMEMBERED, None)

    def arrived(self, worker: str, version: int, now: float) -> None:
        """A rollout of this worker arrived. It was acted under this version."""
        if version > self._newest_used.get(worker, -1) and version in self._published_s:
            self._first_use_s[worker].append(now - self._published_s[version])
        newest = self._newest_used.pop(worker, -1)
        self._newest_used[worker] = max(
            version, newest
        )  # last in the table: the worker that sent nothing for longest is first
        if len(self._newest_used) > WORKERS:
            oldest = next(iter(self._newest_used))
            del self._newest_used[oldest]
            self._first_use_s.pop(oldest, None)

    def used(self, lags: Iterable[int]) -> None:
        """Rollouts with these lags went into an update."""
        self.lags.update(lags)

    def not_used(self, lags: Iterable[int]) -> None:
        """Rollouts with these lags were to go into an update, which failed."""
        self.lags.subtract(lags)
        self.lags = +self.lags

    def histogram(self) -> dict[str, int]:
        """Number of rollouts that were used, by lag, from the smallest; a JSON object has strings for keys."""
        return {str(lag): self.lags[lag] for lag in sorted(self.lags)}

    def first_use_s(self) -> dict[str, float]:
        """For each worker, the median number of seconds from publishing weights to its first rollout under them."""
        return {worker: median(seconds) for worker, seconds in sorted(self._first_use_s.items())}
