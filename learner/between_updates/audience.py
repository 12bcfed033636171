"""Reports a run's progress to its callbacks (the terminal is one of them), to `millrace status` and to Prometheus.

Rule: values are counted, and written to a metrics row, before they are reported. Values that callbacks log are added to the
newest update's row, even if one of the callbacks raises. `on_checkpoint` is called after a checkpoint is written. Callbacks
can't set attributes of env copies in it, because the checkpoint would lack them.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from millrace.learner.between_updates.run_files import RunFiles
from millrace.learner.between_updates.run_parts import RunParts
from millrace.learner.callbacks.callbacks import Callbacks
from millrace.learner.rollouts.rollout_dealer import AcceptedRollout
from millrace.learner.run_folder.callback_requests import Requests
from millrace.learner.run_folder.progress import Progress, Row, named, steps_per_second
from millrace.protocol.arrays import Array
from millrace.protocol.logs.notices import log_notice

log = logging.getLogger("millrace.learner")

SHOW_EVERY_S = 0.2  # shortest interval at which progress between two updates is shown


class Audience:
    """Reports one run to everything that watches it."""

    def __init__(self, run: RunParts, callbacks: Callbacks, files: RunFiles, requests: Requests) -> None:
        """`requests` are the requests that callbacks make."""
        self._config = run.config
        self._hub = run.hub
        self._tally = run.tally
        self._state = run.tally.state
        self._callbacks = callbacks
        self._files = files
        self._requests = requests
        self._settings = msgspec.to_builtins(run.config)
        self._update: dict[str, Any] = {}  # fields of `Progress` about the last update
        self._workers_alive = 0
        self._shown_s = 0.0
        self._said_missing = False  # whether the first episodes were checked for missing facts
        self._finished = False
        files.on_saved = self.checkpoint_written

    def start(self) -> None:
        """Tell callbacks that the run begins, or is resumed, and that workers have joined."""
        self._workers_alive = self._hub.workers_alive()
        self._callbacks.on_start(self.progress())

    def cloned(self, metrics: Mapping[str, float]) -> None:
        """Report that the policy was cloned, with these metrics."""
        found = ", ".join(f"{name.rpartition('/')[2].replace('_', ' ')} {number:.3g}" for name, number in metrics.items())
        log_notice(log, f"cloned {self._config.prior} in {self._config.algorithm.clone_epochs} epochs: {found}")
        self._update = {"metrics": named(metrics)}
        self._files.write_row(self.progress(), metrics)

    def show_now(self) -> None:
        """Show how far an evaluation has got, or what a long wait is for, unless this was shown a moment ago."""
        now = time.monotonic()
        if now - self._shown_s >= SHOW_EVERY_S:
            self._shown_s = now
            self._workers_alive = self._hub.workers_alive()
            progress = self.progress(self._hub.coordinator.collected())
            self._hub.report_progress(progress)
            self._callbacks.meanwhile(progress)

    def gathered(self, rollouts: Sequence[AcceptedRollout]) -> bool:
        """Report that these rollouts have arrived. Returns False if a callback ended the run, so no update may use them."""
        began_s = time.monotonic()
        if self._callbacks.wants("on_rollouts"):
            progress = msgspec.structs.replace(
                self.progress(),
                rollouts=tuple(one.rollout for one in rollouts),
                incarnations=tuple(one.incarnation for one in rollouts),
                fresh=tuple(one.fresh for one in rollouts),
            )
            if not self._callbacks.on_rollouts(progress):
                return False
        self._tally.gathered_s = time.monotonic() - began_s
        return True

    def updated(self, metrics: Mapping[str, float]) -> None:
        """Report the last update that was counted and published."""
        self._say_missing_facts()
        self._workers_alive = self._hub.workers_alive()
        self._update = {"metrics": named(metrics), "lags": tuple(self._hub.lags)}
        progress = self.progress()
        self._write_row(progress, metrics)
        try:
            self._callbacks.on_update(progress)
        finally:
            self._write_logged()

    def evaluated(self, metrics: Row | None = None) -> None:
        """Report an evaluation. Without `metrics`, only what callbacks log is added to the update's row."""
        progress = self.progress()
        if metrics is not None:
            self._write_row(progress, metrics)
        try:
            self._callbacks.on_evaluation(progress)
        finally:
            self._write_logged()

    def checkpoint_written(self) -> None:
        """Report that a checkpoint was written."""
        if self._callbacks.wants("on_checkpoint"):
            self._requests.closed = "expected it earlier than in on_checkpoint: the checkpoint would lack it"
            try:
                self._callbacks.on_checkpoint(self.progress())
            finally:
                self._requests.closed = ""

    def finish(self, reason: str, *, cut_short: bool = False) -> None:
        """Report the end of the run, and write its summary. Does nothing when called again.

        `cut_short` is True if an error or an interrupt ended the run. If it is False and the summary cannot be written,
        raises `RunError`.
        """
        if not self._finished:
            self._files.write_summary(reason, cut_short=cut_short)
            self.leave(reason, cut_short=cut_short)

    def leave(self, reason: str, *, cut_short: bool = True) -> None:
        """Report the end of the run in this process. Write no summary, because another process may continue the run."""
        self._finished = True
        self._requests.closed = "the run has ended"
        self._callbacks.on_end(msgspec.structs.replace(self.progress(), stop_reason=reason, cut_short=cut_short))

    def env_attributes(self) -> Array | None:
        """The attributes that callbacks have set on env copies, to be sent with the newest weights."""
        return self._requests.attributes.table(self._state.version)

    def progress(self, collected: int = 0) -> Progress:
        """The run's progress now. `collected` is the number of env steps already collected for the next update."""
        state = self._state
        tally = self._tally
        hub = self._hub
        times = hub.stage_times()
        wall_s = tally.wall_s(times)
        lags = hub.lags or [0]
        return Progress(
            at_s=time.time(),
            run=self._files.path,
            env_steps=state.env_steps,
            collected=collected,
            total_steps=self._config.steps,
            updates=state.version,
            wall_s=wall_s,
            steps_per_s=steps_per_second(state.env_steps + collected - tally.steps_before, wall_s - tally.wall_before_s),
            return_mean=tally.window.return_mean,
            length_mean=tally.window.length_mean,
            facts=tally.window.facts,
            lag_mean=sum(lags) / len(lags),
            lag_max=max(lags),
            workers_alive=self._workers_alive,
            workers_expected=hub.workers_expected,
            ledger=hub.coordinator.rollouts.ledger.counts(),
            stages=tally.stages(times),
            note=tally.note,
            waiting=hub.waiting(times.at_s),
            settings=self._settings,
            episodes=tally.new_episodes,
            evaluation=state.newest_evaluation,
            evaluated=state.evaluated,
            best=state.best,
            checkpoint=self._files.checkpoint,
            requests=self._requests,
            **self._update,
        )

    # ---------------------------------------------------------------- inside

    def _write_row(self, progress: Progress, metrics: Row) -> None:
        self._files.write_row(progress, metrics)
        self._hub.report_progress(progress)

    def _write_logged(self) -> None:
        """Add what callbacks logged to this update's row. Before the first update, there is no row."""
        if (logged := self._requests.take_logged()) and self._state.version:
            self._files.write_row(self.progress(), logged)

    def _say_missing_facts(self) -> None:
        """Warn once about facts that no episode reported, because the user may have misspelled their names."""
        window = self._tally.window
        if window.full and not self._said_missing:
            self._said_missing = True
            if names := [name for name, fact in window.facts.items() if fact.mean is None]:
                last = "none of the last 100 episodes had it in the info of its last step"
                log.warning("info_keys %s: %s; is the name right?", ", ".join(names), last)
