"""A run on this machine: the learner in this process, and worker processes (threads, over inproc) of its own.

The law: whatever happens, no worker, socket file or folder of ours is left behind.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path

import zmq

from learner.config import Config
from learner.listening import throwaway
from learner.run import Run, Watch
from protocol.errors import UsageError
from protocol.key_folder import asked_folder
from protocol.keys import Token
from protocol.link import LearnerLink
from protocol.specs import EnvSpec
from workers.host import Host, Process, Running, Thread


def train(config: Config, resume: Path | None, watch: Watch, factory: Callable[..., object] | None = None) -> Path:
    """A whole run on this machine; its folder. `factory` makes the environment, if its id does not.

    Raises `OurError`, or `Interrupted` when the user stopped it.
    """
    sealed = config.transport == "tcp" and asked_folder(config.keys) is not None and not config.insecure
    if factory is not None and config.transport == "tcp" and not sealed:
        raise UsageError("an environment factory is code: it travels over ipc or inproc only, or over tcp with --keys")
    with ExitStack() as stack:
        address = _address(config, stack)
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.term)
        keyring, token = throwaway("local", datetime.now(UTC)) if sealed else (None, None)
        link = LearnerLink(address, context, keyring)
        stack.callback(link.close, 0.5)
        env = EnvSpec.of(config.env if factory is None else factory, config.env_kwargs)
        run = Run(config, env, link, resume, watch)
        host = Host(_starter(config, link.address, token, context, run.folder.path), config.workers)
        stack.callback(host.stop)
        run.journal.workers_expected = config.workers
        run.go(config.min_workers or config.workers, host.poll)
        return run.folder.path


def _address(config: Config, stack: ExitStack) -> str:
    match config.transport:
        case "inproc":
            return f"inproc://millrace-{os.getpid()}-{time.monotonic_ns()}"
        case "tcp":
            return "tcp://127.0.0.1:*"
        case "ipc":
            folder = tempfile.mkdtemp(prefix="millrace-")  # 0700: the operating system decides who may connect
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            return f"ipc://{folder}/learner"


def _starter(
    config: Config, address: str, token: Token | None, context: zmq.Context[zmq.Socket[bytes]], run: Path
) -> Callable[[str], Running]:
    if config.transport == "inproc":
        return lambda name: Thread(address, name, context)
    logs = run / "workers"
    logs.mkdir(exist_ok=True)
    if config.pin_workers and not hasattr(os, "sched_setaffinity"):
        raise UsageError("pin_workers: this system does not let a process keep to one core")
    cores = sorted(os.sched_getaffinity(0)) if config.pin_workers else []

    def start(name: str) -> Process:
        flags = ["--step-timeout-s", str(config.step_timeout_s)]
        if cores:
            flags += ["--core", str(cores[int(name.removeprefix("w")) % len(cores)])]
        return Process(address, name, logs / f"{name}.log", token, flags)

    return start
