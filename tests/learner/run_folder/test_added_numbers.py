"""Numbers that are added to a row of metrics: the row is one row."""

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
