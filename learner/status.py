"""How the run is, for whoever asks (`millrace status`). Pure: a roster, the run's progress and `now` in, a message out."""

from __future__ import annotations

from learner.metrics import Progress
from learner.roster import Member, Roster
from protocol.messages import Status, WorkerStatus


def status(roster: Roster, progress: Progress, now: float) -> Status:
    """What the learner knows now; `progress` is that of the last update."""
    members = sorted(roster.members.values(), key=lambda member: member.order)
    return Status(
        env=roster.run.env.id,
        version=roster.version,
        env_steps=progress.env_steps,
        total_steps=progress.total_steps,
        steps_per_s=progress.steps_per_s,
        return_mean=progress.return_mean,
        lag_mean=progress.lag_mean,
        lag_max=progress.lag_max,
        workers=tuple(_worker(member, now) for member in members),
        ledger=roster.ledger.counts(),
    )


def _worker(member: Member, now: float) -> WorkerStatus:
    said = member.heartbeat
    return WorkerStatus(
        worker=member.hello.worker,
        host=member.hello.host,
        pid=member.hello.pid,
        standing=member.standing.value,
        lanes=tuple(sorted(member.lanes)),
        tickets=len(member.tickets),
        steps=said.steps if said else 0,
        steps_per_s=member.steps_per_s,
        version=member.acknowledged,
        silent_s=max(0.0, now - member.heard_s),
        resident_bytes=said.resident_bytes if said else 0,
        strikes=member.strikes,
    )
