"""Starts, observes and stops learners and workers as real processes.

Rule: every wait has a deadline. If it fails, the error says what it waited for and what the process printed instead. When a
test is over, all processes that it started are dead, whatever it did to them.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import psutil

from millrace.learner.run_folder.metrics_log import read_rows
from millrace.protocol.keys.key_folder import KeyFolder
from tests.model.traces.recorder import FOLDER
from tests.system.stage.preloaded import start, workers_of

ROOT = Path(__file__).parents[3]
T = TypeVar("T")
LOOK_EVERY_S = 0.02
START_S = 90.0  # importing torch takes seconds, and longer on a busy machine
TOY = "tests.support.envs.toy:Slow-v0"
WORKER_TIMEOUT_S = 1.5
SMALL: dict[str, object] = {
    "env-kwargs": "seconds 0.001",
    "rollout-steps": 16,
    "batch-size": 64,
    "n-epochs": 1,
    "eval-episodes": 1,
    "steps": 1_000_000_000,  # practically no limit: the test ends the run
    "worker-timeout-s": WORKER_TIMEOUT_S,
    "no-workers-timeout-s": 60,
}


def wait_for(
    condition: Callable[[], T],
    within_s: float = 60.0,
    what: Callable[[], str] | str = "it",
    every_s: float = LOOK_EVERY_S,
) -> T:
    """Call `condition` every `every_s` seconds and return its first true result. Fails after `within_s`."""
    deadline = time.monotonic() + within_s
    while not (found := condition()):
        text = what if isinstance(what, str) else what()
        assert time.monotonic() < deadline, f"{text} did not happen within {within_s:.1f} s"
        time.sleep(every_s)
    return found


def crowding() -> float:
    """Number of processes for each core, at least 1: the factor by which work may take longer than on an idle machine."""
    return max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def free_port() -> int:
    """A TCP port of loopback that nobody uses."""
    with socket.create_server(("127.0.0.1", 0)) as found:
        return int(found.getsockname()[1])


class Running:
    """A process that was started. Its output goes to a file."""

    def __init__(self, command: Sequence[str], said: Path, told: bool = False) -> None:
        """`told`: the process reads lines from stdin; see `tell`."""
        self.said_in = said
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
        with said.open("ab") as file:
            self.process = start(
                command,
                stdin=subprocess.PIPE if told else subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                cwd=ROOT,
                env=environment,
            )
        self.pid = self.process.pid

    def said(self) -> str:
        """Its output so far."""
        return self.said_in.read_text(errors="replace")

    def hears(self, pattern: str, within_s: float = 30.0, times: int = 1) -> str:
        """Wait until its output has this many matches of the pattern. Returns the last match."""
        found = wait_for(
            lambda: len(said := re.findall(f".*{pattern}.*", self.said())) >= times and said,
            within_s,
            lambda: f"{pattern!r} in what {self.said_in.name} says:\n{self.said()}\n",
        )
        assert found
        return str(found[-1])

    def tell(self, line: str) -> None:
        """Write a line to its stdin."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n".encode())
        self.process.stdin.flush()

    def alive(self) -> bool:
        """Whether it has not ended. A stopped process has not ended."""
        return self.process.poll() is None

    def signal(self, number: int) -> None:
        """Send a signal."""
        self.process.send_signal(number)

    def kill(self) -> None:
        """Send SIGKILL and wait until it is dead."""
        self.process.kill()
        self.process.wait(10)

    def pause(self) -> None:
        """Send SIGSTOP and wait until it is stopped."""
        self.signal(signal.SIGSTOP)
        stopped = psutil.STATUS_STOPPED
        wait_for(lambda: psutil.Process(self.pid).status() == stopped, 10, "the process to stop")

    def go_on(self) -> None:
        """Send SIGCONT."""
        self.signal(signal.SIGCONT)

    def ends(self, within_s: float = 30.0) -> int:
        """Wait until it has ended by itself. Returns the exit code."""
        wait_for(lambda: not self.alive(), within_s, lambda: f"the end of {self.said_in.name}, which says:\n{self.said()}\n")
        return self.process.wait()

    def memory_mb(self) -> float:
        """Resident memory in MB."""
        return float(psutil.Process(self.pid).memory_info().rss) / 1e6

    def descriptors(self) -> int:
        """Number of open files and sockets."""
        return int(psutil.Process(self.pid).num_fds())


class Worker(Running):
    """`python -m millrace.workers` with one worker: a supervisor and its child. A fault hits both, as to a whole host."""

    def processes(self) -> list[psutil.Process]:
        """The supervisor and its children."""
        return [psutil.Process(self.pid), *workers_of(self.pid)]

    def kill(self) -> None:
        """Send SIGKILL to both and wait until the supervisor is dead.

        Both are stopped before: a child that still runs when its supervisor is dead says Goodbye, as after SIGTERM.
        """
        both = self.processes()
        for process in both:
            process.suspend()
        for process in both:
            process.kill()
        self.process.wait(10)

    def pause(self) -> None:
        """Send SIGSTOP to both and wait until they have stopped."""
        both = self.processes()
        for process in both:
            process.suspend()
        stopped = psutil.STATUS_STOPPED
        wait_for(lambda: all(process.status() == stopped for process in both), 10, "the processes to stop")

    def go_on(self) -> None:
        """Send SIGCONT to both."""
        for process in self.processes():
            process.resume()

    def memory_mb(self) -> float:
        """Resident memory of both."""
        return sum(float(process.memory_info().rss) for process in self.processes()) / 1e6

    def descriptors(self) -> int:
        """Number of open files and sockets of both."""
        return sum(int(process.num_fds()) for process in self.processes())


