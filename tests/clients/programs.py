"""Starts the clients, and commands of millrace for which they work."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import pytest
import zmq

from millrace.protocol.messages import Hello, ToLearner
from millrace.protocol.wire.codec import decode_to_learner
from tests.clients.client_page import client, written
from tests.system.stage.processes import START_S, Learner, Running, Stage, free_port

M = TypeVar("M", bound=ToLearner)
IN_LEARNER = ("--inference", "learner")


def no_warning(*command: str) -> None:
    """Run a command of the compiler. Fails if it does, or warns."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "warning:" not in done.stderr, done.stderr


def loopback() -> str:
    """An address that nobody uses."""
    return f"tcp://127.0.0.1:{free_port()}"


def millrace(stage: Stage, name: str, *words: object) -> Running:
    """Start a command of millrace."""
    return stage.start([sys.executable, "-m", "millrace", *map(str, words)], name)


def learner(stage: Stage, address: str, *words: object, env: str = "CartPole-v1", steps: int = 4_000) -> Learner:
    """Start `millrace learner` at this address. `words`: more flags."""
    command = [sys.executable, "-m", "millrace", "learner", env, "--bind", address, "--run-dir", str(stage.runs)]
    settings = ["--preset", "none", "--steps", str(steps), "--eval-episodes", "2"]
    made = Learner([*command, *settings, *map(str, words)], stage.tmp_path / f"learner-{len(stage.started)}.log", stage.runs)
    stage.started.append(made)
    return made


def resumed(stage: Stage, runs: Learner, address: str, *words: object) -> Learner:
    """Start `millrace learner` that goes on with this run."""
    command = [sys.executable, "-m", "millrace", "learner", "--resume", str(runs.folder), "--bind", address]
    made = Learner([*command, *map(str, words)], stage.tmp_path / f"learner-{len(stage.started)}.log", stage.runs)
    stage.started.append(made)
    return made


class FalseLearner:
    """A ROUTER socket at which a client says Hello. A context manager."""

    def __enter__(self) -> FalseLearner:
        self.socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.ROUTER)
        self.address = f"tcp://127.0.0.1:{self.socket.bind_to_random_port('tcp://127.0.0.1')}"
        return self

    def __exit__(self, *error: object) -> None:
        self.socket.close(linger=0)

    def hello(self) -> tuple[bytes, Hello]:
        assert self.socket.poll(10_000), "no Hello within 10 s"
        peer, *frames = self.socket.recv_multipart()
        hello = decode_to_learner(frames)
        assert isinstance(hello, Hello)
        return peer, hello

    def heard(self, kind: type[M]) -> M:
        """The next message of this kind; heartbeats and the like may come before it."""
        while self.socket.poll(10_000):
            message = decode_to_learner(self.socket.recv_multipart()[1:])
            if isinstance(message, kind):
                return message
        raise AssertionError(f"no {kind.__name__} within 10 s")


class Client:
    """A program of a client, which is built."""

    def __init__(self, stage: Stage, command: list[str], name_flag: Sequence[str] = ("--name",)) -> None:
        self._stage, self._command, self._name_flag = stage, command, name_flag

    def start(self, address: str, name: str = "client", *flags: object) -> Running:
        """Start it for the learner at this address."""
        return self._stage.start([*self._command, address, *self._name_flag, name, *map(str, flags)], name)


class Clients:
    """The programs of the clients. Take one before a learner is started, which would wait for the compiler."""

    def __init__(self, request: pytest.FixtureRequest, stage: Stage) -> None:
        self._request, self._stage = request, stage

    def __getitem__(self, program: str) -> Client:
        """`cpp cartpole`, `js corridor` and so on, or `page`, which a page writes. Skips the test if it cannot be built."""
        language, _, file = program.partition(" ")
        if language == "cpp":
            build: Path = self._request.getfixturevalue("cpp")
            return Client(self._stage, [str(build / file)])
        if language == "page":
            return Client(self._stage, [sys.executable, str(written(self._stage.tmp_path, client()))], name_flag=())
        folder: Path = self._request.getfixturevalue("js")
        (script,) = folder.glob(f"*/{file}.js")
        return Client(self._stage, ["node", str(script)])


def ends_well(running: Running, within_s: float = START_S + 60) -> str:
    """Wait until it ends with exit code 0. Returns what it said."""
    assert running.ends(within_s) == 0, running.said()
    return running.said()


def last_line(running: Running, exit_code: int, within_s: float = START_S) -> str:
    """Wait until it ends with this exit code. Returns the last line that it said."""
    assert running.ends(within_s) == exit_code, running.said()
    return running.said().splitlines()[-1]
