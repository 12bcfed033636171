"""The lag rule: how far the acting weights may be behind the newest ones, and thus which weights act in which round. Pure.

Rule: update u uses round u, which is one rollout from every lane. All rollouts of a round are collected with one version of
the weights. With L = `max_lag`, this is the version that was the newest when update u - L began or, if u < L, when the first
update began. Results therefore don't depend on the speed of the workers or the learner. Once update u has begun, the rounds
up to u + L may be collected.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType


class Rounds:
    """The rounds of one run, counted from 0."""

    def __init__(self, max_lag: int, next_round: int = 0, versions: Mapping[int, int] = MappingProxyType({})) -> None:
        """For a resumed run, `next_round` is its next update's round, and `versions` has the version of each open round."""
        self.max_lag = max_lag
        """L"""
        self.next = next_round
        """the round of the next update"""
        # By round, the versions in rounds that were open when the run was interrupted and have not been opened again.
        self._saved = {number: versions[number] for number in sorted(versions) if number <= next_round + max_lag}
        # By round, the versions in open rounds: those that may be collected and have not been taken.
        self._versions: dict[int, int] = {}

    def begin(self, newest: int) -> range:
        """Begin the next update. `newest` is the newest version. Returns the rounds that this opens.

        A second call for the same update opens none.
        """
        opened = range(self.next + len(self._versions), self.next + 1 + self.max_lag)
        self._versions |= {number: self._saved.pop(number, newest) for number in opened}
        return opened

    def end(self) -> None:
        """Close the round of the next update, whose rollouts were taken."""
        del self._versions[self.next]
        self.next += 1

    def reopen(self, version: int) -> None:
        """Reopen the round that was closed last, because its rollouts were put back. `version` acts in it."""
        self.next -= 1
        self._versions = {self.next: version} | self._versions

    def version(self, number: int) -> int:
        """The version that acts in this round, which must be open."""
        return self._versions[number]

    @property
    def versions(self) -> Mapping[int, int]:
        """The version that acts in each open round, and in each round that a resumed run will open again, by round."""
        return self._saved | self._versions

    def acting(self) -> set[int]:
        """The versions that act in rounds that are open."""
        return set(self.versions.values())
