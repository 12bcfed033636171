"""How the run, or the vector environment, is, for whoever asks (`millrace status`). Pure: what is known in, words out."""

from __future__ import annotations

from collections.abc import Iterable

from learner.members.membership import Member
from learner.rollouts.roster import CollectingMember, Roster
from learner.run_folder.progress import Progress
from learner.vector_env.step_roster import Lockstep
from protocol.messages import Status, WorkerStatus


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
        workers=_workers(roster.members.values(), now),
        ledger=roster.ledger.counts(),
    )


def stepping_status(lockstep: Lockstep, now: float) -> Status:
    """What a vector environment knows now."""
    members = lockstep.members.values()
    return Status(
        env=", ".join(dict.fromkeys(env.id for env in lockstep.spec.envs)),
        version=-1,
        env_steps=sum(member.heartbeat.steps for member in members if member.heartbeat is not None),
        total_steps=0,
        steps_per_s=sum(member.steps_per_s for member in members),
        return_mean=None,
        lag_mean=0.0,
        lag_max=0,
        workers=_workers(members, now),
        ledger={},
    )


def _workers(members: Iterable[Member], now: float) -> tuple[WorkerStatus, ...]:
    return tuple(_worker(member, now) for member in sorted(members, key=lambda member: member.order))


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
        version=member.acknowledged if isinstance(member, CollectingMember) else -1,
        silent_s=max(0.0, now - member.heard_s),
        resident_bytes=said.resident_bytes if said else 0,
        strikes=member.strikes if isinstance(member, CollectingMember) else 0,
    )
