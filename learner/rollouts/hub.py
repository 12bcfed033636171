"""The hub connects link, ticket coordinator and clock, and lets a training loop gather rollouts and publish weights.

`millrace.learner.train` deals with workers only through the hub, and so does `millrace.RolloutService` for your own loop. A
loop waits only in `wait_for`, `gather`, `end_evaluation` and `drain`. Rule: every wait has a deadline, and the log says what
it waits for.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from millrace.learner.members.events import EpisodesArrived, Event, RolloutArrived
from millrace.learner.members.failure_count import FailureCount
from millrace.learner.members.held_up import LONG_S
from millrace.learner.members.member_server import MemberServer
from millrace.learner.members.membership import Membership
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan, OnRows, PlayedEpisode
from millrace.learner.rollouts.lag_statistics import LagStatistics
from millrace.learner.rollouts.past_rollouts import PastRollouts
from millrace.learner.rollouts.rollout_dealer import AcceptedRollout
from millrace.learner.rollouts.run_status import progress_now, status
from millrace.learner.rollouts.stall_watch import Overdue, StallWatch, Standstill
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.learner.rollouts.waiting import LearnerTime
from millrace.learner.run_folder.progress import Progress
from millrace.protocol.arrays import Array, Floats
from millrace.protocol.bounds import Stages, one_line
from millrace.protocol.errors import Stalled
from millrace.protocol.logs.long_wait import LongWait
from millrace.protocol.messages import Status, Weights
from millrace.protocol.progress import RunProgress
from millrace.protocol.rollout import rollout_bytes, saved_bytes
from millrace.protocol.wire.learner_link import LearnerLink
from millrace.protocol.wire.weight_dtypes import ActingDtype, to_float32, to_wire_dtype

log = logging.getLogger("millrace.learner")

T = TypeVar("T")
POLL_S = 0.1
GOODBYE_WITHIN_S = 5.0  # how long to wait for Goodbyes at the end of a run; late rollouts are still counted meanwhile
GOODBYE_IF_CUT_SHORT_S = 2.0  # the same, if the work is cut short or no episode is missing
# Shortest interval between two pulses that do any work. A pulse takes as long as a small minibatch, and ten of those may fit
# into this interval.
PULSE_S = 0.003


@dataclass(frozen=True)
class HubSettings:
    """The settings of a run that the hub needs, named as in `Config`."""

    no_workers_timeout_s: float
    stall_timeout_s: float
    max_env_failures: int
    """How many failures the run survives, as `FailureCount` counts them."""
    acting_dtype: ActingDtype = "float32"
    """The dtype in which parameters are sent."""


class StageTimes(NamedTuple):
    """How the learner and its workers have spent their time since this learner started, at one moment."""

    at_s: float = 0.0
    """The moment, by the hub's clock."""
    wait_s: float = 0.0
    """Seconds spent waiting for rollouts."""
    evaluate_s: float = 0.0
    """Seconds spent in evaluations."""
    learn_s: float = 0.0
    """Seconds spent on anything but these waits and evaluations, since the learner first waited for rollouts."""
    worker_stages: Stages = {}
    """Total seconds of all workers in each stage, including workers that have left."""


HubObserver = Callable[["Hub"], None]
"""Called with the hub each time it has listened to the workers."""


