"""What a run writes while it goes on: metrics, checkpoints, the policy, the summary; and what a resumed run reads back.

The law: a checkpoint is written between two updates, never within one, and holds everything that the next update depends
on. A disk that is full costs a warning, never the run.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec

from learner.algorithms import Algorithm
from learner.config.config import Config
from learner.evaluate import evaluate
from learner.recording.record import TrainingRecorder
from learner.rollouts.arrived_rollout import ArrivedRollout
from learner.rollouts.hub import Hub, HubSnapshot
from learner.rollouts.ledger import Ledger
from learner.run_folder import checkpoint
from learner.run_folder.episode_window import EpisodeWindow
from learner.run_folder.metrics_log import MetricsLog
from learner.run_folder.progress import Progress
from learner.run_folder.results import Best, Evaluation, Summary
from learner.run_folder.run_folder import RunFolder
from learner.run_folder.versions import versions
from protocol.arrays import Floats
from protocol.errors import CheckpointError, RunError, UsageError
from protocol.policy.policy import make_policy
from protocol.rollout import Batch
from protocol.specs import RunSpec

log = logging.getLogger("millrace.learner")


EVALUATION_SEED, CONFIRMATION_SEED = 1_000_000, 2_000_000  # far from the seeds of training, and from each other


class Past(msgspec.Struct, kw_only=True):
    """Where a run stands: zero at its start, from a checkpoint when it is resumed."""

    version: int = 0
    env_steps: int = 0
    wall_s: float = 0.0
    ledger: Ledger = msgspec.field(default_factory=Ledger)
    incarnations: list[int] = []
    episodes: list[Any] = []
    best: list[float] | None = None
    """mean return and env steps of the best evaluation; its policy lies in the run folder"""


def recall(folder: RunFolder, algorithm: Algorithm) -> Past:
    """Load the newest whole checkpoint into the algorithm. Raises `CheckpointError` when there is none."""
    found, warnings = checkpoint.newest(folder.path)
    for line in warnings:
        log.warning("%s", line)
    try:
        past = msgspec.convert(found.state["past"], Past)
        algorithm.load_state_dict(found.state["algorithm"])
    except (KeyError, ValueError, TypeError, RuntimeError) as error:
        raise CheckpointError(
            f"checkpoint {found.path}: expected the state of this configuration, got another ({error}); "
            "resume it with the settings it was made with"
        ) from error
    # The tickets that were outstanding died with the learner that dealt them, and so did the rollouts not yet used.
    past.ledger.lost += past.ledger.outstanding
    past.ledger.transitions_late += past.ledger.transitions_waiting
    return past


class Journal:
    """The written side of one run."""

    def __init__(
        self,
        config: Config,
        folder: RunFolder,
        spec: RunSpec,
        algorithm: Algorithm,
        hub: Hub,
        past: Past,
        watch: Callable[[Progress], None],
    ) -> None:
        self.config, self.folder, self.spec = config, folder, spec
        self.algorithm, self.hub = algorithm, hub
        self.version, self.env_steps = past.version, past.env_steps
        self.evaluation: Evaluation | None = None
        self.stages = {"update": 0.0, "other": 0.0}
        self.workers_expected = 0
        """how many workers there should be; 0: any number"""
        self._window = EpisodeWindow.from_state(past.episodes)
        self._metrics = MetricsLog(folder.path, past.env_steps)
        self._watch = watch
        self._wall_before_s, self._steps_before = past.wall_s, past.env_steps
        self._began_s = self._saved_s = time.monotonic()
        self._evaluated_version = -1
        self._evaluate_at = past.env_steps + config.eval_every
        self._note = ""
        self._confirmed: Best | None = None
        self._recorder: TrainingRecorder | None = None
        if config.record:
            about = f"All whole training episodes of millrace run {folder.path.resolve().name}, as acted."
            self._recorder = TrainingRecorder(config.record, spec.env, spec.policy, about)
        self._workers_alive = 0
        self._best = past.best
        self._episodes_until_save = config.checkpoint_every_episodes
        self._worker_stages: dict[int, Mapping[str, float]] = {}  # by session: those of workers that have left count too
        hub.report_progress(self.progress())

    # ---------------------------------------------------------------- what the loop calls

    def stop_reason(self) -> str | None:
        """Why the run should end now, or None."""
        target, evaluation = self.config.target_return, self.evaluation
        if target is not None and evaluation is not None and evaluation.return_mean >= target:
            return f"target return {target:g} reached"
        target = self.config.target_mean_return
        if target is not None and self._window.full and (self._window.return_mean or 0.0) >= target:
            return f"mean return {target:g} of the last episodes reached"
        one_more = self.spec.rollout_steps * self.config.envs
        enough = self.version > 0 and self.env_steps + one_more > self.config.steps
        return "all steps done" if enough else None

    def gathered(self, rollouts: Sequence[ArrivedRollout]) -> None:
        """Rollouts that are about to be learned from: keep their episodes, if they are to be recorded."""
        if self._recorder is not None:
            self._recorder.add(rollouts)

    def updated(self, batch: Batch, metrics: Mapping[str, float], update_s: float) -> None:
        """An update was made and published: count, write, and now and then evaluate and checkpoint."""
        began_s = time.monotonic()
        self.version += 1
        self.env_steps += batch.env_steps
        self._workers_alive = self.hub.workers_alive()
        self.stages["update"] += update_s
        self._window.extend(batch.episodes)
        extra: dict[str, float] = {}
        if self.config.eval_every and self.env_steps >= self._evaluate_at:
            self._evaluate_at += self.config.eval_every
            found = self.evaluate()
            extra = found.metrics()
            self._keep_if_best(found)
        progress = self.progress()
        self._surely(lambda: self._metrics.write(progress, {**metrics, **extra}))
        self.hub.report_progress(progress)
        self._watch(progress)
        self._episodes_until_save -= len(batch.episodes)
        every = self.config.checkpoint_every_updates
        by_episodes = self.config.checkpoint_every_episodes and self._episodes_until_save <= 0
        if by_episodes or (every and self.version % every == 0) or began_s - self._saved_s > self.config.checkpoint_every_s:
            self.save()
        self.stages["other"] += time.monotonic() - began_s

    def evaluate(self) -> Evaluation:
        """Greedy episodes of the newest policy; the workers are answered meanwhile."""
        if self.evaluation is None or self._evaluated_version != self.version:
            self.evaluation = self._evaluated(*self.algorithm.weights(), EVALUATION_SEED)
            self._evaluated_version = self.version
            self._note = f"{self.env_steps:,} env steps: greedy {self.evaluation}"
        return self.evaluation

    def save(self) -> None:
        """A checkpoint and the policy; a disk that does not take them costs a warning."""
        snapshot = self.hub.snapshot()
        past = Past(
            version=self.version,
            env_steps=self.env_steps,
            wall_s=self._wall_s(),
            ledger=snapshot.ledger,
            incarnations=snapshot.incarnations,
            episodes=self._window.state(),
            best=self._best,
        )
        state = {"past": msgspec.to_builtins(past), "algorithm": self.algorithm.state_dict()}
        self._saved_s = time.monotonic()
        self._episodes_until_save = self.config.checkpoint_every_episodes
        keep = self.config.keep_checkpoints
        self._surely(lambda: checkpoint.save(self.folder.path, state, self.env_steps, keep))
        self._surely(self._write_policy)

    def conclude(self) -> None:
        """Evaluate the final policy, and once more the best one, on episodes that it was not chosen by."""
        found = self.evaluate()
        if self.config.eval_every:
            self._keep_if_best(found)
        if self._best is not None:
            chosen_by, env_steps = self._best
            try:
                _, parameters, buffers = self.folder.read_policy("best")
            except UsageError as error:  # the disk did not take it
                log.warning("%s", error)
                return
            again = self._evaluated(parameters, buffers, CONFIRMATION_SEED)
            self._confirmed = Best(env_steps=int(env_steps), chosen_by=chosen_by, evaluation=again)

    def finish(self, reason: str) -> None:
        """The summary."""
        wall_s, snapshot = self._wall_s(), self.hub.snapshot()
        self._surely(
            lambda: self.folder.write_summary(
                Summary(
                    env=self.config.env,
                    algo=self.config.algo,
                    seed=self.config.seed,
                    env_steps=self.env_steps,
                    updates=self.version,
                    wall_s=wall_s,
                    env_steps_per_s=self.env_steps / wall_s if wall_s else 0.0,
                    stop_reason=reason,
                    return_mean_100=self._window.return_mean,
                    evaluation=self.evaluation if self._evaluated_version == self.version else None,
                    best=self._confirmed,
                    ledger=snapshot.ledger.counts(),
                    lags=self.hub.lag_histogram(),
                    first_use_s=self.hub.first_use_s(),
                    stages=self._stages(snapshot),
                    versions=versions(),
                )
            )
        )
        self._watch(self.progress())

    def close(self) -> None:
        """Close the files, and the dataset if episodes were recorded: also when the run was cut short."""
        self._metrics.close()
        if self._recorder is not None:
            log.warning("%s", self._recorder.close())

    def progress(self) -> Progress:
        """How far the run is."""
        wall_s, snapshot = self._wall_s(), self.hub.snapshot()
        here_s = wall_s - self._wall_before_s
        lags = snapshot.lags or [0]
        return Progress(
            run=str(self.folder.path),
            env_steps=self.env_steps,
            total_steps=self.config.steps,
            updates=self.version,
            wall_s=wall_s,
            steps_per_s=(self.env_steps - self._steps_before) / here_s if here_s else 0.0,
            return_mean=self._window.return_mean,
            length_mean=self._window.length_mean,
            lag_mean=sum(lags) / len(lags),
            lag_max=max(lags),
            workers_alive=self._workers_alive,
            workers_expected=self.workers_expected,
            ledger=snapshot.ledger.counts(),
            stages=self._stages(snapshot),
            note=self._note,
        )

    # ---------------------------------------------------------------- inside

    def _stages(self, snapshot: HubSnapshot) -> dict[str, float]:
        """Seconds: of the learner, and of all workers together (as their last heartbeats told)."""
        stages = {"learner_wait": snapshot.wait_s} | {f"learner_{name}": s for name, s in self.stages.items()}
        self._worker_stages |= snapshot.worker_stages()
        for told in self._worker_stages.values():
            for name, seconds in told.items():
                stages[f"worker_{name}"] = stages.get(f"worker_{name}", 0.0) + seconds
        return stages

    def _evaluated(self, parameters: Floats, buffers: Floats, seed: int) -> Evaluation:
        policy = make_policy(self.spec.policy)
        policy.load(parameters, buffers)
        episodes, env = self.config.eval_episodes, self.spec.env
        return evaluate(env, policy, self.spec.policy, episodes, seed + self.config.seed, self.hub.pulse)

    def _keep_if_best(self, found: Evaluation) -> None:
        """The first of equals stays: it needed the fewest steps."""
        if self._best is None or found.return_mean > self._best[0]:
            weights = self.algorithm.weights()
            self._best = [found.return_mean, self.env_steps]
            self._surely(lambda: self.folder.write_policy(self.spec.policy, self.spec.env, *weights, which="best"))

    def _write_policy(self) -> None:
        self.folder.write_policy(self.spec.policy, self.spec.env, *self.algorithm.weights())

    def _wall_s(self) -> float:
        return self._wall_before_s + time.monotonic() - self._began_s

    def _surely(self, write: Callable[[], object]) -> None:
        try:
            write()
        except RunError as error:
            log.warning("%s", error)
