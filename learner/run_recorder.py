"""Metrics, checkpoints, evaluations, callbacks and the decision to stop: everything that a run does between two updates.

Rule: a checkpoint is written between two updates, never during one, and holds everything that the next update depends on.
It is written after the callbacks of its update, and before an evaluation, which may take long. If the disk is full, the run
logs a warning and goes on; at its end, it fails if the disk does not take its last state. The seconds of evaluations are a
stage of their own and do not count as training.
"""

from __future__ import annotations

import logging
import math
import shlex
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from learner.algorithms import Algorithm
from learner.algorithms.algorithm import check_weights
from learner.callbacks.callbacks import Callbacks
from learner.config.config import Config
from learner.evaluations import Evaluations
from learner.recording.image_sample import image_samples
from learner.recording.training_recorder import TrainingRecorder
from learner.rollout_service.service import RolloutService
from learner.rollouts.hub import HubSnapshot
from learner.rollouts.lanes import AcceptedRollout
from learner.run_folder import checkpoint
from learner.run_folder.env_attributes import EnvAttributes
from learner.run_folder.episode_window import EpisodeWindow
from learner.run_folder.metrics_log import MetricsLog
from learner.run_folder.progress import Progress, Row, named, steps_per_second
from learner.run_folder.requests import Requests
from learner.run_folder.results import Best, Summary
from learner.run_folder.run_folder import RunFolder
from learner.run_folder.run_format import versions
from learner.run_state import RunState
from protocol.arrays import Array, Floats
from protocol.bounds import one_line
from protocol.errors import RunError, first_line
from protocol.logs.notices import log_notice
from protocol.rollout import Batch
from protocol.specs import RunSpec

log = logging.getLogger("millrace.learner")

SHOW_EVERY_S = 0.2  # progress between two updates


class EpisodeSettings(NamedTuple):
    """What a run does with its episodes."""

    recorder: TrainingRecorder | None
    """Writes the episodes of training to a dataset. It is closed with the `RunRecorder`."""
    evaluation_limit: int | None
    """Env steps after which an episode of an evaluation is truncated, if it is."""