class Hub:
    """The training loop's view of its workers: gathers rollouts and publishes weights."""

    def __init__(
        self,
        link: LearnerLink,
        coordinator: TicketCoordinator,
        settings: HubSettings,
        processes: WorkerProcesses | None = None,
        check_interrupt: Callable[[], None] = lambda: None,
        observer: HubObserver = lambda hub: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`check_interrupt` is called while the hub waits; an exception that it raises ends the wait."""
        self.link = link
        self.coordinator = coordinator
        self.settings = settings
        link.packed_bytes_limit = rollout_bytes(coordinator.run) + saved_bytes(coordinator.run.copies)
        self._processes = processes or WorkerProcesses()
        self._check_interrupt = check_interrupt
        self._observer = observer
        self._clock = clock
        self.lags: list[int] = []
        """the lag of each rollout that the last `gather` returned"""
        self.lag_statistics = LagStatistics()
        self.reported = Progress()
        """the progress that was last reported"""
        run = coordinator.run
        self._failures = FailureCount(settings.max_env_failures, run.lanes * run.copies, clock())
        self._stall_watch = StallWatch(coordinator, settings.stall_timeout_s, run.call_timeouts)
        self._server = MemberServer(link, coordinator, self, self._processes, clock=clock)
        self._time = LearnerTime(coordinator, clock(), self._server.awaited, self._processes)

    def take_over(self, waiting: Membership, described_in_s: float) -> None:
        """Begin the run for the workers waiting for it. `described_in_s`: how long the environment's description took."""
        self._server.take_over(waiting, described_in_s)

    # ---------------------------------------------------------------- what the loop calls

    def wait_for(self, workers: int) -> None:
        """Wait until this many `workers` have joined. Raises `NoWorkers` after `no_workers_timeout_s`."""
        self._server.wait_for(workers, self.settings.no_workers_timeout_s, lambda: self._turn(POLL_S))

    def publish(
        self,
        version: int,
        parameters: Array,
        buffers: Array,
        *,
        deal: bool = True,
        env_attributes: Array | None = None,
        env_steps: int | None = None,
    ) -> None:
        """Set the newest weights. The arrays must not change afterwards.

        If `deal`, deals the tickets of the next update now. Otherwise, `gather` deals them later; use this for weights that
        are evaluated first. `env_steps` is the number of training env steps so far; with None, the weights never become an
        opponent.
        Raises `RunError` if a parameter is too large for `acting_dtype`.
        """
        sent = to_wire_dtype(parameters, self.settings.acting_dtype)
        self._time.learned(self._clock())
        self.lag_statistics.published(version, self._clock())
        self.coordinator.publish(version, sent, buffers, env_attributes=env_attributes, env_steps=env_steps)
        if deal:
            self._server.send(self.coordinator.begin_update())

    def keep_opponents(self, parameters: Array, buffers: Array) -> None:
        """Restore the weights [n, P] and buffers [n, B] of the n snapshots of a resumed run.

        Snapshots that act in an open round are already restored, along with the attributes of env copies.
        """
        kept = self.coordinator.weights.kept
        pool = self.coordinator.rollouts.opponents
        versions = [] if pool is None else pool.versions
        for version, of_version, its_buffers in zip(versions, parameters, buffers, strict=True):
            if version not in kept:
                kept[version] = Weights(version, to_wire_dtype(of_version, self.settings.acting_dtype), its_buffers)

    def opponent_policies(self) -> tuple[Floats, Floats] | None:
        """The weights [n, P] and buffers [n, B] of all n snapshots, float32; None if there are none."""
        kept = self.coordinator.weights.kept
        pool = self.coordinator.rollouts.opponents
        if pool is None or not pool.versions:
            return None
        found = [kept[version] for version in pool.versions]
        return np.stack([to_float32(each.parameters) for each in found]), np.stack([each.buffers for each in found])

    def past(self, first: int) -> PastRollouts:
        """The state from which a resumed run, which publishes version `first` first, continues after the last update."""
        return self.coordinator.past(first)

    def gather(self, watch: Callable[[], None] = lambda: None) -> list[AcceptedRollout]:
        """Wait for the rollouts of the next update. Raises `NoWorkers`, `Stalled`, `EnvironmentFailed` or `PolicyFailed`.

        During a long wait, `watch` is called at least every `POLL_S` seconds.
        """
        began_s = self._clock()
        wait = LongWait(began_s)
        steps = self._worker_steps()

        def watch_and_log() -> None:
            nonlocal steps
            now = self._clock()
            if now - began_s >= LONG_S:
                watch()
            if wait.due(now):
                before = steps
                steps = self._worker_steps()
                if steps != before:
                    log.info("%s", self.waiting(now))
                else:
                    log.warning("no env steps for %.0f s: %s", wait.seconds(now), self._server.what_workers_do())

        rollouts = self.coordinator.rollouts
        self._time.turn("gathering", began_s)
        self._server.send(self.coordinator.begin_update())
        taken = self._wait(rollouts.take, rollouts.waiting, watch_and_log, "no rollout came")
        self.lags = [self.coordinator.version - arrived.rollout.version for arrived in taken]
        self.lag_statistics.used(self.lags)
        return taken

    def not_used(self, taken: list[AcceptedRollout]) -> None:
        """Put back the rollouts that `gather` returned last, because their update was undone."""
        self.coordinator.rollouts.not_used(taken)
        self.lag_statistics.not_used(self.lags)

    def begin_evaluation(self, plan: EvaluationPlan, on_rows: OnRows | None = None, *, beside: bool = False) -> None:
        """Let the workers play these episodes with the newest weights.

        If `beside`, this runs alongside training, and only the workers that do nothing but evaluate play.
        """
        self._server.send(self.coordinator.begin_evaluation(plan, on_rows, beside=beside))

    def end_evaluation(self, watch: Callable[[int, int], None]) -> list[PlayedEpisode]:
        """Wait for the pending evaluation. Returns its episodes in the order of their seeds.

        `watch` is called with the number of episodes played and the number of env steps, at least every `POLL_S` seconds.
        Raises what `gather` raises.
        """
        evaluation = self.coordinator.evaluation.pending
        assert evaluation is not None, "no evaluation is pending"
        steps_before = self._worker_steps()
        wait = LongWait(self._clock())  # starts again with each new env step
        steps = steps_before  # the number of env steps when `wait` began

        def watch_and_log() -> None:
            nonlocal wait, steps
            now = self._clock()
            steps_now = self._worker_steps()
            if steps_now != steps:
                wait = LongWait(now)
                steps = steps_now
            elif wait.due(now):
                log.warning("no env steps for %.0f s: %s", wait.seconds(now), self._server.what_workers_do())
            watch(evaluation.episodes_played, max(0, steps_now - steps_before))  # steps_now falls if a worker is lost

        def done() -> bool | None:
            if not evaluation.done and evaluation.beside:
                self._server.send(self.coordinator.await_evaluation())
            return evaluation.done or None

        self._time.turn("evaluating", self._clock())
        try:
            self._wait(
                done,
                lambda: self._worker_steps() + evaluation.episodes_played,
                watch_and_log,
                "no env step of an evaluation was made",
            )
        finally:
            played = self.coordinator.evaluation.end()
            self._time.turn("learning", self._clock())
        self.lag_statistics.published(self.coordinator.version, self._clock())  # from now on, rollouts use these weights
        return played

    def pulse(self) -> None:
        """Answer the workers, then remove those that have been silent for too long, unless that was done a moment ago.

        Called between minibatches. Never waits, never ends the run, and takes no longer than the work since the last call.
        """
        if self._clock() - self._server.listened_s >= PULSE_S:
            self._listen(0.0, short=True)

    def drain(self, reason: str, timeout_s: float = GOODBYE_WITHIN_S) -> None:
        """Ask every worker to leave, and wait at most `timeout_s` for their Goodbyes. Late rollouts are counted."""
        self._server.send(self.coordinator.drain(reason))
        self._server.wait_until_all_left(self._clock() + timeout_s, POLL_S)
        if late := [member.hello.worker for member in self.coordinator.members.values()]:
            log.warning("did not say goodbye within %.0f s: workers %s", timeout_s, one_line(", ".join(late)))
        self._observer(self)

    def waiting(self, now: float) -> str:
        """A human-readable line that says who waits for whom; empty if nobody has waited for long."""
        return self._time.line(now)

    # ---------------------------------------------------------------- progress and state

    def report_progress(self, progress: Progress) -> None:
        """Store the run's progress, for answers to status requests."""
        self.reported = progress

    def progress(self) -> RunProgress:
        """How far the run has got: the progress that was last reported, updated with what the hub knows now."""
        return progress_now(self.coordinator, self.reported, self.waiting(self._clock()), self._time.phase)

    def status(self, now: float) -> Status:
        """The answer to `millrace status`."""
        return status(self.coordinator, self.progress(), now)

    @property
    def workers_expected(self) -> int:
        """The number of worker processes that the user asked for; 0 for any number."""
        return self._processes.expected

    def workers_alive(self) -> int:
        """The number of workers that step the environment."""
        stepping = self._processes.stepping()
        return len(self.coordinator.members if stepping is None else stepping)

    def stage_times(self) -> StageTimes:
        """How the learner and its workers have spent their time until now."""
        now = self._clock()
        spent_s = self._time.until(now)
        return StageTimes(
            at_s=now,
            wait_s=spent_s["gathering"],
            evaluate_s=spent_s["evaluating"],
            learn_s=spent_s["learning"],
            worker_stages=self.coordinator.membership.stages(),
        )

    # ---------------------------------------------------------------- called by the server

    def happened(self, event: Event) -> None:
        """Count rollouts and episodes that have arrived, and failures."""
        match event:
            case RolloutArrived(worker, lane, version):
                self.lag_statistics.arrived(worker, version, self._clock())
                self._failures.collected(lane)
            case EpisodesArrived(worker):
                evaluation = self.coordinator.evaluation.pending
                self._failures.evaluated(worker if evaluation is not None and evaluation.beside else None)
            case _:
                self._count_failure(event)

    def sent(self, peer: bytes) -> None:
        """Called when a message was sent. Does nothing."""

    # ---------------------------------------------------------------- inside

    def _wait(
        self, done: Callable[[], T | None], progress: Callable[[], int], watch: Callable[[], None], nothing_came: str
    ) -> T:
        """Listen until `done` returns something, and return that. Calls `watch` after each turn.

        Refuses workers that hold tickets without making progress. Raises `Stalled` if all of them do; `nothing_came` begins
        its message. The result of `progress` must change whenever the awaited work makes progress.
        """
        self._stall_watch.begin(self._clock())
        self._turn(0.0)
        while (result := done()) is None:
            self._turn(POLL_S)
            now = self._clock()
            match self._stall_watch.check(now, progress(), evaluating=self._time.evaluating):
                case Standstill(refuse=()):
                    raise Stalled(f"{nothing_came} for {self.settings.stall_timeout_s:.0f} s; {self.waiting(now)}")
                case Overdue():
                    self._share_evaluation(now)
                case Standstill(members, why):
                    for member in members:
                        self._server.send(self.coordinator.refuse(member, why))
            watch()
        self._time.turn("learning", self._clock())
        return result

    def _share_evaluation(self, now: float) -> None:
        """Let an idle worker, if there is one, also play the ticket that another worker has been playing for too long."""
        if out := self.coordinator.share_evaluation():
            seconds = self.settings.stall_timeout_s
            line = self.waiting(now)
            log.warning("no episode of an evaluation came for %.0f s, so another worker plays it as well: %s", seconds, line)
            self._server.send(out)

    def _worker_steps(self) -> int:
        """The total env steps of all workers, as of their last heartbeats."""
        heartbeats = (member.heartbeat for member in self.coordinator.members.values())
        return sum(heartbeat.steps for heartbeat in heartbeats if heartbeat is not None)

    def _turn(self, timeout_s: float) -> None:
        """One turn of waiting: listen, then check whether the run can continue."""
        self._listen(timeout_s)
        self._check_interrupt()
        for failed in self._processes.take_failures():
            self._count_failure(failed)
        self._failures.check()
        self._server.check_members(self.settings.no_workers_timeout_s, collecting=not self._time.evaluating)

    def _count_failure(self, event: Event) -> None:
        if line := self._failures.count(event, self._clock()):
            log.warning("%s", line)

    def _listen(self, timeout_s: float, short: bool = False) -> None:
        self._server.listen(timeout_s, short)
        self._observer(self)
