"""A line about a run: its state follows from what is in its folder, whatever that is."""

import os
import time
from pathlib import Path

import pytest
from msgspec.structs import replace

from millrace.learner.run_folder.lease import Listens, decoded
from millrace.learner.run_folder.progress_file import PROGRESS_FILE
from millrace.learner.run_folder.run_format import CONFIG_FILE, write_format
from millrace.learner.run_folder.run_lock import LOCK_FILE, PACE, RunLock
from millrace.learner.run_lines import find_runs, headline, in_sentences, read_line
from millrace.protocol.errors import UsageError
from millrace.protocol.progress import RunProgress
from tests.support.run_folders import LAST_SIGN_S, a_run

GONE = 2**22 + 1  # no process has so high a number


def test_a_finished_run_says_why_it_ended(tmp_path: Path) -> None:
    line = read_line(a_run(tmp_path), time.time())
    assert line.state == "finished"
    assert headline(line) == "Finished: all steps done."
    assert line.done == "100%"
    assert "123,456 of 100,000 env steps" in in_sentences(line)
    assert "greedy return -1233.6 ± 7.5" in in_sentences(line)


def test_a_run_that_failed_says_why_and_how_to_continue(tmp_path: Path) -> None:
    line = read_line(a_run(tmp_path, failure="no worker came"), time.time())
    assert (line.state, line.done) == ("interrupted", "no worker came"), "no percentage"
    assert headline(line).startswith("Interrupted: no worker came; continue it with: millrace train --resume ")


def test_a_run_whose_workers_were_started_elsewhere_is_continued_by_a_learner_alone(tmp_path: Path) -> None:
    for run in (a_run(tmp_path, failure="no worker came"), a_run(tmp_path, finished=False)):
        write_format(run, workers_elsewhere=True)
        said = headline(read_line(run, time.time()))
        assert said.endswith(f"; continue it with: millrace learner --resume {run}"), (
            "`train` would start workers of its own"
        )


def test_a_run_without_a_process_and_without_results_is_dead(tmp_path: Path) -> None:
    run = a_run(tmp_path, finished=False)
    line = read_line(run, time.time())
    assert line.state == "dead"
    assert (line.progress.env_steps, line.progress.updates, line.progress.return_mean) == (2000, 20, 101.0)
    sign = time.strftime("no sign since %Y-%m-%d %H:%M:%S", time.localtime(LAST_SIGN_S))
    assert line.done == f"2%, {sign}"
    assert headline(line).startswith(f"Dead: no process trains it, and it has no results; {sign}. It was killed, or ")
    (run / PROGRESS_FILE).unlink()
    line = read_line(run, time.time())
    assert (line.done, line.has_numbers, line.left_s) == ("–", False, None), "a power failure may cost the file"
    assert "env steps" not in in_sentences(line)
    assert headline(line).startswith("Dead: no process trains it, and it has no results. It was killed, or ")


def test_a_run_trains_as_long_as_its_lock_is_held(tmp_path: Path) -> None:
    run = a_run(tmp_path)  # its summary is from before a resume
    with RunLock(run) as lock:
        line = read_line(run, time.time())
        assert line.state == "training"
        assert line.summary is None
        lock.announce(Listens("tcp://box:5555", "tcp://127.0.0.1:5555"))
        owner = decoded((run / LOCK_FILE).read_bytes())
        assert owner is not None
    path = run / LOCK_FILE
    path.write_bytes(replace(owner, pid=GONE, pid_namespace="pid:[1]").encoded())  # in a container
    now = path.stat().st_mtime
    assert read_line(run, now + PACE.dead_after - 1).state == "training"
    assert read_line(run, now + PACE.dead_after + 1).state == "finished"
    path.write_bytes(replace(owner, pid=GONE, address="ipc://here").encoded())
    assert read_line(run, now).state == "finished"


def test_runs_are_found_in_folders_and_the_newest_comes_first(tmp_path: Path) -> None:
    runs = [a_run(tmp_path / "more", seed=seed) for seed in (1, 2)]
    older = runs[0].rename(runs[0].with_name("CartPole-v1-ppo-s1-20200101-000000"))
    (tmp_path / "more" / "notes").mkdir()
    (tmp_path / "more" / "a-file").touch()
    assert find_runs([older, tmp_path / "more"]) == [runs[1], older]
    assert read_line(older, 0.0).started == "2020-01-01 00:00"
    with pytest.raises(UsageError, match=r"no-such.*expected a run folder, or a folder of runs"):
        find_runs([tmp_path / "no-such"])


def test_a_folder_that_cannot_be_read_is_a_line_too(tmp_path: Path) -> None:
    run = a_run(tmp_path)
    (run / "run.json").unlink()
    os.mkfifo(run / "run.json")
    assert find_runs([tmp_path]) == [run]
    line = read_line(run, time.time())
    assert line.state == "unreadable"
    assert "got a FIFO" in headline(line)


def test_nothing_in_a_folder_can_control_a_terminal(tmp_path: Path) -> None:
    run = a_run(tmp_path, failure="\x1b[2J\x1b[31mred\nsecond line")
    named = run.rename(tmp_path / "evil\x1b[2J\n")
    line = read_line(named, time.time())
    for text in (line.name, headline(line), *in_sentences(line).split("\n")):
        assert text.isprintable()


@pytest.mark.parametrize("steps", ["inf", "nan", "-1", "1" + "0" * 400])
def test_odd_numbers_of_a_folder_are_a_line_too(tmp_path: Path, steps: str) -> None:
    run = a_run(tmp_path, finished=False)
    config = (run / CONFIG_FILE).read_text()
    (run / CONFIG_FILE).write_text(config.replace("steps = 100000\n", f"steps = {steps}\n"))
    (run / PROGRESS_FILE).write_text('{"env_steps": -5}')
    with RunLock(run):
        line = read_line(run, time.time())
        assert line.state == "training"
        assert (line.progress, headline(line)) == (RunProgress(), "Training: before its first update.")
        slow = RunProgress(at_s=LAST_SIGN_S, env_steps=5, total_steps=100, steps_per_s=1e-320)
        assert headline(line._replace(progress=slow)) == "Training: 5% done, 0 env steps per second, about inf s left."
