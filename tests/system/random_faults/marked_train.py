"""`python -m tests.system.random_faults.marked_train FILE ARGUMENTS`: `millrace ARGUMENTS` writes into FILE what it does.

With `--fork` instead it starts such processes by forking itself, so that only it imports PyTorch, which takes longest.

Rule: FILE is mapped memory, so what was written last is there also if the process is killed in the middle of it. The program
is wrapped from outside: the modules that import PyTorch are not imported earlier than they would be.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
import sys
import tempfile
from collections.abc import Callable
from enum import IntEnum
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar

IMPORTED = (
    "millrace.cli.main", "millrace.launch.training", "millrace.launch.learner_inference",
    "millrace.learner.train", "millrace.learner.run_spec", "millrace.learner.run_state", "millrace.learner.torch_setup",
    "millrace.learner.algorithms.ppo", "millrace.learner.algorithms.dqn", "millrace.learner.algorithms.a2c",
    "millrace.learner.algorithms.impala", "millrace.learner.algorithms.reinforce",
    "tensorboard.compat.proto.event_pb2", "tensorboard.summary.writer.record_writer", "safetensors.numpy",
)  # fmt: skip
P = ParamSpec("P")
R = TypeVar("R")


class Phase(IntEnum):
    """What a learner is doing."""

    STARTING = 0
    COLLECTING = 1
    UPDATING = 2
    RECORDING = 3
    CHECKPOINTING = 4
    EVALUATING = 5
    DRAINING = 6
    LEAVING = 7


class Marks(NamedTuple):
    """The content of FILE. Versions are -1 while there is none."""

    phase: Phase = Phase.STARTING
    entered: int = 0
    """how many times a phase has begun"""
    first: int = -1
    """version with which this process began"""
    whole: int = -1
    """version of the newest whole update"""
    saved: int = -1
    """version in the newest checkpoint that this process has written"""


LAYOUT = struct.Struct("5q")


def read_marks(file: Path) -> Marks:
    """What was written last; the defaults if the process has not begun to write."""
    content = file.read_bytes() if file.exists() else b""
    if len(content) < LAYOUT.size:
        return Marks()
    phase, *rest = LAYOUT.unpack(content[: LAYOUT.size])
    return Marks(Phase(phase), *rest)


class Marker:
    """Writes the marks of this process, and wraps what it marks."""

    def __init__(self, file: Path) -> None:
        file.write_bytes(LAYOUT.pack(*Marks()))
        with file.open("r+b") as opened:
            self._page = mmap.mmap(opened.fileno(), LAYOUT.size)
        self._marks = Marks()
        self._gathered = 0

    def mark(self, **changed: int) -> None:
        """Write these marks."""
        if "phase" in changed:
            changed["entered"] = self._marks.entered + 1
        self._marks = self._marks._replace(**changed)  # type: ignore[arg-type]
        self._page[:] = LAYOUT.pack(*self._marks)

    def during(self, phase: Phase, function: Callable[P, R], then: Phase | None = None) -> Callable[P, R]:
        """The function, in this phase. Afterwards: `then`, or the phase before it."""

        def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
            before = self._marks.phase
            self.mark(phase=phase)
            try:
                return function(*args, **kwargs)
            finally:
                self.mark(phase=before if then is None else then)

        return wrapped

    def wrap(self) -> None:
        """Wrap the functions in which the phases of a learner begin."""
        from millrace.learner.rollouts.hub import Hub
        from millrace.learner.run_folder import checkpoint
        from millrace.learner.run_folder.run_folder import RunFolder

        gather, publish, save = Hub.gather, Hub.publish, checkpoint.save

        def marked_gather(hub: Hub, *args: Any) -> Any:
            found = self.during(Phase.COLLECTING, gather, Phase.UPDATING)(hub, *args)
            self._gathered += 1
            return found

        def marked_publish(hub: Hub, version: int, *args: Any, **kwargs: Any) -> None:
            if self._marks.first < 0:
                self.mark(first=version, whole=version)
            elif version == self._marks.first + self._gathered:  # the best policy is published under a number beyond it
                self.mark(whole=version, phase=Phase.RECORDING)
            publish(hub, version, *args, **kwargs)

        def marked_save(folder: Path, state: dict[str, Any], *args: Any) -> Path:
            found = self.during(Phase.CHECKPOINTING, save)(folder, state, *args)
            self.mark(saved=state["past"]["state"]["version"])
            return found

        Hub.gather = marked_gather  # type: ignore[assignment,method-assign]
        Hub.publish = marked_publish  # type: ignore[assignment]
        Hub.end_evaluation = self.during(Phase.EVALUATING, Hub.end_evaluation)  # type: ignore[method-assign]
        Hub.drain = self.during(Phase.DRAINING, Hub.drain, Phase.LEAVING)  # type: ignore[method-assign]
        checkpoint.save = marked_save  # type: ignore[assignment]
        RunFolder.write_policy = self.during(Phase.CHECKPOINTING, RunFolder.write_policy)  # type: ignore[method-assign]


def run(file: Path, arguments: list[str]) -> int:
    """Run `millrace ARGUMENTS` and mark what it does. Returns the exit code."""
    Marker(file).wrap()
    from millrace.cli.main import main

    return main(arguments)


def serve_forks() -> None:
    """For each line of stdin, a JSON object, fork a process that runs it. Prints its pid, then its exit code."""
    for module in IMPORTED:
        import_module(module)
    for line in sys.stdin:
        order = json.loads(line)
        sys.stdout.flush()
        if (pid := os.fork()) == 0:
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            said = os.open(order["said"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(said, 1)
            os.dup2(said, 2)
            os.environ.update(order["environment"])
            tempfile.tempdir = None  # TMPDIR may be another
            sys.exit(run(Path(order["marks"]), order["arguments"]))
        sys.stdout.write(f"{pid}\n")
        sys.stdout.flush()
        sys.stdout.write(f"{os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    if sys.argv[1:] == ["--fork"]:
        serve_forks()
    else:
        sys.exit(run(Path(sys.argv[1]), sys.argv[2:]))
