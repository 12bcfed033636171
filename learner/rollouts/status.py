"""The answer to `millrace status` during a run. Pure."""

from __future__ import annotations

from learner.rollouts.roster import Roster
from learner.run_folder.progress import Progress
from protocol.messages import Status


def status(roster: Roster, progress: Progress, now: float) -> Status:
    """What the learner knows now; `progress` is that of the last update."""
    return Status(
        env=roster.run.env.id,
        version=roster.version,
        env_steps=progress.env_steps,
        total_steps=progress.total_steps,
        steps_per_s=progress.steps_per_s,
        return_mean=progress.return_mean,
        lag_mean=progress.lag_mean,
        lag_max=progress.lag_max,
        workers=roster.membership.status(now),
        ledger=roster.ledger.counts(),
    )
