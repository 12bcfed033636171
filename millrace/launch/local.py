"""A run on this machine: the learner in this process, and worker processes (threads, over inproc) of its own.

The law: whatever happens, no worker, socket file or folder of ours is left behind.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import zmq

from learner.config import Config
from learner.exposition import exposed
from learner.run import Run, Watch
from millrace.launch.here import own_address, own_keys
from protocol.errors import UsageError
from protocol.keys import Token
from protocol.link import LearnerLink
from protocol.specs import EnvSpec
from workers.host import Host, Process, Running, Thread


def train(config: Config, resume: Path | None, watch: Watch, factory: Callable[..., object] | None = None) -> Path:
    """A whole run on this machine; its folder. `factory` makes the environment, if its id does not.

    Raises `OurError`, or `Interrupted` when the user stopped it.
    """
    keyring, token = own_keys(config.transport, config.keys, insecure=config.insecure)
    if factory is not None and config.transport == "tcp" and keyring is None:
        raise UsageError("an environment factory is code: it travels over ipc or inproc only, or over tcp with --keys")
    with ExitStack() as stack:
        address = own_address(config.transport, stack)
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.term)
        link = LearnerLink(address, context, keyring)
        stack.callback(link.close, 0.5)
        env = EnvSpec.of(config.env if factory is None else factory, config.env_kwargs)
        run = Run(config, env, link, resume, watch, stack.enter_context(exposed(config)))
        host = Host(_starter(config, link.address, token, context, run.folder.path), config.workers)
        stack.callback(host.stop)
        run.journal.workers_expected = config.workers
        run.go(config.min_workers or config.workers, host.poll)
        return run.folder.path


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
