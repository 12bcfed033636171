"""Run folders as a run leaves them, made without one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.metrics_log import MetricsLog
from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_folder.progress_file import ProgressFile
from millrace.learner.run_folder.results import Evaluation, Summary
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.progress import RunProgress

LEDGER = {"issued": 30, "used": 20, "outstanding": 4, "lost": 6, "transitions_received": 900,
          "transitions_used": 800, "transitions_waiting": 50, "transitions_late": 50, "messages_bad": 0}  # fmt: skip
STAGES = {"learner_wait": 1.0, "learner_update": 3.0, "worker_step": 2.0, "worker_wait": 2.0}


LAST_SIGN_S = 1_800_000_000.0


def write_progress(run: Path, progress: RunProgress) -> None:
    """The progress.json of a run, written at `LAST_SIGN_S`."""
    ProgressFile(run).write(lambda: progress, LAST_SIGN_S)


def a_run(
    folder: Path, env: str = "CartPole-v1", seed: int = 1, finished: bool = True, length: int = 20, **settings: Any
) -> Path:
    """A run folder.

    `ledger` among the keywords is what the metrics and the summary tell of it; `failure` is the error that ended it. The
    others are settings.
    """
    ledger, failure = settings.pop("ledger", LEDGER), settings.pop("failure", "")
    run = RunFolder.create(resolve(env, run_dir=str(folder), seed=seed, **settings))
    log = MetricsLog(run.path)
    for i in range(1, length + 1):
        mean = None if i == 1 else 5.0 * i + seed
        progress = Progress(
            env_steps=100 * i,
            total_steps=100_000,
            updates=i,
            wall_s=2.0 * i,
            steps_per_s=50.0,
            return_mean=mean,
            ledger=ledger,
            stages=STAGES,
        )
        log.write(progress, {"eval/mean_reward": 77.0} if i == 10 else {})
    log.close()
    write_progress(run.path, progress.plain())
    if finished:
        evaluation = None
        if not failure:
            evaluation = Evaluation(episodes=100, return_mean=-1234.56 + seed, return_std=7.5, length_mean=9.0)
        run.write_summary(
            Summary(
                env=env, algo="ppo", seed=seed, env_steps=123_456, updates=789, wall_s=61.0, env_steps_per_s=4321.0,
                stop_reason=failure or "all steps done", cut_short=bool(failure),
                return_mean_100=99.5, evaluation=evaluation, ledger=ledger, stages=STAGES,
            )
        )  # fmt: skip
    return run.path
