"""A vector environment on this machine: worker processes of its own, shared memory where there is any; or workers elsewhere.

The law: whatever happens, no worker, socket file or folder of ours is left behind.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from typing import Literal

import zmq
from gymnasium.vector import AutoresetMode

from learner.members.endpoint import Bind, join_lines, keyring_for
from learner.vector_env.env import ZmqVectorEnv
from learner.vector_env.spec import Env, describe
from learner.vector_env.step_hub import LockstepHub, Shared
from millrace.launch.local_workers import StartFlags, own_address, own_keys
from protocol.address import advertised, check_address
from protocol.cpu_cores import cores
from protocol.errors import UsageError
from protocol.keys.key_folder import Keyring
from protocol.keys.keys import Token
from protocol.specs import Scalar
from protocol.wire.link import LearnerLink
from protocol.wire.shared_memory import POSSIBLE, SPIN_S, Bell, Handed, Memory
from workers.host import Host, Process, Running, Thread

log = logging.getLogger("millrace.learner")

CLOSE_S = 5.0  # for workers to leave; then they are killed
JOIN_S = 60.0
WORKER_TIMEOUT_S = 5.0  # a worker elsewhere that is silent for so long, while it is listened to, is given up
THINK_S = 600.0  # between two steps, at most: then workers elsewhere take it that the learner is gone
STEP_TIMEOUT_LEAST_S, STEP_TIMEOUT_MOST_S = 60.0, 1e6


def make_vec(
    env: Env | Sequence[Env],
    num_envs: int | None,
    *,
    workers: int | None,
    lanes: int | None,
    where: Bind,
    transport: Literal["ipc", "tcp", "inproc"],
    shared_memory: bool,
    autoreset_mode: AutoresetMode | str,
    on_worker_loss: Literal["truncate", "raise"],
    timeout_s: float,
    copy: bool,
    render_mode: str | None,
    kwargs: dict[str, Scalar],
    begin: Callable[[], StartFlags] | None = None,
) -> ZmqVectorEnv:
    """See `millrace.make_vec`. `begin`: called once the address is bound; then the workers are started with these flags, and
    whoever called waits for them.
    """
    copies = num_envs if num_envs is not None else (1 if isinstance(env, str) or callable(env) else len(env))
    if where.bind and workers:
        raise UsageError(f"workers expected 0 with a bind address, for they are started elsewhere, got {workers}")
    count = 0 if where.bind else min(workers if workers is not None else (os.cpu_count() or 1), copies)
    # Workers of ours end with this process, and their ends are known at once: neither side judges the other's silence.
    think_s, worker_timeout_s = (THINK_S, WORKER_TIMEOUT_S) if where.bind else (math.inf, math.inf)
    described = describe(env, num_envs, lanes or max(count, 1), autoreset_mode, render_mode, kwargs, think_s)
    with ExitStack() as stack:
        address = where.bind or own_address(transport, stack)
        keyring, token = _keys(where, transport)
        if address.startswith("tcp://") and keyring is None and any(one.factory is not None for one in described.step.envs):
            raise UsageError("an environment factory is code: it travels over ipc or inproc only, or over tcp with keys")
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.term)
        link = LearnerLink(address, context, keyring)
        stack.callback(link.close, 0.5)
        shared = None
        if shared_memory and POSSIBLE and count and transport != "inproc":
            for_us = Bell()  # rung once a step, by the worker that is done last
            shared = Shared(Memory(described.step), {f"w{n}": (Bell(), for_us) for n in range(count)})
            stack.callback(shared.close)
        flags = begin() if begin is not None else lambda name: (["--step-timeout-s", str(_step_timeout_s(timeout_s))], None)
        start = _starter(transport, link.address, token, context, shared, flags)
        host = Host(start, count) if count else None
        hub = LockstepHub(
            link,
            described.step,
            first_session=int.from_bytes(os.urandom(6), "little"),
            staff=host,
            shared=shared,
            worker_timeout_s=worker_timeout_s,
            spin_s=SPIN_S if count < cores() else 0.0,  # there is a core that no worker needs
        )
        stack.callback(hub.close, CLOSE_S)
        if host is None:
            for line in join_lines(link.address, where.advertise, keyring):
                log.warning("%s", line)
        if begin is None:
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


def _keys(where: Bind, transport: str) -> tuple[Keyring | None, Token | None]:
    """Who may connect, and with what workers of ours do."""
    if not where.bind:
        return own_keys(transport, where.keys, insecure=where.insecure)
    check_address(advertised("tcp://*:1", where.advertise, "machine"))
    return keyring_for(where, datetime.now(UTC).replace(microsecond=0)), None


def _starter(
    transport: str,
    address: str,
    token: Token | None,
    context: zmq.Context[zmq.Socket[bytes]],
    shared: Shared | None,
    flags: StartFlags,
) -> Callable[[str], Running]:
    if transport == "inproc":
        return lambda name: Thread(address, name, context)

    def start(name: str) -> Process:
        handed = None
        if shared is not None:
            to_worker, to_learner = shared.bells[name]
            handed = Handed(shared.memory.fd, to_worker.hears, to_learner.rings)
        own, log_file = flags(name)
        return Process(address, name, log_file, token, own, handed)

    return start


def _step_timeout_s(timeout_s: float) -> float:
    """When a worker of ours ends itself because a step hangs; 0: never.

    Well after this process, which kills whoever has not answered within `timeout_s`: it is for when nobody waits any more.
    """
    return max(STEP_TIMEOUT_LEAST_S, 2 * timeout_s) if timeout_s < STEP_TIMEOUT_MOST_S else 0.0
