"""The recipes of docs/how-to/simulators.md: each block of Python, and each command as it is written, with stand-ins.

`tests/system/environments/simulators.py` plays the simulators; MPI (Open MPI, mpi4py) and the X server (Xvfb) are real.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.docs.pages import blocks
from tests.docs.test_code import FILE_NAME
from tests.system.environments import simulators
from tests.system.stage.processes import ROOT, wait_for

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]

PAGE = (ROOT / "docs/how-to/simulators.md").read_text()
STAND_IN = Path(simulators.__file__)
NAMES = ("pipe", "socket", "socket, restarted", "folder", "MPI", "licences", "display of the machine", "display of a copy")
COMMANDS = dict(zip(NAMES, (b.text for b in blocks(PAGE) if b.language == "bash"), strict=True))
FAULTS: dict[str, dict[str, object]] = {
    "socket, restarted": {"dies_after": 90},
    "MPI": {"ranks": 2},
    "display of the machine": {"draws": True},
    "display of a copy": {"draws": True},
}
"""what the stand-in does meanwhile, or insists on"""
LICENCES = "127.0.0.1:4999"


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """The page's modules, a template of a case, and the programs in `bin`. Nothing lives on after the test."""
    for block in blocks(PAGE):
        if block.language == "python" and (name := FILE_NAME.match(block.text)):
            (tmp_path / name[1]).write_text(block.text)
    (tmp_path / "case").mkdir()
    (tmp_path / "case/state.json").write_text(json.dumps({"observation": [0, 0], "place": 0.0, "steps": 0}))
    (tmp_path / "bin").mkdir()
    for program in ("simulator", "solver", "licence-server"):
        path = tmp_path / "bin" / program
        path.write_text(f'#!/bin/sh\nexec /usr/bin/python3 {STAND_IN} {program} "$@"\n')
        path.chmod(0o755)
    (tmp_path / "bin/millrace").write_text(f'#!/bin/sh\nexec {sys.executable} -m millrace "$@"\n')
    (tmp_path / "bin/millrace").chmod(0o755)
    before = set(psutil.pids())
    command = [str(tmp_path / "bin/licence-server"), "--port", LICENCES.partition(":")[2], "--licences", "4"]
    with subprocess.Popen(command) as server:
        yield tmp_path
        server.kill()
    wait_for(lambda: not living(before), 10, lambda: f"the end of {living(before)}")


def living(before: set[int]) -> list[str]:
    """The commands of stand-ins and X servers that were started since."""
    found = []
    for process in psutil.process_iter(["pid", "cmdline"]):
        words = process.info["cmdline"] or []
        if process.info["pid"] not in before and (str(STAND_IN) in words or "Xvfb" in words):
            found.append(" ".join(words))
    return found


def run(command: str, folder: Path, **faults: object) -> str:
    """Run a command of the page in this folder. Returns what it printed."""
    environment = {
        **os.environ,
        "PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "STAND_IN": json.dumps(faults),
        "LICENCE_SERVER": LICENCES,
        "OMPI_ALLOW_RUN_AS_ROOT": "1",
        "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    }
    done = subprocess.run(["bash", "-c", command], cwd=folder, env=environment, capture_output=True, text=True, timeout=500)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert "all steps done" in said, said
    return said


@pytest.mark.parametrize("name", COMMANDS)
def test_a_recipe_works_as_it_is_written(name: str, folder: Path) -> None:
    needed = {"MPI": "mpirun", "display of the machine": "Xvfb", "display of a copy": "Xvfb"}.get(name)
    if needed and shutil.which(needed) is None:
        pytest.skip(f"{needed} is missing: make packages")
    said = run(COMMANDS[name], folder, **FAULTS.get(name, {}))
    assert "raised" not in said, said


@pytest.mark.parametrize("name", ["pipe", "socket"])
def test_a_simulator_that_hangs_is_ended_and_its_copy_made_again(name: str, folder: Path) -> None:
    command = COMMANDS[name].replace("--step-timeout-s 30", "--step-timeout-s 3 --max-env-failures 9")
    said = run(command, folder, hangs_after=300)
    assert "took longer than 3 s (--step-timeout-s)" in said


def test_a_simulator_that_dies_names_its_exit_code_and_is_started_again(folder: Path) -> None:
    said = run(f"{COMMANDS['pipe']} --max-env-failures 9", folder, dies_after=300)
    assert "ConnectionError: the simulator has ended with code -6" in said, said
