"""A metrics.jsonl is read on from where it was read last, and what is kept of it is bounded."""

import json
import os
import tracemalloc
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from millrace.extras.monitoring.report.metrics_tail import MetricsTail
from millrace.learner.run_folder.metrics_log import METRICS_FILE, MOST_LINE_BYTES, MetricsLog, read_rows
from millrace.learner.run_folder.progress import ENV_STEPS_KEY, Progress


def write(run: Path, numbers: range, mode: str = "a", evaluated: tuple[int, ...] = ()) -> None:
    lines = [{ENV_STEPS_KEY: i} | ({"eval/mean_reward": 1.0} if i in evaluated else {}) for i in numbers]
    with (run / METRICS_FILE).open(mode) as file:
        file.writelines(json.dumps(line) + "\n" for line in lines)


def steps(tail: MetricsTail) -> list[int]:
    return [row[ENV_STEPS_KEY] for row in tail.rows]


def test_what_was_added_is_read_and_nothing_twice(tmp_path: Path) -> None:
    tail = MetricsTail(tmp_path)
    for first, last in ((1, 1), (2, 2), (3, 5), (6, 9)):
        write(tmp_path, range(first, last + 1))
        assert tail.read()
        assert steps(tail) == [*range(1, last + 1)]
        assert not tail.read()


def test_a_line_that_is_being_written_is_read_once_it_is_whole(tmp_path: Path) -> None:
    write(tmp_path, range(1, 3))
    tail = MetricsTail(tmp_path)
    with (tmp_path / METRICS_FILE).open("a") as file:
        file.write('{"time/total_timesteps": 3')
        file.flush()
        tail.read()
        assert steps(tail) == [1, 2]
        file.write("}\n")
    tail.read()
    assert steps(tail) == [1, 2, 3]


def test_the_newest_row_may_change(tmp_path: Path) -> None:
    log, tail = MetricsLog(tmp_path), MetricsTail(tmp_path)
    log.write(Progress(env_steps=8, updates=1), {})
    log.flush()
    tail.read()
    log.write(Progress(env_steps=8, updates=1), {"eval/mean_reward": 5.0})
    log.write(Progress(env_steps=16, updates=2), {})
    log.close()
    tail.read()
    assert tail.rows == read_rows(tmp_path / METRICS_FILE)
    assert tail.rows[0]["eval/mean_reward"] == 5.0


def test_a_file_that_was_replaced_or_cut_is_read_from_its_beginning(tmp_path: Path) -> None:
    write(tmp_path, range(1, 9))
    tail = MetricsTail(tmp_path)
    tail.read()
    other = tmp_path / "other"
    other.mkdir()
    write(other, range(100, 120))
    os.replace(other / METRICS_FILE, tmp_path / METRICS_FILE)
    tail.read()
    assert steps(tail) == [*range(100, 120)]
    write(tmp_path, range(1, 4), "w")
    tail.read()
    assert steps(tail) == [1, 2, 3]


@pytest.mark.parametrize("at_once", [True, False])
def test_of_many_rows_a_bounded_number_is_kept_at_equal_distances(tmp_path: Path, at_once: bool) -> None:
    tail, evaluated = MetricsTail(tmp_path, most=10), (3, 77, 501)
    for part in [range(1000)] if at_once else [range(i, i + 50) for i in range(0, 1000, 50)]:
        write(tmp_path, part, evaluated=evaluated)
        tail.read()
    kept = [i for i in steps(tail) if i not in (*evaluated, 999)]
    assert 10 <= len(kept) <= 20
    assert {b - a for a, b in pairwise(kept)} == {64}
    assert {*evaluated, 999} <= {*steps(tail)}


def test_all_evaluations_are_known_however_many_there_are(tmp_path: Path) -> None:
    """The best one may not be among the rows that are kept."""
    tail = MetricsTail(tmp_path, most=10)
    for part in (range(600), range(600, 1000)):
        rows = [{ENV_STEPS_KEY: i, "eval/mean_reward": float(i == 502), "eval/mean_ep_length": 7.0} for i in part]
        rows[-1] |= {"eval/env_steps": part[-1] - 5}
        with (tmp_path / METRICS_FILE).open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in [*rows, {ENV_STEPS_KEY: part[-1]}])
        tail.read()
    found = tail.evaluations
    assert found.shape == (1000, 3)
    assert found[found[:, 1].argmax()].tolist() == [502, 1, 7]
    assert found[[599, 999], 0].tolist() == [594, 994]


def test_the_newest_evaluation_counts_once_even_if_its_row_changes(tmp_path: Path) -> None:
    tail = MetricsTail(tmp_path)
    write(tmp_path, range(1, 3), evaluated=(2,))
    tail.read()
    assert tail.evaluations[:, 0].tolist() == [2]
    assert np.isnan(tail.evaluations[0, 2])
    write(tmp_path, range(3, 4), evaluated=(3,))
    tail.read()
    assert tail.evaluations[:, 0].tolist() == [2, 3]


def test_a_file_that_is_no_table_is_refused_before_it_fills_the_memory(tmp_path: Path) -> None:
    path = tmp_path / METRICS_FILE
    path.write_bytes(b"x" * (MOST_LINE_BYTES + 1))
    with pytest.raises(OSError, match="a row has more than"):
        MetricsTail(tmp_path).read()
    os.truncate(path, 1 << 40)  # a hole takes no room
    with pytest.raises(OSError, match="expected at most"):
        MetricsTail(tmp_path).read()
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(OSError, match="got a FIFO"):
        MetricsTail(tmp_path).read()


def test_short_lines_take_little_memory_and_a_long_one_is_refused(tmp_path: Path) -> None:
    path, size = tmp_path / METRICS_FILE, 1 << 20
    path.write_bytes(b"\n" * size)
    tracemalloc.start()
    try:
        MetricsTail(tmp_path).read()
        assert tracemalloc.get_traced_memory()[1] < 80 * size
    finally:
        tracemalloc.stop()
    path.write_bytes(b"{}\n" + b"x" * (MOST_LINE_BYTES + 1) + b"\n{}\n")
    with pytest.raises(OSError, match="a row has more than"):
        MetricsTail(tmp_path).read()
