"""The answer to `millrace status` during a run. Pure."""

from __future__ import annotations

from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.learner.run_folder.progress import Progress
from millrace.protocol.messages import Status


def status(coordinator: TicketCoordinator, progress: Progress, now: float, waiting: str, phase: str) -> Status:
    """The status message of a run; `progress` is the newest that was reported, `waiting` says who waits for whom."""
    return Status(
        coordinator.run.env.id,
        coordinator.membership.status(now),
        len(coordinator.rollouts.lanes),
        version=coordinator.version,
        env_steps=progress.env_steps_made,
        total_steps=progress.total_steps,
        steps_per_s=progress.steps_per_s,
        return_mean=progress.return_mean,
        lag_mean=progress.lag_mean,
        lag_max=progress.lag_max,
        ledger=coordinator.rollouts.ledger.counts(),
        waiting=waiting,
        phase=phase,
        stages=progress.stages,
    )
