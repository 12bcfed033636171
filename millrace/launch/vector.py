"""A vector environment on this machine: worker processes of its own, shared memory where there is any; or workers elsewhere.

The law: whatever happens, no worker, socket file or folder of ours is left behind.
"""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Literal

import zmq
from gymnasium.vector import AutoresetMode

from learner.lockstep_hub import LockstepHub, Shared
from learner.vector_env import ZmqVectorEnv
from learner.vector_spec import Env, describe
from protocol.errors import UsageError
from protocol.link import LearnerLink
from protocol.shared import POSSIBLE, Bell, Handed, Memory
from protocol.specs import Scalar
from workers.host import Host, Process, Running, Thread

CLOSE_S = 5.0  # for workers to leave; then they are killed
JOIN_S = 60.0


def make_vec(
    env: Env | Sequence[Env],
    num_envs: int | None,
    *,
    workers: int | None,
    lanes: int | None,
    bind: str | None,
    transport: Literal["ipc", "tcp", "inproc"],
    shared_memory: bool,
    autoreset_mode: AutoresetMode | str,
    on_worker_loss: Literal["truncate", "raise"],
    timeout_s: float,
    copy: bool,
    render_mode: str | None,
    kwargs: dict[str, Scalar],
) -> ZmqVectorEnv:
    """See `millrace.make_vec`."""
    copies = num_envs if num_envs is not None else (1 if isinstance(env, str) or callable(env) else len(env))
    count = min(workers if workers is not None else (os.cpu_count() or 1), copies)
    described = describe(env, num_envs, lanes or max(count, 1), autoreset_mode, render_mode, kwargs)
    remote = bind is not None or transport == "tcp"
    if remote and any(one.factory is not None for one in described.step.envs):
        raise UsageError("an environment factory is code: it travels over ipc or inproc only, not over tcp")
    with ExitStack() as stack:
        address = bind or _address(transport, stack)
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.term)
        link = LearnerLink(address, context)
        stack.callback(link.close, 0.5)
        shared = None
        if shared_memory and POSSIBLE and count and transport != "inproc":
            shared = Shared(Memory(described.step), {f"w{n}": (Bell(), Bell()) for n in range(count)})
            stack.callback(shared.close)
        host = Host(_starter(transport, link.address, context, shared), count) if count else None
        hub = LockstepHub(
            link, described.step, first_session=int.from_bytes(os.urandom(6), "little"), staff=host, shared=shared
        )
        stack.callback(hub.close, CLOSE_S)
        if host is None:
            logging.getLogger("millrace.learner").warning(
                "waiting for workers; start one with: python -m workers %s", link.address
            )
        hub.wait_for(count or len(described.step.lanes), JOIN_S if host is not None else timeout_s)
        kept = ExitStack()
        made = ZmqVectorEnv(
            described,
            hub,
            memory=None if shared is None else shared.memory,
            timeout_s=timeout_s,
            on_worker_loss=on_worker_loss,
            copy=copy,
            shut=kept.close,
        )
        kept.push(stack.pop_all())
        return made
    raise AssertionError  # the block returns or raises


def _address(transport: str, stack: ExitStack) -> str:
    match transport:
        case "inproc":
            return f"inproc://millrace-{os.getpid()}-{time.monotonic_ns()}"
        case "tcp":
            return "tcp://127.0.0.1:*"
        case "ipc":
            folder = tempfile.mkdtemp(prefix="millrace-")  # 0700: the operating system decides who may connect
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            return f"ipc://{folder}/learner"
        case _:
            raise UsageError(f"transport expected ipc, tcp or inproc, got {transport!r}")


def _starter(
    transport: str, address: str, context: zmq.Context[zmq.Socket[bytes]], shared: Shared | None
) -> Callable[[str], Running]:
    if transport == "inproc":
        return lambda name: Thread(address, name, context)
    if shared is None:
        return lambda name: Process(address, name, None)
    bells = shared.bells
    fd = shared.memory.fd
    return lambda name: Process(address, name, None, handed=Handed(fd, bells[name][0].fd, bells[name][1].fd))
