"""Bookkeeping of lanes whose worker was lost. Pure.

Rule: each loss is either reported in exactly one step result, as truncated copies, or raised as an error. The new copies of
a lost lane are reset before they step.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet

from millrace.learner.vector_env.batch_layout import BatchLayout
from millrace.protocol.errors import WorkerLost
from millrace.protocol.random_streams import Purpose, env_seed

RESET_ATTEMPTS = 3
"""How many times a reset is tried if every attempt loses a worker."""


class LostLanes:
    """The lanes whose loss has not been reported yet, and the lanes that wait for a reset after the report."""

    def __init__(self) -> None:
        self._unreported: dict[int, str] = {}  # by lane, why it was lost
        self._awaiting_reset: set[int] = set()

    @property
    def unreported(self) -> Mapping[int, str]:
        """Lanes whose loss no step result has reported yet, and why each was lost."""
        return self._unreported

    @property
    def awaiting_reset(self) -> AbstractSet[int]:
        """Lanes whose next order must be a reset, because their env copies are new."""
        return self._awaiting_reset

    def add(self, lost: Mapping[int, str]) -> None:
        """Record that these lanes were lost, for these reasons."""
        self._unreported |= lost

    def expect_reset(self, lanes: Iterable[int]) -> None:
        """Record that the caller knows that these lanes were lost. They now wait for a reset."""
        self._awaiting_reset.update(lanes)

    def answered(self, lanes: AbstractSet[int]) -> None:
        """Record that these lanes answered an order. If they waited for a reset, that order was the reset."""
        self._awaiting_reset -= lanes

    def forget(self, lane: int) -> None:
        """Forget an earlier loss of this lane, if there was one, because the caller has the reset of all its copies."""
        self._unreported.pop(lane, None)

    def report(self, unanswered: Sequence[int]) -> dict[int, str]:
        """Report lanes that were lost instead of answering this step. Returns the reasons, by lane.

        From now on, these lanes wait for a reset. A lane that was lost after it answered this step is reported in the next
        step.
        """
        reported = {lane: self._unreported.pop(lane) for lane in unanswered}
        self.expect_reset(reported)
        return reported


def replacement_seeds(seeds: Iterable[int | None], incarnation: int) -> tuple[int | None, ...]:
    """Seeds for copies that replace lost ones. They differ from the old seeds, but are reproducible."""
    return tuple(None if seed is None else env_seed(seed, Purpose.REPLACEMENT, incarnation) for seed in seeds)


def worker_lost(lost: Mapping[int, str], layout: BatchLayout) -> WorkerLost:
    """The error that names each lost lane, its copies and the reason."""
    reasons = [
        f"{why}: lane {lane} (copies {layout.copies(lane)[0]} to {layout.copies(lane)[-1]}) is lost"
        for lane, why in lost.items()
    ]
    return WorkerLost("; ".join(reasons) or "a worker was lost")
