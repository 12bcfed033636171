"""Fixtures of the tests of clients: a stage for processes, and the clients, built once."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.clients.programs import Clients, no_warning
from tests.system.stage.processes import ROOT, Stage

CPP, JS = ROOT / "clients" / "cpp", ROOT / "clients" / "js"
PROBE = "#include <zmq.h>\n#include <sodium.h>\n"


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    """A stage whose processes end with the test."""
    made = Stage(tmp_path / "stage")
    yield made
    made.close()


@pytest.fixture(scope="session")
def compiler() -> None:
    """Skips, saying what is missing, without what the C++ client is built with."""
    for program in ("g++", "cmake"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is missing: make packages")
    headers = subprocess.run(["g++", "-fsyntax-only", "-xc++", "-"], input=PROBE.encode(), capture_output=True, timeout=60)
    if headers.returncode:
        pytest.skip("zmq.h or sodium.h is missing: make packages")


@contextmanager
def shared(factory: pytest.TempPathFactory, name: str) -> Iterator[Path]:
    """A folder of all processes of this run of pytest, which take turns: what one builds there, the others find."""
    mine = factory.getbasetemp()
    folder = (mine.parent if "PYTEST_XDIST_WORKER" in os.environ else mine) / name
    folder.mkdir(exist_ok=True)
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield folder


@pytest.fixture(scope="session")
def cpp(compiler: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the programs of `clients/cpp`, built with its tests."""
    with shared(tmp_path_factory, "cpp") as build:
        no_warning("cmake", "-S", str(CPP), "-B", str(build), "-DTESTS=ON")
        no_warning("cmake", "--build", str(build), "-j2")
        return build


@pytest.fixture(scope="session")
def js(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of `clients/js` with its packages. Skips, with the reason, without Node or if a package cannot be installed."""
    for program in ("node", "npm"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is missing: make packages")
    with shared(tmp_path_factory, "js") as folder:
        copy, half = folder / "js", folder / "half"
        if not copy.exists():
            shutil.copytree(JS, half, ignore=shutil.ignore_patterns("node_modules", "package-lock.json"), dirs_exist_ok=True)
            for command in ("npm install --no-audit --no-fund", "npm rebuild zeromq", "node --eval require('zeromq')"):
                done = subprocess.run(command.split(), cwd=half, capture_output=True, text=True, timeout=600)
                if done.returncode:
                    pytest.skip(f"{command}: {done.stderr[-300:]}")
            half.rename(copy)
        return copy


@pytest.fixture
def clients(request: pytest.FixtureRequest, stage: Stage) -> Clients:
    """The programs of the clients, built when they are first asked for."""
    return Clients(request, stage)
