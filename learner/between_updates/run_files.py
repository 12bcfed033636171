"""Writes a run's files: rows of metrics, checkpoints, policies and the summary. Rewrites deleted files.

Rule: a checkpoint is written between two updates, never during one, and holds everything that the next update depends on.
If the disk is full, the run logs a warning and continues. At the end, the run fails if its last state can't be written.
"""

from __future__ import annotations

import logging
import math
import shlex
import time
from collections.abc import Callable

from millrace.learner.algorithms.algorithm import acting_weights
from millrace.learner.between_updates.evaluations import Evaluations
from millrace.learner.between_updates.run_parts import RunParts
from millrace.learner.run_folder import checkpoint
from millrace.learner.run_folder.env_attributes import EnvAttributes
from millrace.learner.run_folder.image_sample import image_samples
from millrace.learner.run_folder.last_line import complete, resume_command
from millrace.learner.run_folder.metrics_log import MetricsLog
from millrace.learner.run_folder.progress import Progress, Row, steps_per_second
from millrace.learner.run_folder.results import Summary
from millrace.learner.run_folder.run_format import versions
from millrace.learner.run_state import SavedRun
from millrace.protocol.bounds import one_line
from millrace.protocol.envs.found_names import found_by_others
from millrace.protocol.errors import RunError, first_line
from millrace.protocol.rollout import Batch

log = logging.getLogger("millrace.learner")


