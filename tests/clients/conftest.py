"""Fixtures of the tests of clients: a stage for processes, and the clients, built once."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.clients.programs import Clients, no_warning
from tests.system.processes import ROOT, Stage

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
    """Skips, naming the package, without what the C++ client is built with."""
    for program, package in (("g++", "g++"), ("cmake", "cmake")):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is missing: apt-get install {package}")
    headers = subprocess.run(["g++", "-fsyntax-only", "-xc++", "-"], input=PROBE.encode(), capture_output=True, timeout=60)
    if headers.returncode:
        pytest.skip("zmq.h or sodium.h is missing: apt-get install libzmq3-dev libsodium-dev")


@pytest.fixture(scope="session")
def cpp_build(compiler: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A build folder of `clients/cpp`, configured."""
    build = tmp_path_factory.mktemp("cpp")
    no_warning("cmake", "-S", str(CPP), "-B", str(build), "-DTESTS=ON")
    return build


@pytest.fixture(scope="session")
def cpp(cpp_build: Path) -> Path:
    """The folder with the programs of `clients/cpp`, built with its tests."""
    no_warning("cmake", "--build", str(cpp_build), "-j2")
    return cpp_build


@pytest.fixture(scope="session")
def js(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of `clients/js` with its packages. Skips, with the reason, without Node or if a package cannot be installed."""
    for program in ("node", "npm"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is missing: apt-get install nodejs npm")
    copy = tmp_path_factory.mktemp("js") / "js"
    shutil.copytree(JS, copy, ignore=shutil.ignore_patterns("node_modules", "package-lock.json"))
    for command in ("npm install --no-audit --no-fund", "npm rebuild zeromq", "node --eval require('zeromq')"):
        done = subprocess.run(command.split(), cwd=copy, capture_output=True, text=True, timeout=600)
        if done.returncode:
            pytest.skip(f"{command}: {done.stderr[-300:]}")
    return copy


@pytest.fixture
def clients(request: pytest.FixtureRequest, stage: Stage) -> Clients:
    """The programs of the clients, built when they are first asked for."""
    return Clients(request, stage)
