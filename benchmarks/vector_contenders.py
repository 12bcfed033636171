"""The vector environments that are compared, all with the same interface: `rate(seconds)` and `close()`.

All step the same env copies with actions that were sampled beforehand, except TorchRL, which samples actions itself, in its
own format. All reset a copy whose episode has ended. tianshou leaves this to its user, so the step function here does it.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np
import psutil
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

import millrace
from benchmarks.collect import Pair

OURS: dict[str, dict[str, Any]] = {
    "millrace": {},
    "millrace, messages, ipc": {"shared_memory": False},
    "millrace, messages, tcp": {"transport": "tcp", "shared_memory": False},
}
LIMIT = "bare loop, 2 processes"
ASYNC = "gymnasium Async"


class Task(NamedTuple):
    """The env copies to step, and the processes that step them."""

    title: str
    env: str
    copies: int
    workers: int
    """number of processes of millrace and TorchRL; the other libraries start one for each copy"""
    kwargs: dict[str, Any] = {}

    def make(self) -> gymnasium.Env[Any, Any]:
        return gymnasium.make(self.env, **self.kwargs)


class Contender(Protocol):
    def rate(self, seconds: float) -> float:
        """Env steps/s, measured over this time."""
        ...

    def close(self) -> None: ...


class Stepping:
    """A contender that steps all copies with `step(actions)`."""

    def __init__(self, task: Task, env: Any, step: Callable[[Any], Any] | None = None) -> None:
        self._env = env
        self._copies = task.copies
        self._step = step or env.step
        space: Any = task.make().action_space
        self._actions = np.random.default_rng(task.copies).integers(space.n, size=(1000, task.copies))
        self.close: Callable[[], None] = env.close

    def rate(self, seconds: float) -> float:
        steps = 0
        start = time.perf_counter()
        while (now := time.perf_counter()) - start < seconds:
            self._step(self._actions[steps % len(self._actions)])
            steps += 1
        return steps * self._copies / (now - start)


def make(name: str, task: Task) -> Contender:
    """Make a contender. Raises `ImportError` if its library is not installed."""
    copies = task.copies
    makers = [task.make] * task.copies
    match name:
        case "gymnasium Sync" | "gymnasium Async":
            env: Any = (SyncVectorEnv if name == "gymnasium Sync" else AsyncVectorEnv)(makers)
            env.reset(seed=1)
            return Stepping(task, env)
        case "SB3 DummyVecEnv" | "SB3 SubprocVecEnv":
            vec_env = import_module("stable_baselines3.common.vec_env")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                env = (vec_env.DummyVecEnv if name == "SB3 DummyVecEnv" else vec_env.SubprocVecEnv)(makers)
            env.seed(1)
            env.reset()
            return Stepping(task, env)
        case "tianshou Shmem":
            return _tianshou(task, makers)
        case "TorchRL ParallelEnv":
            return _torchrl(task)
        case "bare loop, 2 processes":
            return Pair("bare, drawn", copies // 2)
        case _:
            env = millrace.make_vec(task.env, copies, workers=task.workers, **OURS[name], **task.kwargs)
            env.reset(seed=1)
            return Stepping(task, env)


def _tianshou(task: Task, makers: list[Callable[[], gymnasium.Env[Any, Any]]]) -> Contender:
    env: Any = import_module("tianshou.env").ShmemVectorEnv(makers)
    env.reset(seed=1)

    def step(actions: Any) -> None:
        _, _, terminated, truncated, _ = env.step(actions)
        if (ended := np.flatnonzero(terminated | truncated)).size:
            env.reset(ended)

    return Stepping(task, env, step)


def _torchrl(task: Task) -> Contender:
    envs = import_module("torchrl.envs")
    each = task.copies // task.workers

    def serial() -> Any:
        return envs.SerialEnv(each, lambda: envs.GymWrapper(task.make()))

    env: Any = envs.ParallelEnv(task.workers, serial)
    now = env.reset()

    def step(actions: Any) -> None:
        nonlocal now
        _, now = env.step_and_maybe_reset(env.rand_action(now))

    return Stepping(task, env, step)


def memory_mb(name: str, task: Task) -> tuple[int, float]:
    """The number of processes that a contender starts, and their memory together (proportional set size) in MB."""
    this_process = psutil.Process()
    before = {process.pid for process in this_process.children(recursive=True)}
    contender = make(name, task)
    contender.rate(1.0)
    started = [process for process in this_process.children(recursive=True) if process.pid not in before]
    try:
        return len(started), sum(_pss_kb(process.pid) for process in started) / 1e3
    finally:
        contender.close()


def _pss_kb(pid: int) -> int:
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
