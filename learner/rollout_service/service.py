"""The workers as a training loop sees them: wait for workers, publish, gather, evaluate, drain, take a snapshot.

This is all that `learner.train` knows of the rest, and what `millrace.RolloutService` gives to a user's own loop. Who starts
worker processes is not known here: the launchers in `millrace` pass them in as `ProcessCallbacks`. Imports no torch.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

from learner.config.rollout_config import RolloutConfig
from learner.members.describe import DescribeSettings
from learner.members.process_callbacks import ProcessCallbacks
from learner.rollouts.evaluation_tickets import EvaluationPlan, OnRows, PlayedEpisode, evaluation_of
from learner.rollouts.hub import Hub, HubObserver, HubSettings, HubSnapshot
from learner.rollouts.lanes import AcceptedRollout
from learner.rollouts.ledger import Ledger
from learner.rollouts.ticket_coordinator import TicketCoordinator
from learner.run_folder.progress import Progress
from learner.run_folder.results import Evaluation
from protocol.arrays import Array, Floats
from protocol.messages import Status
from protocol.specs import RunSpec
from protocol.wire.learner_link import LearnerLink


class RolloutService:
    """Rollouts of one run, from any number of workers."""

    def __init__(self, hub: Hub, workers_expected: int = 0) -> None:
        """`workers_expected`: how many workers the user asked for; 0: any number."""
        self.workers_expected = workers_expected
        self._hub = hub

    def wait_for_workers(self, count: int) -> None:
        """Wait until this number of `workers` have joined. Raises `NoWorkers` when they do not come in time."""
        self._hub.wait_for(count)

    def publish(
        self, version: int, parameters: Floats, buffers: Floats, *, deal: bool = True, env_attributes: Array | None = None
    ) -> None:
        """Set the newest weights. The arrays must not change afterwards.

        `deal`: deal the tickets of the next update now; otherwise `gather` does, because these weights are evaluated first,
        or because others may follow. `env_attributes`: attributes that each env copy gets before its next rollout, packed.
        Raises `RunError` if a parameter is too large for the dtype in which weights are sent.
        """
        self._hub.publish(version, parameters, buffers, deal=deal, env_attributes=env_attributes)

    def gather(self, watch: Callable[[], None] = lambda: None) -> list[AcceptedRollout]:
        """Wait for the rollouts of the next update. Raises `RunError` when the run cannot go on.

        `watch` is called several times a second of a long wait.
        """
        return self._hub.gather(watch)

    def not_used(self, rollouts: list[AcceptedRollout]) -> None:
        """The update of the rollouts that `gather` returned last failed: they are counted as lost."""
        self._hub.not_used(rollouts)

    def pulse(self) -> None:
        """Answer the workers, during a long computation. Never waits, never raises."""
        self._hub.pulse()

    def evaluate(self, plan: EvaluationPlan, watch: Callable[[int, int], None]) -> Evaluation:
        """Let the workers play these episodes under the newest weights, which must be published with `deal` False.

        `watch` is called with the numbers of episodes that were played and of env steps, several times a second. Raises
        `RunError` when the run cannot go on.
        """
        return evaluation_of(self.play(plan, watch), self._hub.coordinator.run.facts)

    def play(
        self, plan: EvaluationPlan, watch: Callable[[int, int], None], on_rows: OnRows | None = None
    ) -> list[PlayedEpisode]:
        """As `evaluate`, but returns the episodes, in the order of their seeds. `on_rows` gets their rows."""
        return self._hub.evaluate(plan, watch, on_rows)

    def drain(self, reason: str, timeout_s: float = 5.0) -> None:
        """Ask every worker to leave, and wait for that at most `timeout_s`."""
        self._hub.drain(reason, timeout_s)

    def report(self, progress: Progress) -> None:
        """Tell how far the run is: `millrace status` and Prometheus ask for it."""
        self._hub.report_progress(progress)

    def status(self, now: float) -> Status:
        """The answer to `millrace status`. `now`: seconds of the monotonic clock."""
        return self._hub.status(now)

    def snapshot(self) -> HubSnapshot:
        """A snapshot of workers, tickets and rollouts."""
        return self._hub.snapshot()

    def workers_alive(self) -> int:
        """Number of processes that step the environment."""
        return self._hub.workers_alive()

    def lag_histogram(self) -> dict[str, int]:
        """Number of rollouts that were used, by lag, since this learner started."""
        return self._hub.weight_age.histogram()

    def first_use_s(self) -> dict[str, float]:
        """For each worker: median seconds from publishing weights to the arrival of its first rollout under them."""
        return self._hub.weight_age.first_use_s()


def rollout_service(
    config: RolloutConfig,
    run: RunSpec,
    link: LearnerLink,
    processes: ProcessCallbacks,
    check_interrupt: Callable[[], None],
    observer: HubObserver = lambda hub: None,
    past: tuple[Ledger, Sequence[int]] | None = None,
) -> RolloutService:
    """The service of a run for the workers that connect to this link. An update takes one rollout for each lane.

    `processes`: the worker processes that this program started. `check_interrupt` is called while the service waits: what it
    raises ends the wait. `observer` is called each time the service has listened. `past`: the ledger, and the next
    incarnation of each lane, of a run that goes on.
    """
    ledger, incarnations = (None, ()) if past is None else past
    coordinator = TicketCoordinator(
        run,
        max_lag=config.max_lag,
        worker_timeout_s=config.worker_timeout_s,
        first_session=int.from_bytes(os.urandom(6), "little"),
        ledger=ledger,
        incarnations=incarnations,
    )
    limits = [most for most in (config.max_env_copies, processes.most_copies) if most]
    if limits:
        coordinator.evaluation.most_copies = min(limits) - run.lanes * run.copies
    settings = HubSettings(
        config.no_workers_timeout_s,
        config.stall_timeout_s,
        config.max_env_failures,
        config.weights_dtype,
        config.call_timeouts(),
    )
    return RolloutService(Hub(link, coordinator, settings, processes, check_interrupt, observer), processes.expected)


def describe_settings(config: RolloutConfig, steps: int = 0) -> DescribeSettings:
    """The settings of the conversation in which a worker describes the environment. `steps`: env steps of the run."""
    return DescribeSettings(
        worker_timeout_s=config.worker_timeout_s,
        no_workers_timeout_s=config.no_workers_timeout_s,
        stall_timeout_s=config.stall_timeout_s,
        max_env_failures=config.max_env_failures,
        steps=steps,
        launched_workers=config.launched_workers,
    )