class RunRecorder:
    """Counts the updates of one run, evaluates its policy, writes its files, and decides when it ends."""

    def __init__(
        self,
        config: Config,
        folder: RunFolder,
        spec: RunSpec,
        algorithm: Algorithm,
        service: RolloutService,
        state: RunState,
        callbacks: Callbacks,
        episodes: EpisodeSettings,
    ) -> None:
        """`state`: where the run stands."""
        self.version, self.env_steps = state.version, state.env_steps
        self._config, self._folder, self._spec = config, folder, spec
        self._algorithm, self._service, self._callbacks = algorithm, service, callbacks
        self._stop_rule, self._checkpoints = config.stop_rule(), config.checkpoint_policy()
        settings = config.evaluation_settings()
        self._evaluations = Evaluations(settings, folder, spec, algorithm, service, state, self.show_now)
        self._shown_s = 0.0
        self._confirmed: Best | None = None
        refusal = "envpool's env copies have no attributes" if spec.vector == "envpool" else ""
        self._requests = Requests(EnvAttributes(state.env_attributes, refusal))
        self._settings = msgspec.to_builtins(config)
        self._evaluation_limit = episodes.evaluation_limit
        self._update: dict[str, Any] = {}  # facts of the last update: fields of `Progress`
        self._window = EpisodeWindow.from_state(state.episodes, state.facts, spec.facts)
        self._metrics = MetricsLog(folder.path, state.env_steps)
        self._episode_recorder = episodes.recorder
        self._stages_s = {"update": 0.0, "other": 0.0}
        self._gathered_s = 0.0  # what `gathered` took last
        self._wall_before_s, self._steps_before = state.wall_s, state.env_steps
        self._started_s = self._saved_s = time.monotonic()
        self._episodes_since_save = 0
        self.longest_save_s = 0.0
        """How long the longest checkpoint took to write, in this process."""
        self._saved: tuple[int, int, list[float] | None, int] | None = None  # what `_position` was in the newest checkpoint
        self._saved_env_steps = state.env_steps if state.version else None
        self._policy_env_steps = self._saved_env_steps
        self._saved_to = ""  # path of the newest checkpoint
        self._finished = False
        self._said_missing = False  # whether facts were looked for in the first episodes
        self._workers_alive = 0
        service.report(self.progress())

    # ---------------------------------------------------------------- what the loop calls

    def stop_reason(self) -> str | None:
        """Why the run should end now, or None."""
        if self._callbacks.stop_reason is not None:
            return self._callbacks.stop_reason
        newest = self._evaluations.newest
        steps_per_update = self._spec.rollout_steps * self._config.envs
        return self._stop_rule.reason_to_stop(
            env_steps_after_next_update=self.env_steps + steps_per_update if self.version else 0,
            evaluation_return=None if newest is None else newest.return_mean,
            training_return=self._window.return_mean if self._window.full else None,
        )

    def cloned(self, metrics: Mapping[str, float]) -> None:
        """The policy was cloned: show and log these metrics. An evaluation is due, if the run makes any."""
        found = ", ".join(f"{name.rpartition('/')[2].replace('_', ' ')} {number:.3g}" for name, number in metrics.items())
        epochs: int = getattr(self._config.algorithm, "clone_epochs", 0)
        log_notice(log, f"cloned {self._config.prior} in {epochs} epochs: {found}")
        self._write_row(self.progress(), metrics)
        self._evaluations.next_at = 0

    def start(self) -> None:
        """The run begins, or goes on, and workers have joined: tell the callbacks."""
        self._callbacks.on_start(self.progress())

    def gathered(self, rollouts: Sequence[AcceptedRollout]) -> bool:
        """These rollouts have come. True if an update is to be made of them: no callback ends the run.

        Their episodes are recorded, if the run records episodes.
        """
        began_s = time.monotonic()
        try:
            return self._tell_rollouts(rollouts)
        finally:
            self._gathered_s = time.monotonic() - began_s

    def count(self, batch: Batch) -> None:
        """An update was made of this batch."""
        self.version += 1
        self.env_steps += batch.env_steps
        self._window.extend(batch.episodes)
        self._update = {"episodes": batch.episodes}
        if self._spec.facts and self._window.full and not self._said_missing:
            self._say_missing_facts()
        self._episodes_since_save += len(batch.episodes)
        if self.version == 1:
            images = image_samples(batch.obs, self._spec.policy.observation)
            self._folder.writes.write("images", lambda: self._folder.write_images(images))

    def weights(self) -> tuple[Floats, Floats]:
        """The parameters and buffers of the algorithm. Raises `UsageError` if no worker could act with them."""
        weights = self._algorithm.weights()
        check_weights(weights, self._spec.policy, type(self._algorithm).__name__)
        return weights

    def env_attributes(self) -> Array | None:
        """The attributes of env copies that the weights of this version carry."""
        return self._requests.attributes.table(self.version)

    def training_goes_on(self) -> bool:
        """Whether the next rollouts may be collected now: no evaluation is due, and the run does not end."""
        return not self._evaluations.is_due(self.env_steps) and self.stop_reason() is None

    def show_now(self) -> None:
        """Show how far an evaluation is, or what a long wait is for, now and then."""
        now = time.monotonic()
        if now - self._shown_s >= SHOW_EVERY_S:
            self._shown_s = now
            self._callbacks.meanwhile(self.progress())

    def updated(self, metrics: Mapping[str, float], update_s: float) -> None:
        """The update that was counted last was published: tell the callbacks, evaluate it and write what is due.

        `update_s`: seconds since its rollouts had come; those of `gathered` are among them, and do not count as its own.
        """
        began_s = time.monotonic()
        self._workers_alive = self._service.workers_alive()
        self._stages_s["update"] += update_s - self._gathered_s
        self._stages_s["other"] += self._gathered_s
        snapshot = self._service.snapshot()
        self._update |= {"metrics": named(metrics), "lags": tuple(snapshot.lags)}
        progress = self._progress(snapshot)
        self._write_row(progress, metrics)
        self._service.report(progress)
        try:
            self._callbacks.on_update(progress)
        finally:
            self._write_logged()
        evaluates = self._evaluations.is_due(self.env_steps) and self._callbacks.stop_reason is None
        if evaluates:
            self.save()
            self._evaluate()
        if evaluates or self._checkpoints.is_due(
            since_last_s=began_s - self._saved_s, episodes_since_last=self._episodes_since_save, updates=self.version
        ):
            self.save()
        evaluated_s = self._service.snapshot().evaluate_s - snapshot.evaluate_s if evaluates else 0.0
        self._stages_s["other"] += time.monotonic() - began_s - evaluated_s

    def evaluate_if_due(self) -> None:
        """Make the evaluation before which the run was interrupted, if there is one. The weights must be published."""
        if self._evaluations.is_due(self.env_steps) and self._callbacks.stop_reason is None:
            self._evaluate()
            self.save()

    def save(self) -> None:
        """Write a checkpoint and the policy. Raises `RunTakenOver` if another process trains this run now."""
        self._confirm_lock()
        began_s = time.monotonic()
        self._folder.writes.write("state", self._write_state)
        self._saved_s, self._episodes_since_save = began_s, 0
        self._took_to_save(time.monotonic() - began_s)
        if self._saved == self._position():
            self._tell_checkpoint()

    def confirm_saved(self) -> None:
        """The last save: what the disk has refused is tried again for a while. Raises `RunError` if it stays refused.

        Raises `RunTakenOver`, as `save` does.
        """
        self._confirm_lock()
        before = self._saved
        self._folder.writes.confirm()
        if self._saved != before:
            self._tell_checkpoint()

    def save_if_time(self) -> None:
        """Write a checkpoint and the policy if the newest checkpoint is older than `checkpoint_every_s`."""
        if self._checkpoints.is_time(time.monotonic() - self._saved_s):
            self.save()

    def save_unless_saved(self) -> None:
        """Write a checkpoint and the policy, unless the newest checkpoint already has this state."""
        if self._saved != self._position():
            self.save()

    def save_after_error(self, error: BaseException) -> None:
        """As `save_unless_saved` and `confirm_saved`. What a callback raises is logged: `error` ended the run, and counts.

        Raises `RunError` if the disk refuses the state and `error` says no failure, as Ctrl-C.
        """
        try:
            self.save_unless_saved()
        except Exception as raised:
            if self._saved != self._position():
                raise
            log.warning("%s: %s", type(raised).__name__, first_line(raised))
        try:
            self.confirm_saved()
        except RunError as refused:
            if not isinstance(error, Exception):
                raise
            log.warning("%s", refused)

    def continues(self) -> str:
        """One line that says where a resumed run continues, and which updates are lost."""
        line = f"run {self._folder.path} continues at {self.env_steps:,} env steps, after update {self.version:,}"
        if lost := self._metrics.removed:
            line += f"; {lost:,} later update{'s were' if lost > 1 else ' was'} not saved, and must be made again"
        return line

    def saved(self) -> str:
        """One line that says what can be resumed, and where; empty if nothing was learned yet."""
        if not self.version:
            return ""
        where = shlex.quote(str(self._folder.path))
        if self._saved_env_steps is None:
            return f"no checkpoint could be written to {where}"
        newest = f"{self._saved_env_steps:,} env steps are saved"
        if self._policy_env_steps not in (None, self._saved_env_steps):
            newest += f", and the policy of {self._policy_env_steps:,}"
        return f"{newest}; go on with: --resume {where}"

    def conclude(self) -> None:
        """Evaluate the final policy, which must be published, and the best one."""
        before = self._evaluations.of_version(self.version)
        self._confirmed = self._evaluations.conclude(
            self.version, self.env_steps, self._window.length_mean, self._evaluation_limit
        )
        if self._evaluations.of_version(self.version) is not before:
            self._tell_evaluation(self.progress())

    def finish(self, reason: str, *, cut_short: bool = False) -> None:
        """Write the summary, and tell the callbacks. Does nothing if that was done.

        `cut_short`: an error or an interrupt ended the run. Otherwise raises `RunError` if the summary cannot be written.
        """
        if not self._finished:
            self._folder.writes.write("summary", lambda: self._folder.write_summary(self._summary(reason, cut_short)))
            if not cut_short:
                self._folder.writes.confirm()
            self._finished = True
            self._requests.closed = "the run has ended"
            self._callbacks.on_end(msgspec.structs.replace(self.progress(), stop_reason=reason, cut_short=cut_short))

    def close(self) -> None:
        """Close the metrics, and the dataset if episodes were recorded. Also for a run that was cut short."""
        self._metrics.close()
        if self._episode_recorder is not None:
            log.warning("%s", self._episode_recorder.close())

    def progress(self) -> Progress:
        """The progress of the run."""
        return self._progress(self._service.snapshot())

    # ---------------------------------------------------------------- inside

    def _tell_rollouts(self, rollouts: Sequence[AcceptedRollout]) -> bool:
        """Tell the callbacks, and record the episodes. Returns what `gathered` returns."""
        if self._callbacks.wants("on_rollouts"):
            progress = msgspec.structs.replace(self.progress(), rollouts=tuple(one.rollout for one in rollouts))
            self._callbacks.on_rollouts(progress)
            if self._callbacks.stop_reason is not None:
                return False
        if self._episode_recorder is not None:
            self._episode_recorder.add(rollouts)
        return True

    def _progress(self, snapshot: HubSnapshot) -> Progress:
        wall_s = self._wall_s(snapshot)
        lags = snapshot.lags or [0]
        return Progress(
            run=one_line(str(self._folder.path)),
            env_steps=self.env_steps,
            total_steps=self._config.steps,
            updates=self.version,
            wall_s=wall_s,
            steps_per_s=steps_per_second(self.env_steps - self._steps_before, wall_s - self._wall_before_s),
            return_mean=self._window.return_mean,
            length_mean=self._window.length_mean,
            facts=self._window.facts,
            lag_mean=sum(lags) / len(lags),
            lag_max=max(lags),
            workers_alive=self._workers_alive,
            workers_expected=self._service.workers_expected,
            ledger=snapshot.ledger.counts(),
            stages=self._stages(snapshot),
            note=self._evaluations.note,
            waiting=snapshot.waiting,
            settings=self._settings,
            evaluation=self._evaluations.newest,
            checkpoint=self._saved_to,
            requests=self._requests,
            **self._update,
        )

    def _took_to_save(self, seconds: float) -> None:
        """Remember the longest time, and say once if it is longer than the grace time."""
        grace_s = self._config.grace_s
        if grace_s and self.longest_save_s <= grace_s < seconds:
            log.warning("a checkpoint takes %.0f s, but --grace-s %g: a SIGTERM may lose work; allow more", seconds, grace_s)
        self.longest_save_s = max(self.longest_save_s, seconds)

    def _make_folder_again(self) -> None:
        """Make the run folder again if it was deleted or renamed. Raises `RunError` if that is not possible."""
        if self._folder.is_gone():
            self._saved = self._saved_env_steps = self._policy_env_steps = None
            self._saved_s = -math.inf  # so that a checkpoint is due now
            log.warning("%s", self._folder.make_again(self._config))
            self._evaluations.write_best()

    def _write_row(self, progress: Progress, metrics: Row) -> None:
        writes = self._folder.writes
        if self._metrics.gone:
            writes.write("folder", self._make_folder_again)
        self._metrics.write(progress, metrics)
        writes.write("metrics", self._metrics.flush)

    def _say_missing_facts(self) -> None:
        """Say once which facts no episode had: perhaps they are called otherwise."""
        self._said_missing = True
        if names := [name for name, fact in self._window.facts.items() if fact.mean is None]:
            last = "none of the last 100 episodes had it in the info of its last step"
            log.warning("info_keys %s: %s; is it called so?", ", ".join(names), last)

    def _write_state(self) -> None:
        """Write the policy and a checkpoint. Raises `RunError` if the disk refuses one of them; the other one is written."""
        self._make_folder_again()
        spec, state = self._spec, self._state().checkpoint_content(self._algorithm)
        try:
            self._folder.write_policy(spec.policy, spec.env, *self.weights(), facts=spec.facts, masked=spec.masked)
            self._policy_env_steps = self.env_steps
        finally:
            path = checkpoint.save(self._folder.path, state, self.env_steps, self._checkpoints.keep)
            self._saved_to = one_line(str(path))
            self._saved, self._saved_env_steps = self._position(), self.env_steps

    def _confirm_lock(self) -> None:
        if self._folder.lock is not None:
            self._folder.lock.confirm()

    def _tell_checkpoint(self) -> None:
        if self._callbacks.wants("on_checkpoint"):
            self._requests.closed = "expected it earlier than in on_checkpoint: the checkpoint would lack it"
            try:
                self._callbacks.on_checkpoint(self.progress())
            finally:
                self._requests.closed = ""

    def _position(self) -> tuple[int, int, list[float] | None, int]:
        """What of the state changes when the run goes on: version, next evaluation, best policy, set attributes."""
        return self.version, self._evaluations.next_at, self._evaluations.best, self._requests.attributes.changes

    def _write_logged(self) -> None:
        """Add what callbacks logged to the row of this update, if there was one."""
        if (logged := self._requests.take_logged()) and self.version:
            self._write_row(self.progress(), logged)

    def _evaluate(self) -> None:
        """Evaluate the newest policy, add the metrics to the row of its update, and tell the callbacks."""
        metrics = self._evaluations.evaluate_newest(self.version, self.env_steps)
        progress = self.progress()
        self._write_row(progress, metrics)
        self._service.report(progress)
        self._tell_evaluation(progress)

    def _tell_evaluation(self, progress: Progress) -> None:
        """Tell the callbacks, and add what they log to the row of the update that was evaluated."""
        try:
            self._callbacks.on_evaluation(progress)
        finally:
            self._write_logged()

    def _state(self) -> RunState:
        snapshot = self._service.snapshot()
        return RunState(
            version=self.version,
            env_steps=self.env_steps,
            wall_s=self._wall_s(snapshot),
            ledger=snapshot.ledger,
            incarnations=snapshot.incarnations,
            episodes=self._window.state(),
            facts=list(self._spec.facts),
            env_attributes=self._requests.attributes.state(self.version),
            best=self._evaluations.best,
            best_policy=self._evaluations.best_policy,
            newest_evaluation=self._evaluations.newest,
            evaluated_version=self._evaluations.version,
            next_evaluation=self._evaluations.next_at,
        )

    def _summary(self, reason: str, cut_short: bool) -> Summary:
        snapshot = self._service.snapshot()
        wall_s = self._wall_s(snapshot)
        return Summary(
            env=self._config.env,
            algo=self._config.algo,
            seed=self._config.seed,
            env_steps=self.env_steps,
            updates=self.version,
            wall_s=wall_s,
            env_steps_per_s=steps_per_second(self.env_steps, wall_s),
            stop_reason=reason,
            cut_short=cut_short,
            return_mean_100=self._window.return_mean,
            facts_100=self._window.facts,
            evaluation=self._evaluations.of_version(self.version),
            best=self._confirmed,
            ledger=snapshot.ledger.counts(),
            lags=self._service.lag_histogram(),
            first_use_s=self._service.first_use_s(),
            stages=self._stages(snapshot),
            versions=versions(),
        )

    def _stages(self, snapshot: HubSnapshot) -> dict[str, float]:
        """Seconds in each stage: of the learner, and of all workers together, from their last heartbeats."""
        stages = {"learner_wait": snapshot.wait_s} | {f"learner_{name}": s for name, s in self._stages_s.items()}
        stages |= {"learner_evaluate": snapshot.evaluate_s} if snapshot.evaluate_s else {}
        return stages | {f"worker_{name}": s for name, s in snapshot.worker_stages.items()}

    def _wall_s(self, snapshot: HubSnapshot) -> float:
        """Seconds of training: without evaluations."""
        return self._wall_before_s + time.monotonic() - self._started_s - snapshot.evaluate_s
