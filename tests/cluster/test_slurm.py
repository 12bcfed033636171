"""`millrace launch slurm` under a real Slurm: submit, train, cancel, requeue, resume, the time limit's signal."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from millrace.cli.main import main
from millrace.learner.run_folder.metrics_log import read_rows
from tests.cluster.slurm import Slurm, why_not
from tests.system.stage.processes import ROOT, SMALL, START_S, TOY, Stage, free_port, wait_for
from tests.system.stage.runs import accounted

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]
WORKERS = 3  # two nodes of two cores: one for the learner, so all are taken


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    made = Stage(tmp_path)
    try:
        yield made
    finally:
        made.close()


@pytest.fixture
def slurm(stage: Stage) -> Iterator[Slurm]:
    if why := why_not():
        pytest.skip(why)
    with Slurm(stage) as made:
        yield made


class Script:
    """The job script, in the folder that all nodes share."""

    def __init__(self, capsys: pytest.CaptureFixture[str], folder: Path, minutes: int, save_s: int) -> None:
        self.folder, self.path = folder, folder / "run.sbatch"
        folder.mkdir(exist_ok=True)
        flags = ["--workers", str(WORKERS), "--time", str(minutes), "--save-s", str(save_s), "--folder", str(folder)]
        settings = SMALL | {"min-workers": WORKERS}
        given = [word for name, value in settings.items() for word in (f"--{name}", *str(value).split())]
        # Keep the launcher's own --no-workers-timeout-s.
        del given[(at := given.index("--no-workers-timeout-s")) : at + 2]
        assert main(["launch", "slurm", TOY, *flags, "--", *given]) == 0
        self.path.write_text(capsys.readouterr().out)

    def updates(self) -> int:
        tables = list(self.folder.glob("runs/*/metrics.jsonl"))
        rows = read_rows(tables[0]) if tables else []
        return int(rows[-1]["time/iterations"]) if rows else 0

    def trains(self, job: str, slurm: Slurm) -> int:
        """Wait until there are ten updates more than before."""
        wait_for((self.folder / "runs").exists, START_S, lambda: f"a run; {slurm.seen(job)}; {self.said(job)}")
        since = wait_for(self.updates, START_S, lambda: f"an update; {self.said(job)}")
        return (
            wait_for(
                lambda: (now := self.updates()) >= since + 10 and now, START_S, lambda: f"ten updates; {self.said(job)}"
            )
            or 0
        )

    def summary(self) -> dict[str, Any]:
        (run,) = (self.folder / "runs").iterdir()
        found: dict[str, Any] = json.loads((run / "summary.json").read_text())
        return found

    def said(self, job: str) -> str:
        log = self.folder / f"millrace-{job}.log"
        return log.read_text() if log.exists() else "nothing"


def ends(slurm: Slurm, job: str) -> dict[str, str]:
    over = ("CANCELLED", "COMPLETED", "FAILED", "TIMEOUT")
    wait_for(lambda: slurm.seen(job)["JobState"] in over, START_S, lambda: f"its end: {slurm.seen(job)}")
    return slurm.seen(job)


def test_submit_cancel_and_resume(slurm: Slurm, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    script = Script(capsys, tmp_path / "shared", minutes=60, save_s=120)
    job = slurm.submit(script.path)
    script.trains(job, slurm)
    assert slurm.seen(job)["NodeList"] == "n[1-2]"
    killed = worker_processes(script.folder)[0]
    killed.kill()
    wait_for(lambda: len(worker_processes(script.folder)) == WORKERS, 30, "another worker in its place")
    before = script.trains(job, slurm)
    slurm.cancel(job)
    assert ends(slurm, job)["JobState"] == "CANCELLED"
    saved = script.summary()
    assert (saved["stop_reason"], saved["updates"] >= before) == ("interrupted", True), script.said(job)
    accounted(saved)

    again = slurm.submit(script.path)
    after = script.trains(again, slurm)
    assert after > saved["updates"]
    slurm.requeue(again)  # as by an administrator: Slurm ends the job and queues it again
    wait_for(lambda: (seen := slurm.seen(again))["Restarts"] == "1" and seen["JobState"] == "RUNNING", 120)
    assert script.trains(again, slurm) > after
    slurm.cancel(again)
    ends(slurm, again)
    assert len(list((script.folder / "runs").iterdir())) == 1
    accounted(script.summary())
    assert not list(script.folder.glob("*.address"))


def test_before_its_time_is_up_a_job_saves_and_is_queued_again(
    slurm: Slurm, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    script = Script(capsys, tmp_path / "shared", minutes=2, save_s=60)  # Slurm may signal up to a minute too early
    job = slurm.submit(script.path)
    script.trains(job, slurm)
    wait_for(lambda: slurm.seen(job)["Restarts"] == "1", 180, lambda: f"a restart: {slurm.seen(job)}\n{script.said(job)}")
    saved = script.summary()
    assert saved["stop_reason"] == "interrupted"
    accounted(saved)
    assert re.search("interrupted; continue with", script.said(job))
    assert "TIME LIMIT" not in script.said(job)
    wait_for(lambda: slurm.seen(job)["JobState"] == "RUNNING", 120, "the job to run again")
    wait_for(lambda: script.updates() > saved["updates"], START_S, lambda: script.said(job))
    slurm.cancel(job)
    assert ends(slurm, job)["JobState"] == "CANCELLED"


@pytest.mark.parametrize(
    ("changed", "state", "code", "says"),
    [
        (("--steps 1000000000", "--steps 2000"), "COMPLETED", "0:0", "all steps done"),
        ((TOY, "NoSuchEnvironment-v0"), "FAILED", "2:0", "NoSuchEnvironment"),
    ],
)
def test_the_job_ends_as_the_learner_does(
    slurm: Slurm,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    changed: tuple[str, str],
    state: str,
    code: str,
    says: str,
) -> None:
    script = Script(capsys, tmp_path / "shared", minutes=60, save_s=120)
    script.path.write_text(script.path.read_text().replace(*changed))
    job = slurm.submit(script.path)
    seen = ends(slurm, job)
    assert (seen["JobState"], seen["ExitCode"]) == (state, code), script.said(job)
    assert says in script.said(job)
    assert not worker_processes(script.folder)


def worker_processes(folder: Path) -> list[psutil.Process]:
    """The worker processes of this job, on any node."""
    found = []
    for process in psutil.process_iter():
        try:
            command = process.cmdline()
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
        if command[1:4] == ["-m", "millrace", "worker"] and any(word.startswith(str(folder)) for word in command):
            found.append(process)
    return found


SHARDS = """#!/bin/bash
#SBATCH --nodes=1 --ntasks=2 --output={folder}/millrace-%j.log --chdir={folder}
export PATH={programs}:$PATH
{srun}
"""


def test_two_tasks_share_the_updates_of_a_run_by_the_line_of_the_docs(slurm: Slurm, tmp_path: Path) -> None:
    page = (ROOT / "docs/how-to/shards.md").read_text()
    found = re.search(r"\n(srun .*?)\n```", page, re.DOTALL)
    assert found is not None
    small = " --steps 2000 --rollout-steps 64 --eval-episodes 1 --workers 1 --run-dir runs --shards 2"
    srun = found[1].replace(" --shards 2", small).replace("29500", str(free_port()))
    path = tmp_path / "shards.sbatch"
    path.write_text(SHARDS.format(folder=tmp_path, programs=Path(sys.executable).parent, srun=srun))
    job = slurm.submit(path)
    said = tmp_path / f"millrace-{job}.log"
    assert ends(slurm, job)["JobState"] == "COMPLETED", said.read_text()
    assert "2 shards, 1 for each of 2 learner processes" in said.read_text()
    assert "rank 1 of 2 takes part in the updates of run runs/" in said.read_text()
    (run,) = (tmp_path / "runs").iterdir()
    assert json.loads((run / "summary.json").read_text())["stop_reason"] == "all steps done"
