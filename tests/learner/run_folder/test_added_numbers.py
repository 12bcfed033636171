"""Numbers that are added to a row of metrics: the row is one row, and TensorBoard gets each number once."""

from __future__ import annotations

from pathlib import Path

import pytest

from millrace.learner.run_folder import metrics_log
from millrace.learner.run_folder.metrics_log import MetricsLog, read_rows
from millrace.learner.run_folder.progress import Progress, Row


def test_numbers_that_are_added_to_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[Row] = []

    def keep(row: Row, env_steps: int) -> bytes:
        events.append(row)
        return b""

    monkeypatch.setattr(metrics_log, "_event", keep)
    now = [0.0]
    log = MetricsLog(tmp_path, clock=lambda: now[0])
    log.write(Progress(updates=1, env_steps=10, return_mean=2.0), {"loss": 0.5})
    log.write(Progress(updates=1, env_steps=10, return_mean=2.0), {"eval/mean_reward": 3.0})
    log.write(Progress(updates=2, env_steps=20, return_mean=4.0), {"loss": 0.25})
    log.write(Progress(updates=2, env_steps=20, return_mean=4.0), {"custom/mine": 1.0})
    log.close()
    found = read_rows(tmp_path / "metrics.jsonl")
    assert [row["time/iterations"] for row in found] == [1, 2]
    assert (found[0]["train/loss"], found[0]["eval/mean_reward"], found[1]["custom/mine"]) == (0.5, 3.0, 1.0)
    assert events[1] == {"eval/mean_reward": 3.0}, "the rest of the row was sent"
    assert (events[2]["train/loss"], events[2]["custom/mine"]) == (0.25, 1.0), "the whole row at once"
    assert len(events) == 3