def _message(line: str) -> str:
    """The message of an event of `--log-json`; another line, or the beginning of one, as it is."""
    with suppress(json.JSONDecodeError):
        return str(json.loads(line)["message"]) if line.startswith("{") else line
    return line


class Learner(Running):
    """`millrace learner`, or another program that trains, and the folder of its run."""

    def __init__(self, command: Sequence[str], said: Path, runs: Path) -> None:
        super().__init__(command, said)
        self._runs = runs

    def said(self) -> str:
        """Its output so far, as text for people: of each event of `--log-json`, the message."""
        return "\n".join(map(_message, super().said().splitlines()))

    @property
    def folder(self) -> Path:
        """The run folder, which must exist."""
        (found,) = self._runs.iterdir()
        return found

    def is_open(self) -> str:
        """Wait until the port is open."""
        return self.hears("waiting for workers", START_S)

    def rows(self) -> list[dict[str, Any]]:
        """The rows of metrics.jsonl so far."""
        tables = list(self._runs.glob("*/metrics.jsonl"))
        return read_rows(tables[0]) if tables else []

    def updates(self) -> int:
        """Number of updates so far."""
        rows = self.rows()
        return int(rows[-1]["time/iterations"]) if rows else 0

    def trains(self, more: int = 3, within_s: float = START_S) -> dict[str, Any]:
        """Wait for this many more updates. Returns the newest row."""
        since = self.updates()
        self.until(lambda row: row["time/iterations"] >= since + more, within_s, f"{more} updates after the first {since}")
        return self.rows()[-1]

    def until(self, reached: Callable[[dict[str, Any]], bool], within_s: float, what: str = "the row") -> float:
        """Wait for an update whose row fulfils `reached`. Returns the seconds that this took."""
        began_s = time.monotonic()

        def found() -> bool:
            assert self.alive(), f"the learner ended while a test waited for {what}:\n{self.said()}"
            rows = self.rows()
            return bool(rows) and reached(rows[-1])

        wait_for(found, within_s, lambda: f"{what}; the learner says:\n{self.said()}\n")
        return time.monotonic() - began_s

    def ledger(self) -> dict[str, int]:
        """The ledger in the newest row."""
        prefix = "ledger/"
        return {name.removeprefix(prefix): count for name, count in self.rows()[-1].items() if name.startswith(prefix)}

    def summary(self) -> dict[str, Any]:
        """The content of summary.json."""
        found: dict[str, Any] = json.loads((self.folder / "summary.json").read_text())
        return found

    def checkpoints(self) -> list[Path]:
        """Paths of the checkpoints, oldest first."""
        return sorted(self._runs.glob("*/checkpoints/*.pt"))


class Stage:
    """Starts the processes of one test, and ends them after it."""

    def __init__(self, tmp_path: Path, traces: Path | None = None) -> None:
        """`traces`: learners and workers record themselves in this folder, for `tests.model.traces.accept`."""
        tmp_path.mkdir(exist_ok=True)
        self.tmp_path = tmp_path
        self._recording: list[str] = []  # words before a command
        if traces is not None:
            traces.mkdir()
            hook = ROOT / "tests" / "model" / "traces" / "hook"
            self._recording = ["env", f"PYTHONPATH={hook}{os.pathsep}{ROOT}", f"{FOLDER}={traces}"]
        self.runs = tmp_path / "runs"
        self.started: list[Running] = []
        self._numbers = itertools.count()

    def keys(self) -> tuple[Path, Path]:
        """Make a key folder. Returns its path, and the path of the token with which workers may join."""
        folder = self.tmp_path / "keys"
        return folder, KeyFolder(folder).new("workers", datetime.now(UTC).replace(microsecond=0))

    def learner(
        self,
        address: str,
        settings: Mapping[str, object] = {},
        *,
        env: str = TOY,
        before: Sequence[str] = (),
        resume: Path | None = None,
    ) -> Learner:
        """Start `millrace learner` at this address. `settings` override SMALL. `before`: words before the command.

        `resume`: the run to go on with, in which only `settings` change.
        """
        arguments = ["--log-json", "--resume", str(resume)]  # its log is the only one that tells who joins and leaves
        if resume is None:
            arguments = ["--log-json", env, "--bind", address, "--run-dir", str(self.runs)]
            settings = {**SMALL, **settings}
        for name, value in settings.items():
            if value != "":
                arguments += [f"--{name}", *str(value).split()]
        said = self.tmp_path / f"learner-{next(self._numbers)}.log"
        command = [*before, *self._recording, sys.executable, "-m", "millrace", "learner", *arguments]
        learner = Learner(command, said, self.runs)
        self.started.append(learner)
        return learner

    def worker(self, address: str, name: str, *flags: str, before: Sequence[str] = ()) -> Worker:
        """Start `python -m millrace.workers` for the learner at this address."""
        command = [*before, *self._recording, sys.executable, "-m", "millrace.workers", address, "--name", name, *flags]
        worker = Worker(command, self.tmp_path / f"{name}-{next(self._numbers)}.log")
        self.started.append(worker)
        return worker

    def start(self, command: Sequence[str], name: str, told: bool = False) -> Running:
        """Start any process. It is ended with the test."""
        running = Running(command, self.tmp_path / f"{name}-{next(self._numbers)}.log", told)
        self.started.append(running)
        return running

    def close(self) -> None:
        """End all processes, also stopped ones. Fails if a process that one of them started still runs."""
        families = []
        for running in self.started:
            if running.alive():
                families += psutil.Process(running.pid).children(recursive=True)
                running.process.kill()
        for running in self.started:
            running.process.wait(10)
            if running.process.stdin is not None:
                with suppress(BrokenPipeError):
                    running.process.stdin.close()
        _, left = psutil.wait_procs(families, timeout=5)
        for process in left:
            process.kill()
        assert not left, f"processes were left behind: {left}"
