"""Numbers that are added to a row of metrics: the row is one row, unless it would lose the evaluation of another policy."""

from __future__ import annotations

from pathlib import Path

from millrace.learner.run_folder.metrics_log import MetricsLog, read_rows
from millrace.learner.run_folder.progress import Progress


def test_numbers_that_are_added_to_a_row(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path)
    log.write(Progress(updates=1, env_steps=10, return_mean=2.0), {"loss": 0.5})
    log.write(Progress(updates=1, env_steps=10, return_mean=2.0), {"eval/mean_reward": 3.0})
    log.write(Progress(updates=2, env_steps=20, return_mean=4.0), {"loss": 0.25})
    log.write(Progress(updates=2, env_steps=20, return_mean=4.0), {"custom/mine": 1.0})
    log.close()
    found = read_rows(tmp_path / "metrics.jsonl")
    assert [row["time/iterations"] for row in found] == [1, 2]
    assert (found[0]["train/loss"], found[0]["eval/mean_reward"]) == (0.5, 3.0)
    assert (found[1]["train/loss"], found[1]["custom/mine"]) == (0.25, 1.0)


def update(steps: int) -> Progress:
    return Progress(updates=steps // 10, env_steps=steps)


def evaluations(folder: Path) -> list[tuple[float | None, ...]]:
    names = ("time/total_timesteps", "train/loss", "eval/env_steps", "eval/mean_reward", "eval/score", "custom/mine")
    return [tuple(row.get(name) for name in names) for row in read_rows(folder / "metrics.jsonl")]


def test_evaluations_of_two_policies_after_the_same_update_have_a_row_each(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path)
    log.write(update(10), {"loss": 0.5})
    log.write(update(20), {"loss": 0.25})
    log.write(update(20), {"eval/mean_reward": 3.0, "eval/env_steps": 10, "eval/score": 0.5})
    log.write(update(20), {"eval/mean_reward": 4.0})
    log.write(update(20), {"eval/mean_reward": 4.5})  # the evaluation of the same policy, made again
    log.write(update(20), {"custom/mine": 1.0})
    log.write(update(30), {"loss": 0.125})
    log.close()
    assert evaluations(tmp_path) == [
        (10, 0.5, None, None, None, None),
        (20, 0.25, 10, 3.0, 0.5, None),
        (20, 0.25, None, 4.5, None, 1.0),
        (30, 0.125, None, None, None, None),
    ]
