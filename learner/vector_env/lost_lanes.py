"""Bookkeeping of lanes whose worker was lost. Pure.

Rule: each loss is reported in exactly one step result, as truncated copies, or it is raised. The new copies of a lost
lane are reset before they step.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet

from millrace.learner.vector_env.batch_layout import BatchLayout
from millrace.protocol.errors import WorkerLost
from millrace.protocol.random_streams import Purpose, env_seed

RESET_ATTEMPTS = 3
"""How often a reset is tried while each attempt loses a worker."""
UNKNOWN_REASON = "its worker is gone"


class LostLanes:
    """The lanes that are lost and not yet reported, and those that are reported and not yet reset."""

    def __init__(self) -> None:
        self._unreported: dict[int, str] = {}  # lane -> why
        self._awaiting_reset: set[int] = set()

    @property
    def unreported(self) -> Mapping[int, str]:
        """Lanes that no step result has reported yet, and why each was lost."""
        return self._unreported

    @property
    def awaiting_reset(self) -> AbstractSet[int]:
        """Lanes whose next order must be a reset: their env copies are new."""
        return self._awaiting_reset

    def add(self, lost: Mapping[int, str]) -> None:
        """These lanes were lost, for these reasons."""
        self._unreported |= lost

    def expect_reset(self, lanes: Iterable[int]) -> None:
        """The caller knows that these lanes were lost."""
        self._awaiting_reset.update(lanes)

    def answered(self, lanes: AbstractSet[int]) -> None:
        """These lanes answered an order: they have been reset if they had to be."""
        self._awaiting_reset -= lanes

    def forget(self, lanes: Iterable[int]) -> None:
        """These lanes begin new episodes: earlier losses no longer matter."""
        for lane in lanes:
            self._unreported.pop(lane, None)

    def report(self, unanswered: Sequence[int]) -> dict[int, str]:
        """Report lanes that have no result for this step, and why. From now on they wait for a reset.

        A lane that answered this step and was lost afterwards is reported in the next step.
        """
        reported = {lane: self._unreported.pop(lane, UNKNOWN_REASON) for lane in unanswered}
        self.expect_reset(reported)
        return reported


def replacement_seeds(seeds: Iterable[int | None], incarnation: int) -> tuple[int | None, ...]:
    """Seeds for copies that replace lost ones: other than the old seeds, and the same whenever this loss is repeated."""
    return tuple(None if seed is None else env_seed(seed, Purpose.REPLACEMENT, incarnation) for seed in seeds)


def worker_lost(lost: Mapping[int, str], layout: BatchLayout) -> WorkerLost:
    """The error that names each lost lane, its copies and the reason."""
    reasons = [
        f"{why}: lane {lane} (copies {layout.copies(lane)[0]} to {layout.copies(lane)[-1]}) is lost"
        for lane, why in lost.items()
    ]
    return WorkerLost("; ".join(reasons) or "a worker was lost")
