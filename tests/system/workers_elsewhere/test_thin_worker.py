"""A worker's machine: only the packages of docker/worker.txt can be imported. `worker`, `status` and `keys` work there.

Python imports `sitecustomize` when it starts. Ours refuses every other dependency of millrace, in each process of the test.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.system.stage.processes import ROOT, START_S, Stage

SITECUSTOMIZE = """
import sys

class NotInstalled:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, NotInstalled())
"""


def names(requirements: list[str]) -> set[str]:
    """Import names of the distributions that these lines require."""
    found = (re.match(r"[\w-]+", line) for line in requirements)
    return {match[0].replace("-", "_") for match in found if match}


@pytest.fixture
def thin(tmp_path: Path) -> dict[str, str]:
    """Environment variables for processes that can import only what a worker needs."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [line for lines in project["optional-dependencies"].values() for line in lines]
    missing = names(project["dependencies"] + extras) - names((ROOT / "docker" / "worker.txt").read_text().splitlines())
    learner_only = {"prometheus_client", "rich", "safetensors", "tensorboard", "threadpoolctl", "tomli_w", "torch"}
    assert learner_only | {"resvg_py"} <= missing
    folder = tmp_path / "thin"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(SITECUSTOMIZE.format(missing=missing))
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}


def test_other_commands_say_what_is_missing(thin: dict[str, str]) -> None:
    for command in ("train", "evaluate", "plot"):
        done = subprocess.run(
            [sys.executable, "-m", "millrace", command, "x"],
            env=thin,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 2
        assert re.fullmatch(rf"millrace: {command} needs \w+, which is not installed: .*\n", done.stderr), done.stderr


def millrace(thin: dict[str, str], *argv: str, exit_code: int = 0) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "millrace", *argv], env=thin, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == exit_code, done.stderr
    return done.stdout


def test_keys_and_help_need_nothing_more(thin: dict[str, str], tmp_path: Path) -> None:
    for command in ("worker", "status", "keys"):
        assert millrace(thin, command, "--help").startswith(f"usage: millrace {command}")
    assert "millrace worker " in millrace(thin, "--help")
    keys = ["--keys", str(tmp_path / "keys")]
    assert "lab.token" in millrace(thin, "keys", "new", "lab", *keys)
    assert "far may connect" in millrace(thin, "keys", "allow", "ab" * 32, "far", *keys)
    assert "lab is revoked" in millrace(thin, "keys", "revoke", "lab", *keys)
    shown = millrace(thin, "keys", "show", *keys)
    assert re.search(r"^lab .* revoked", shown, re.MULTILINE)
    assert re.search(r"^far .* may connect$", shown, re.MULTILINE)


def test_workers_join_and_status_shows_the_run(stage: Stage, thin: dict[str, str]) -> None:
    keys, token = stage.keys()
    learner = stage.learner("tcp://127.0.0.1:*", {"keys": keys})
    address = learner.hears("millrace worker ", START_S).partition("millrace worker ")[2].split()[0]
    flags = ["--processes", "2", "--token", str(token)]
    with_thin = ["env", f"PYTHONPATH={thin['PYTHONPATH']}"]
    workers = stage.start([*with_thin, sys.executable, "-m", "millrace", "worker", address, *flags], "workers")
    learner.trains()
    status = ["status", address, "--token", str(token)]
    assert len(json.loads(millrace(thin, *status, "--json"))["workers"]) == 2
    head, *lines = millrace(thin, *status).splitlines()
    assert "env steps" in head
    table = next(i for i, line in enumerate(lines) if line.startswith("worker "))
    assert lines[table].split() == [
        "worker",
        "host",
        "pid",
        "lanes",
        "tickets",
        "steps/s",
        "weights",
        "silent",
        "doing",
        "memory",
    ]
    assert lines[table + 1 :].index("") == 2
    learner.process.terminate()
    assert learner.ends() == 130, learner.said()
    assert workers.ends() == 0, workers.said()
