"""The lag rule: how far the acting weights may be behind the newest ones, and so which weights act in which round. Pure.

Rule: update u takes round u, which is one rollout of every lane. All of them are collected with one version of the weights:
the newest one when update u - L began, or when the first update began if u < L, where L is `max_lag`. So results don't
depend on anybody's speed. Once update u has begun, the rounds up to u + L may be collected.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType


class Rounds:
    """The rounds of one run, counted from 0."""

    def __init__(self, max_lag: int, next_round: int = 0, versions: Mapping[int, int] = MappingProxyType({})) -> None:
        """`next_round`, `versions`: a resumed run's next round, and the versions that act in its open rounds."""
        self.max_lag = max_lag
        """L"""
        self.next = next_round
        """the round of the next update"""
        self._saved = {number: versions[number] for number in sorted(versions) if number <= next_round + max_lag}
        # of the rounds that were open before the run was interrupted, and are not yet open again
        self._versions: dict[int, int] = {}
        # of each round that may be collected and was not taken

    def begin(self, newest: int) -> range:
        """Begin the next update, with this version as the newest. Returns the rounds that it opens, once."""
        opened = range(self.next + len(self._versions), self.next + 1 + self.max_lag)
        self._versions |= {number: self._saved.pop(number, newest) for number in opened}
        return opened

    def end(self) -> None:
        """Close the round of the next update, which has taken its rollouts."""
        del self._versions[self.next]
        self.next += 1

    def version(self, number: int) -> int:
        """The version that acts in this open round."""
        return self._versions[number]

    @property
    def versions(self) -> Mapping[int, int]:
        """The version that acts in each round that is open, or will be as soon as the next update begins."""
        return self._saved | self._versions

    def acting(self) -> set[int]:
        """The versions that act in rounds that are open."""
        return set(self.versions.values())
