"""The answer to `millrace status` from a vector environment. Pure."""

from __future__ import annotations

from learner.vector_env.step_roster import StepRoster
from protocol.messages import Status


def status(roster: StepRoster, now: float) -> Status:
    """What a vector environment knows now. It has no weights, no target and no ledger."""
    members = roster.members.values()
    return Status(
        env=", ".join(dict.fromkeys(env.id for env in roster.spec.envs)),
        version=-1,
        env_steps=sum(member.heartbeat.steps for member in members if member.heartbeat is not None),
        total_steps=0,
        steps_per_s=sum(member.steps_per_s for member in members),
        return_mean=None,
        lag_mean=0.0,
        lag_max=0,
        workers=roster.membership.status(now),
        ledger={},
    )
