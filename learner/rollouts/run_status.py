"""The progress of a run as the hub knows it now, and the answer to `millrace status`. Pure."""

from __future__ import annotations

from msgspec.structs import replace

from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.learner.run_folder.progress import Progress
from millrace.protocol.messages import Status
from millrace.protocol.progress import RunProgress


def progress_now(coordinator: TicketCoordinator, reported: Progress, waiting: str, phase: str) -> RunProgress:
    """The progress that was last reported, with the current ledger, phase and `waiting`, which says who waits for whom."""
    return replace(reported.plain(), ledger=coordinator.rollouts.ledger.counts(), waiting=waiting, phase=phase)


def status(coordinator: TicketCoordinator, progress: RunProgress, now: float) -> Status:
    """The status message of a run."""
    return Status(
        coordinator.run.env.id,
        progress,
        coordinator.membership.status(now),
        workers_wanted=len(coordinator.rollouts.lanes),
        version=coordinator.version,
    )
