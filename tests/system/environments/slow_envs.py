"""Environments whose calls take seconds, and environments that end or block their process in different ways.

They do so only in a worker process.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from typing import Any

import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv, PendulumEnv

from millrace.protocol.arrays import Floats
from tests.support.envs.toy import Countdown, Info

IN_WORKER = "--parent" in sys.argv


class Slow(Countdown):
    """Each call takes so many seconds, asleep; with `holds_lock`, in C code that holds the interpreter's lock."""

    def __init__(
        self, make_s: float = 0.0, reset_s: float = 0.0, step_s: float = 0.0, k: int = 5, holds_lock: bool = False
    ) -> None:
        self._holds_lock = holds_lock
        self._sleep(make_s)
        super().__init__(k)
        self._reset_s, self._step_s = reset_s, step_s

    def _sleep(self, seconds: float) -> None:
        if not IN_WORKER:
            return
        if self._holds_lock and seconds:
            ctypes.PyDLL(None).usleep(ctypes.c_uint(int(seconds * 1e6)))
        else:
            time.sleep(seconds)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Floats, Info]:
        """Sleep, then start."""
        self._sleep(self._reset_s)
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, Info]:
        """Sleep, then count down."""
        self._sleep(self._step_s)
        return super().step(action)


class SometimesSlow(CartPoleEnv):
    """CartPole. In each process some constructions, resets and steps take so many seconds; they are noted in a file.

    A line of the file: the pid, and `construct`, `reset` or `step`.
    """

    calls: Counter[str] = Counter()

    def __init__(
        self, seconds: float = 2.5, construct: int = 9, reset: int = 50, step: int = 10_000, notes: str = ""
    ) -> None:
        """`construct`, `reset`, `step`: every how many such calls of this process are slow."""
        self._seconds, self._notes = seconds, notes
        self._every = {"construct": construct, "reset": reset, "step": step}
        self._call("construct")
        super().__init__()

    def _call(self, name: str) -> None:
        self.calls[name] += 1
        if IN_WORKER and self.calls[name] % self._every[name] == 0:
            with open(self._notes, "a") as file:
                file.write(f"{os.getpid()} {name}\n")
            time.sleep(self._seconds)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> Any:
        """As CartPole's, but now and then slow."""
        self._call("reset")
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        """As CartPole's, but now and then slow."""
        self._call("step")
        return super().step(action)  # type: ignore[no-untyped-call]


class BreaksWhileRepeated(PendulumEnv):
    """Pendulum, with slow steps and episodes of 150, whose copies break once, when they continue an episode.

    A copy that is made while the file `trap` exists does in its second step what the file says: `dies`, `raises` or `hangs`.
    Then the file is gone, so later copies work.
    """

    def __init__(self, trap: str = "", step_s: float = 0.002) -> None:
        super().__init__()
        self._step_s = step_s
        self._trap = trap if IN_WORKER and os.path.exists(trap) else ""
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> Any:
        """As Pendulum's."""
        self._steps = 0
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        """As Pendulum's, but in the second step of a copy with a trap."""
        if IN_WORKER:
            time.sleep(self._step_s)
        self._steps += 1
        if self._trap and self._steps == 2:
            self._spring()
        *row, _, info = super().step(action)  # type: ignore[no-untyped-call]
        return (*row, self._steps == 150, info)

    def _spring(self) -> None:
        mine = f"{self._trap}.{os.getpid()}"
        try:
            os.rename(self._trap, mine)
        except FileNotFoundError:
            return  # another copy was faster
        with open(mine) as file:
            what = file.read()
        match what:
            case "dies":
                os.kill(os.getpid(), signal.SIGKILL)
            case "raises":
                raise ValueError("the trap was sprung")
            case "hangs":
                time.sleep(3600)


class UnevenPendulum(PendulumEnv):
    """Pendulum, whose steps take so many seconds; ten times as many in the process that was the first to make a file."""

    def __init__(self, step_s: float = 0.002, slow_file: str = "") -> None:
        super().__init__()
        self._step_s = step_s
        if IN_WORKER:
            try:
                os.close(os.open(slow_file, os.O_CREAT | os.O_EXCL))
                self._step_s *= 10
            except FileExistsError:
                pass

    def step(self, action: Any) -> Any:
        """As Pendulum's, but later."""
        if IN_WORKER:
            time.sleep(self._step_s)
        return super().step(action)  # type: ignore[no-untyped-call]


class _Asleep:
    """The steps of the environment after it in the order of classes take so many seconds more."""

    def __init__(self, step_s: float = 0.0) -> None:
        super().__init__()
        self._step_s = step_s

    def step(self, action: Any) -> Any:
        """As that of the environment, but later."""
        if IN_WORKER:
            time.sleep(self._step_s)
        return super().step(action)  # type: ignore[misc]


class SlowCartPole(_Asleep, CartPoleEnv):
    """CartPole, in short episodes."""


class SlowPendulum(_Asleep, PendulumEnv):
    """Pendulum, in short episodes."""


class Ends(Countdown):
    """Ends its process, in the way of `how`, at step `after` of a process, counted over all copies, and at no later one."""

    steps = 0

    def __init__(self, how: str = "exit 0", after: int = 500) -> None:
        super().__init__()
        self._how, self._after = how, after

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, Info]:
        """Count down, or end the process."""
        Ends.steps += 1
        if IN_WORKER and Ends.steps == self._after:
            self._end()
        return super().step(action)

    def _end(self) -> None:
        match self._how.split("-"):
            case "sys.exit", code:
                sys.exit(int(code))
            case "os.exit", code:
                os._exit(int(code))
            case ["segfault"]:
                ctypes.string_at(0)
            case ["kill"]:
                os.kill(os.getpid(), signal.SIGKILL)


class LeavesThings(Countdown):
    """Starts a child process and a thread that never end, ignores signals, and hangs in `close`."""

    def __init__(self, pid_file: str = "") -> None:
        super().__init__()
        if IN_WORKER:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(3600)"])
            with open(pid_file, "a") as file:
                file.write(f"{child.pid}\n{os.getpid()}\n")
            threading.Thread(target=time.sleep, args=(3600,), daemon=False).start()

    def close(self) -> None:
        """Do not return."""
        if IN_WORKER:
            time.sleep(3600)


gymnasium.register("SometimesSlow-v0", f"{__name__}:SometimesSlow", max_episode_steps=500)
gymnasium.register("UnevenPendulum-v0", f"{__name__}:UnevenPendulum", max_episode_steps=200)
for _short in (SlowCartPole, SlowPendulum):
    gymnasium.register(f"{_short.__name__}-v0", f"{__name__}:{_short.__name__}", max_episode_steps=30)
for _kind in (Slow, Ends, LeavesThings):
    gymnasium.register(f"{_kind.__name__}-v0", f"{__name__}:{_kind.__name__}")
