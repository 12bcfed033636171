"""The answer to `millrace status` from a vector environment. Pure."""

from __future__ import annotations

from msgspec.structs import replace

from learner.vector_env.order_coordinator import OrderCoordinator
from protocol.messages import Status


def status(coordinator: OrderCoordinator, now: float) -> Status:
    """The status message of a vector environment of its own. It has no weights, no target and no ledger."""
    members = coordinator.members.values()
    return Status(
        ", ".join(dict.fromkeys(env.id for env in coordinator.spec.envs)),
        coordinator.membership.status(now),
        len(coordinator.lanes),
        env_steps=sum(member.heartbeat.steps for member in members if member.heartbeat is not None),
        steps_per_s=sum(member.steps_per_s for member in members),
    )


def status_of_run(run: Status, coordinator: OrderCoordinator, now: float) -> Status:
    """The status message of a run that acts on the copies of a vector environment: its own figures, and these workers."""
    return replace(run, workers=coordinator.membership.status(now))
