"""The program of a preloaded parent: it has imported what its commands import, and forks a child for each command.

There is one for learners, with PyTorch, and one for workers, without. A learner or a supervisor that was forked has one of
its own, for its workers. A worker becomes a child of the process that asks for it, because the two look at each other as
child and parent.

Rule: a child is what `python -m MODULE` would be: argv, environment, folder, open files, signals and exit are those of
a process of its own. The parent has one thread, no open files but its socket, and runs nothing but imports before it forks.
`tests/system/stage/preloaded.py` is its other end, and says which commands may be forked.
"""

from __future__ import annotations

import ctypes
import fcntl
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
import time
from pathlib import Path
from types import ModuleType
from typing import Any

CLONE_NEWNET = 0x40000000  # of linux/sched.h
MOST_BYTES, MOST_FILES = 1 << 18, 16
ADOPTED_WITHIN_S = 10.0
LEARNER = (
    "torch",
    "millrace.learner.config.command_line",
    "millrace.learner.imports_ahead",
    "millrace.learner.open_run",
    "millrace.learner.whole_run",
    "millrace.learner.run_spec",
    "threadpoolctl",
    "millrace.learner.train",
    "millrace.learner.algorithms.a2c",
    "millrace.learner.algorithms.dqn",
    "millrace.learner.algorithms.impala",
    "millrace.learner.algorithms.ppo",
    "millrace.learner.algorithms.reinforce",
    "millrace.launch.learner_inference",
    "millrace.launch.training",
    "millrace.terminal",
    "safetensors.numpy",
)
WORKER = (
    "gymnasium.envs.classic_control",
    "tests.system.stage.preloaded",
    "millrace.workers.__main__",
    "millrace.workers.program",
)
START_WORKERS = (["millrace.workers"], *(["millrace", command] for command in ("evaluate", "record", "train", "worker")))


def import_ahead(modules: tuple[str, ...]) -> None:
    """Import these. Raises `AssertionError` if that started a thread, which no fork would copy."""
    if "torch" in modules:
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before PyTorch, as `known_environment` does
    for name in modules:
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
        line, descriptors, _, _ = socket.recv_fds(requests, MOST_BYTES, MOST_FILES)
        if not line:
            sys.exit()
        request = json.loads(line)
        if "reap" in request:
            answer = os.waitpid(request["reap"], 0)[1]
        elif (answer := fork_for_our_parent() if "passed" in request else os.fork()) == 0:
            requests.close()
            become(request, descriptors, own_paths, on_interrupt)
            if "passed" in request or not any(request["argv"][: len(each)] == each for each in START_WORKERS):
                return str(request["argv"][0])
            ours, requests = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            if os.fork() != 0:
                requests.close()
                ask_for_workers(ours)
                return str(request["argv"][0])
            ours.close()
            stand_aside()
            continue
        for each in descriptors:
            os.close(each)
        requests.send(str(answer).encode())


def fork_for_our_parent() -> int:
    """Fork a child of the process that started this one. Returns its id, and in the child 0, once that is its parent.

    Our child forks it and ends. Whoever asked for it is a subreaper meanwhile, so that the orphan becomes its child.
    """
    wanted = os.getppid()
    reads, writes = os.pipe()
    if (between := os.fork()) == 0:
        if (made := os.fork()) != 0:
            os.write(writes, str(made).encode())
            os._exit(0)
        os.close(reads)
        os.close(writes)
        deadline_s = time.monotonic() + ADOPTED_WITHIN_S
        while os.getppid() != wanted:
            if time.monotonic() > deadline_s:
                os._exit(1)  # whoever asked for it has ended
            os.sched_yield()
        return 0
    os.close(writes)
    with open(reads, "rb") as pipe:
        os.waitpid(between, 0)
        return int(os.read(pipe.fileno(), 64))


def ask_for_workers(parent: socket.socket) -> None:
    """Let this process start its workers by asking the preloaded parent at the other end."""
    from millrace.workers.supervise import worker_process
    from tests.system.stage import preloaded

    preloaded.use_parent(parent)
    worker_process.popen = preloaded.start_worker  # type: ignore[assignment]


def stand_aside() -> None:
    """Let go of the standard streams and the signals of the process whose workers this one forks."""
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in range(3):
        os.dup2(nothing, number)
    os.close(nothing)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def become(request: dict[str, Any], descriptors: list[int], own_paths: list[str], on_interrupt: Any) -> None:
    """Make this process what the interpreter would have made of it."""
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    if request.get("namespace"):
        enter_network_namespace(request["namespace"])
    if "passed" in request:
        os.setsid()
    put_in_place(descriptors, [0, 1, 2, *request.get("passed", [])])
    unbuffered = bool(os.environ.get("PYTHONUNBUFFERED"))
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = standard_stream(number, getattr(sys, name), unbuffered)
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)
    given = [os.path.abspath(path) for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    here = [] if "passed" in request else [os.getcwd()]  # a worker is started with -P
    sys.path[:] = [*here, *given, *(path for path in own_paths if path not in given)]
    sys.path_importer_cache.clear()
    sys.argv[:] = ["-m", *request["argv"][1:]]
    sys.orig_argv[:] = [sys.executable, *(() if here else ("-P",)), "-m", *request["argv"]]
    sys.modules["__main__"] = ModuleType("__main__")
    sys.modules.pop(f"{request['argv'][0]}.__main__", None)  # else there is a warning that it is imported already
    signal.signal(signal.SIGINT, on_interrupt)
    random.seed()
    sys.modules["numpy"].random.seed()  # children must not draw the same numbers


def enter_network_namespace(name: str) -> None:
    """Do with this process what `ip netns exec` does with the one that it executes."""
    with Path("/run/netns", name).open() as file:
        assert ctypes.CDLL(None, use_errno=True).setns(file.fileno(), CLONE_NEWNET) == 0, ctypes.get_errno()


def put_in_place(received: list[int], numbers: list[int]) -> None:
    """Give the descriptors that were received the numbers that they have in the process that sent them."""
    above = max(*received, *numbers) + 1
    moved = [fcntl.fcntl(each, fcntl.F_DUPFD, above) for each in received]
    for each in received:
        os.close(each)
    for each, number in zip(moved, numbers, strict=True):
        os.dup2(each, number)
        os.close(each)


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
    sys.path.insert(0, str(Path(__file__).parents[3]))
    interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the tests, which then end it
    import_ahead(WORKER if sys.argv[2] == "worker" else LEARNER + WORKER)
    runpy._run_module_as_main(serve(socket.socket(fileno=int(sys.argv[1])), own, interrupt))  # type: ignore[attr-defined]
