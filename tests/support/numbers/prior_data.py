"""Batches as prior data, without a dataset."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from millrace.protocol.rollout import Batch


@dataclass(frozen=True)
class GivenPrior:
    """Each column of these batches is an episode, with all of its rows."""

    given: Sequence[Batch]

    @property
    def rows(self) -> int:
        return sum(batch.valid.size for batch in self.given)

    @property
    def episodes(self) -> int:
        return sum(batch.valid.shape[1] for batch in self.given)

    def batches(self) -> Iterator[Batch]:
        return iter(self.given)