class RunFiles:
    """Writes the files of one run."""

    def __init__(self, run: RunParts, evaluations: Evaluations, attributes: EnvAttributes) -> None:
        """In a resumed run, remove the metrics of updates after its checkpoint. Raises `RunError` if this is impossible."""
        self._config, self._spec, self._folder, self._algorithm, self._hub, self._tally = run
        self._state = run.tally.state
        self._evaluations = evaluations
        self._attributes = attributes
        self.path = one_line(str(run.folder.shown))
        self.checkpoint = ""
        """Path of the newest checkpoint that this process has written; empty if there is none."""
        self.is_whole = True
        """Whether the algorithm is between two updates; False while it learns. Only a whole algorithm is saved."""
        self.longest_save_s = 0.0
        """The longest time, in seconds, that this process has taken to write a checkpoint."""
        self.on_saved: Callable[[], None] = lambda: None
        """Called after a checkpoint is written."""
        self._metrics = MetricsLog(run.folder.path, self._state.env_steps, self._state.version)
        self._schedule = checkpoint.CheckpointSchedule(run.config.checkpoint_every_s, time.monotonic())
        self._complete = False  # whether training has ended, and its results are written
        self._saved: tuple[object, ...] | None = None  # `_position` at the newest checkpoint
        self._saved_env_steps = self._policy_env_steps = self._state.env_steps if self._state.version else None

    def write_row(self, progress: Progress, metrics: Row) -> None:
        """Write a row of metrics, or add these metrics to the newest row if it belongs to the same update.

        Raises `RunTakenOver` if another process, which trains this run now, has replaced the file.
        """
        writes = self._folder.writes
        if self._metrics.gone:
            self._folder.confirm_lock()
            writes.write("folder", self._make_folder_again)
        self._metrics.write(progress, metrics)
        writes.write("metrics", self._metrics.flush)

    def write_images(self, batch: Batch) -> None:
        """After the first update, write some of its batch's observations as pictures."""
        if self._state.version == 1:
            images = image_samples(batch.obs, self._spec.policy.seen)
            self._folder.writes.write("images", lambda: self._folder.write_images(images))

    def save(self) -> None:
        """Write a checkpoint and the policy. Raises `RunTakenOver` if another process trains this run now."""
        self._folder.confirm_lock()
        began_s = time.monotonic()
        self._folder.writes.write("state", self._write_state)
        self._schedule.saved(began_s)
        took_s = time.monotonic() - began_s
        grace_s = self._config.grace_s
        if grace_s and self.longest_save_s <= grace_s < took_s:  # warns only once
            log.warning("a checkpoint takes %.0f s, but --grace-s %g: a SIGTERM may lose work; allow more", took_s, grace_s)
        self.longest_save_s = max(self.longest_save_s, took_s)
        if self._saved == self._position():
            self.on_saved()

    def save_if_due(self) -> None:
        """Write a checkpoint and the policy if one is due."""
        if self._schedule.is_due(self._state.version, time.monotonic()):
            self.save()

    def save_unless_saved(self) -> None:
        """Write a checkpoint and the policy, unless the newest checkpoint already has this state."""
        if self._saved != self._position():
            self.save()

    def save_after_error(self, error: BaseException) -> None:
        """Like `save_unless_saved` and `confirm_saved`, but only logs callbacks' errors, because `error` has ended the run.

        If the state can't be written, raises `RunError` only if `error` isn't a failure (but, for example, Ctrl-C). Writes
        nothing if an update was neither completed nor undone.
        """
        if not self.is_whole:
            log.warning("update %d was neither completed nor undone, so nothing more is saved", self._state.version + 1)
            return
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

    def confirm_saved(self) -> None:
        """Retry failed writes for a while, because this is the last save. Raises `RunError` if they still fail.

        Raises `RunTakenOver` if another process trains this run now.
        """
        self._folder.confirm_lock()
        before = self._saved
        self._folder.writes.confirm()
        if self._saved != before:
            self.on_saved()

    def write_summary(self, reason: str, *, cut_short: bool) -> None:
        """Write the run's results, and why it ended. Unless `cut_short`, raises `RunError` if this is impossible."""
        self._folder.writes.write("summary", lambda: self._folder.write_summary(self._summary(reason, cut_short)))
        if not cut_short:
            self._folder.writes.confirm()
            self._complete = True

    def continues(self) -> str:
        """One line that says where a resumed run continues, and how many updates are lost."""
        state = self._state
        lost = self._metrics.removed
        line = f"run {self._folder.shown} continues at {state.env_steps:,} env steps, after update {state.version:,}"
        if lost:
            line += f"; {lost:,} later update{'s were' if lost > 1 else ' was'} not saved, and must be made again"
        return line

    def saved(self) -> str:
        """One line that says how much is saved, and how to resume the run unless it is complete; empty if nothing has been
        learned yet.

        A run whose environment was passed as a function can continue only in Python.
        """
        if not self._state.version:
            return ""
        folder = self._folder.shown
        if self._complete:
            return complete(folder)
        if self._saved_env_steps is None:
            return f"no checkpoint could be written to {shlex.quote(str(folder))}"
        newest = f"{self._saved_env_steps:,} env steps are saved"
        if self._policy_env_steps not in (None, self._saved_env_steps):
            newest += f", and the policy of {self._policy_env_steps:,}"
        env = self._spec.env
        if env.factory is not None and not found_by_others(env.id):
            return f"{newest}; continue in Python with: millrace.train(ENV, resume={str(folder)!r})"
        return f"{newest}; continue with: {resume_command(folder)}"

    def close(self) -> None:
        """Close the metrics file. Call this even if the run was cut short."""
        self._metrics.close()

    # ---------------------------------------------------------------- inside

    def _make_folder_again(self) -> None:
        """Recreate the run folder if it was deleted or renamed. Raises `RunError` if this is impossible."""
        if self._folder.is_gone():
            self._saved = self._saved_env_steps = self._policy_env_steps = None
            self._schedule.saved(-math.inf)  # makes a checkpoint due now
            log.warning("%s", self._folder.make_again(self._config))
            self._evaluations.write_best()

    def _write_state(self) -> None:
        """Write the policy and a checkpoint. If one of them can't be written, writes the other and raises `RunError`."""
        self._make_folder_again()
        self._folder.writes.write("metrics", self._metrics.sync)  # a resumed run doesn't write these rows again
        spec = self._spec
        env_steps = self._state.env_steps
        times = self._hub.stage_times()
        content = SavedRun(
            state=self._state,
            rollouts=self._hub.past(self._state.version),
            wall_s=self._tally.wall_s(times),
            stages=self._tally.stages(times),
            episodes=self._tally.window.state(),
            facts=list(spec.facts),
            env_attributes=self._attributes.state(self._state.version),
            opponent_policies=self._hub.opponent_policies(),
        ).checkpoint_content(self._algorithm)
        try:
            self._folder.write_policy(spec, *acting_weights(self._algorithm, spec.policy))
            self._policy_env_steps = env_steps
        finally:
            path = checkpoint.save(self._folder.path, content, env_steps, self._config.keep_checkpoints)
            self.checkpoint = one_line(str(path))
            self._saved = self._position()
            self._saved_env_steps = env_steps

    def _position(self) -> tuple[object, ...]:
        """A value that changes when there is something new to save: an update, an evaluation or a new attribute value."""
        state = self._state
        return state.version, state.next_evaluation, state.evaluated, state.best, self._attributes.changes

    def _summary(self, reason: str, cut_short: bool) -> Summary:
        config = self._config
        state = self._state
        tally = self._tally
        times = self._hub.stage_times()
        wall_s = tally.wall_s(times)
        return Summary(
            env=config.env,
            algo=config.algo,
            seed=config.seed,
            env_steps=state.env_steps,
            updates=state.version,
            wall_s=wall_s,
            env_steps_per_s=steps_per_second(state.env_steps, wall_s),
            stop_reason=reason,
            cut_short=cut_short,
            return_mean_100=tally.window.return_mean,
            facts_100=tally.window.facts,
            evaluation=self._evaluations.to_report(),
            ended_by=self._evaluations.ended_by,
            best=self._evaluations.confirmed,
            ledger=self._hub.coordinator.rollouts.ledger.counts(),
            lags=self._hub.lag_statistics.histogram(),
            first_use_s=self._hub.lag_statistics.first_use_s(),
            stages=tally.stages(times),
            versions=versions(),
        )
