"""A page beside a run that trains, served by a process of its own: it begins and ends with the run."""

from __future__ import annotations

import re
import sys
import urllib.error
import urllib.request
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest

from millrace.extras.monitoring.dashboard import Dashboard
from millrace.learner.run_folder.progress import Progress
from millrace.protocol.errors import RunError
from tests.system.stage.local_runs import SMALL, run
from tests.system.stage.processes import START_S, wait_for

SHORT: dict[str, Any] = {"steps": 256, "workers": 1, "envs": 2, "lanes": 1, "rollout_steps": 64}


def page_processes() -> list[psutil.Process]:
    """Those of this process that serve a page."""
    found = []
    for child in psutil.Process().children():
        with suppress(psutil.NoSuchProcess):  # it has just ended
            found += [child] if "millrace.extras.monitoring.dashboard.serve" in child.cmdline() else []
    return found


def said(address: str) -> str:
    """The page there."""
    with urllib.request.urlopen(address, timeout=START_S) as answer:
        text: str = answer.read().decode()
    return text


@pytest.mark.parametrize("inference", ["workers", "learner"])
def test_its_address_is_said_and_it_shows_the_end_of_the_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, inference: str
) -> None:
    during = list[str]()

    def address() -> str:
        found = re.search(r"page of this run: (http://127\.0\.0\.1:\d+/\S+/)$", caplog.text, re.MULTILINE)
        assert found is not None
        return found[1]

    def watch(progress: Progress) -> None:
        if progress.updates == 2:
            during.append(said(address()))

    folder = run(tmp_path, "CartPole-v1", watch, steps=1024, dashboard=True, inference=inference, **SMALL)
    assert "Training: " in during[0]
    assert ">millrace: all runs<" not in during[0], "it is of this run alone"
    assert "Finished: all steps done." in said(address())
    assert address() not in "".join(path.read_text() for path in folder.glob("*.jsonl")), "who reads the folder has no token"
    wait_for(lambda: not page_processes(), START_S, lambda: "its process ends")


def test_it_is_of_all_runs_and_ends_when_it_is_closed(tmp_path: Path) -> None:
    folder = run(tmp_path, "CartPole-v1", **SHORT, **SMALL)
    with Dashboard(folder.parent) as dashboard:
        assert folder.name in said(dashboard.address)
        assert f'<iframe src="{dashboard.address}"' in dashboard._repr_html_()
        with pytest.raises(urllib.error.HTTPError):
            said(dashboard.address[:-2])
    assert page_processes() == []


def test_its_process_finds_modules_where_the_program_finds_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = tmp_path / "seen"
    (tmp_path / "sitecustomize.py").write_text(f"open({str(seen)!r}, 'w').close()\n")  # Python imports it as it starts
    monkeypatch.syspath_prepend(tmp_path)
    with Dashboard(tmp_path):
        assert seen.exists()


def test_a_run_goes_on_if_it_does_not_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\necho no port is free\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    with pytest.raises(RunError, match="it did not start: no port is free"):
        Dashboard(tmp_path)
    folder = run(tmp_path, "CartPole-v1", dashboard=True, transport="inproc", **SHORT, **SMALL)
    assert (folder / "summary.json").exists()
