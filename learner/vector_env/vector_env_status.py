"""The answer to `millrace status` from a vector environment. Pure."""

from __future__ import annotations

from collections.abc import Callable

from msgspec.structs import replace

from millrace.learner.vector_env.order_coordinator import OrderCoordinator
from millrace.protocol.bounds import LARGEST
from millrace.protocol.messages import Status
from millrace.protocol.progress import RunProgress


def status(coordinator: OrderCoordinator, now: float, of_run: Callable[[float], Status] | None = None) -> Status:
    """The status message of a vector environment, which by itself has no weights, no target and no ledger.

    `of_run` returns the status of the run that acts on the environment's copies, if there is one. The result then has the
    figures of that run, and the workers of this vector environment.
    """
    workers = coordinator.membership.status(now)
    members = coordinator.members.values()
    if of_run is not None:
        return replace(of_run(now), workers=workers)
    steps = sum(member.heartbeat.steps for member in members if member.heartbeat is not None)
    progress = RunProgress(
        env_steps=min(steps, LARGEST),  # bounded, because workers may report any number
        steps_per_s=max(-LARGEST, min(sum(row.steps_per_s for row in workers), LARGEST)),
    )
    envs = ", ".join(dict.fromkeys(env.id for env in coordinator.spec.envs))
    return Status(envs, progress, workers, workers_wanted=len(coordinator.lanes))
