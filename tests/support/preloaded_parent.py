"""The program of a preloaded parent: it has imported PyTorch and the learner, and forks a child for each command.

Rule: a child is what `python -m MODULE` would be: argv, environment, folder, standard streams, signals and exit are those of
a process of its own. The parent has one thread, no open files but its socket, and runs nothing but imports before it forks.
`tests/support/preloaded.py` is its other end, and says which commands may be forked.
"""

from __future__ import annotations

import gc
import importlib
import io
import json
import os
import random
import runpy
import signal
import socket
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

MOST_BYTES = 1 << 18
MODULES = (
    "torch",
    "torch.utils.tensorboard",
    "learner.config.command_line",
    "learner.imports_ahead",
    "learner.run",
    "learner.run_recorder",
    "learner.run_spec",
    "learner.torch_setup",
    "learner.train",
    "learner.algorithms.a2c",
    "learner.algorithms.dqn",
    "learner.algorithms.impala",
    "learner.algorithms.ppo",
    "learner.algorithms.reinforce",
    "millrace.launch.learner_inference",
    "millrace.launch.local_run",
    "millrace.terminal",
    "safetensors.numpy",
)


def import_ahead() -> None:
    """Import what a learner imports. Raises `AssertionError` if that started a thread, which no fork would copy."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before PyTorch, as `known_environment` does
    for name in MODULES:
        importlib.import_module(name)
    threads = os.listdir("/proc/self/task")
    assert len(threads) == 1, f"an import started a thread: expected 1, got {len(threads)}"
    gc.collect()
    gc.freeze()  # a garbage collection of a child does not copy the pages of what was imported


def serve(requests: socket.socket, own_paths: list[str], on_interrupt: Any) -> str:
    """Fork a child for each request and reap it when asked, until the other end is closed.

    Returns, in a child only, the module that it must run.
    """
    while True:
        line, descriptors, _, _ = socket.recv_fds(requests, MOST_BYTES, 3)
        if not line:
            sys.exit()
        request = json.loads(line)
        if "reap" in request:
            answer = os.waitpid(request["reap"], 0)[1]
        elif (answer := os.fork()) == 0:
            requests.close()
            become(request, descriptors, own_paths, on_interrupt)
            return str(request["argv"][0])
        for each in descriptors:
            os.close(each)
        requests.send(str(answer).encode())


def become(request: dict[str, Any], descriptors: list[int], own_paths: list[str], on_interrupt: Any) -> None:
    """Make this process what the interpreter would have made of it."""
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    for number, received in enumerate(descriptors):
        os.dup2(received, number)
        os.close(received)
    unbuffered = bool(os.environ.get("PYTHONUNBUFFERED"))
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = standard_stream(number, getattr(sys, name), unbuffered)
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)
    given = [os.path.abspath(path) for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    sys.path[:] = [os.getcwd(), *given, *(path for path in own_paths if path not in given)]
    sys.path_importer_cache.clear()
    sys.argv[:] = ["-m", *request["argv"][1:]]
    sys.orig_argv[:] = [sys.executable, "-m", *request["argv"]]
    sys.modules["__main__"] = ModuleType("__main__")
    signal.signal(signal.SIGINT, on_interrupt)
    random.seed()
    sys.modules["numpy"].random.seed()  # children must not draw the same numbers


def standard_stream(number: int, like: Any, unbuffered: bool) -> io.TextIOWrapper:
    """Standard stream `number` as the interpreter opens it, with the encoding of its own."""
    writes = number > 0
    raw: Any = io.FileIO(number, "wb" if writes else "rb", closefd=False)
    raw.name = like.name
    buffer: Any = raw if unbuffered and writes else (io.BufferedWriter if writes else io.BufferedReader)(raw)
    return io.TextIOWrapper(
        buffer,
        like.encoding,
        like.errors,
        newline="\n" if writes else None,
        line_buffering=not unbuffered and (number == 2 or os.isatty(number)),
        write_through=unbuffered,
    )


if __name__ == "__main__":
    own = list(sys.path)
    sys.path.insert(0, str(Path(__file__).parents[2]))
    interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the tests, which then end it
    import_ahead()
    runpy._run_module_as_main(serve(socket.socket(fileno=int(sys.argv[1])), own, interrupt))  # type: ignore[attr-defined]
