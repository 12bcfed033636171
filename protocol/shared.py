"""Memory that a learner and its worker processes share, and the bells by which they wake each other.

The law: a lane's words are written by one side each. The learner lays the actions and then raises `ordered`; the worker
lays what the step gave and then raises `answered` to the same number; only then does the other side look. Nothing of it has
a name in any file system: the memory is an unlinked file and the bells are eventfds, handed to the children at their start,
so nothing can be left behind, whoever dies. Linux only; elsewhere everything travels as messages.
"""

from __future__ import annotations

import mmap
import os
import platform
import select
from collections.abc import Iterator
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from protocol.specs import StepSpec

Array = npt.NDArray[Any]

POSSIBLE = hasattr(os, "memfd_create") and hasattr(os, "eventfd")
LINE = 64  # bytes of a cache line: each lane's words have lines of their own
WORDS = LINE // 8
INFO_BYTES = 1 << 20  # of a lane, at least; what is longer travels as a message
MESSAGE = 1 << 32  # a bell that was rung by so much, or more, was rung for a message
ELSEWHERE = -1  # in place of the number of bytes: the infos of this step travel as a message
# x86 lets nobody see a later store before an earlier one. Elsewhere only a system call orders them: no spinning there.
MAY_SPIN = platform.machine() in {"x86_64", "AMD64", "i686"}


class Handed(NamedTuple):
    """What a worker process is given at its start: file descriptors that it inherits."""

    memory: int
    to_worker: int
    """eventfd, rung by the learner"""
    to_learner: int
    """eventfd, rung by the worker"""


class LaneMemory(NamedTuple):
    """A lane's part of the memory, as views."""

    actions: tuple[Array, ...]  # [N, *leaf] each
    obs: tuple[Array, ...]  # [N, *leaf] each
    reward: Array  # [N] float64
    terminated: Array  # [N] bool
    truncated: Array  # [N] bool
    infos: memoryview  # bytes


class Memory:
    """The memory of one vector environment, as one side sees it."""

    def __init__(self, spec: StepSpec, fd: int | None = None) -> None:
        """Made by the learner; mapped by a worker, which was handed its `fd`."""
        N, lanes = len(spec.copies), len(spec.lanes)
        self._offset = 2 * LINE * lanes
        places = [self._place(N, leaf.shape, leaf.dtype) for leaf in (*spec.action, *spec.observation)]
        flags = [self._place(N, (), dtype) for dtype in ("float64", "bool", "bool")]
        observed = sum(np.dtype(leaf.dtype).itemsize * int(np.prod(leaf.shape)) for leaf in spec.observation)
        self.info_bytes = [INFO_BYTES + 2 * observed * copies for copies in spec.lanes]
        infos = self._offset
        self.fd = os.memfd_create("millrace", os.MFD_CLOEXEC) if fd is None else fd
        size = infos + sum(self.info_bytes)
        if fd is None:
            os.ftruncate(self.fd, size)
        elif os.fstat(fd).st_size != size:
            raise ValueError(f"shared memory expected {size} bytes, got {os.fstat(fd).st_size}")
        memory = mmap.mmap(self.fd, size)
        self._words = memoryview(memory)[: 2 * LINE * lanes].cast("q")
        arrays = [
            np.frombuffer(memory, dtype, N * int(np.prod(shape)), at).reshape(N, *shape)
            for at, shape, dtype in (*places, *flags)
        ]
        self.actions, self.obs = tuple(arrays[: len(spec.action)]), tuple(arrays[len(spec.action) : -3])
        """[num_envs, *leaf] each, all lanes together"""
        self.reward, self.terminated, self.truncated = arrays[-3:]
        self.lanes = []
        for lane, copies in enumerate(spec.lanes):
            rows = slice(spec.first(lane), spec.first(lane) + copies)
            actions, obs = (tuple(array[rows] for array in leaves) for leaves in (self.actions, self.obs))
            view = memoryview(memory)[infos : infos + self.info_bytes[lane]]
            reward, terminated, truncated = self.reward[rows], self.terminated[rows], self.truncated[rows]
            self.lanes.append(LaneMemory(actions, obs, reward, terminated, truncated, view))
            infos += self.info_bytes[lane]

    def _place(self, copies: int, shape: tuple[int, ...], dtype: str) -> tuple[int, tuple[int, ...], str]:
        at = self._offset
        size = copies * int(np.prod(shape)) * np.dtype(dtype).itemsize
        self._offset += -(-size // LINE) * LINE
        return at, shape, dtype

    def ordered(self, lane: int) -> int:
        """Number of the newest order."""
        return self._words[2 * WORDS * lane]

    def order(self, lane: int, number: int) -> None:
        """The actions are laid: step."""
        self._words[2 * WORDS * lane] = number

    def answered(self, lane: int) -> int:
        """Number of the newest order that is done."""
        return self._words[2 * WORDS * lane + WORDS]

    def answer(self, lane: int, number: int, infos: bytes) -> bool:
        """The step is done. False if the infos do not fit here: they are to travel as a message."""
        fits = len(infos) <= self.info_bytes[lane]
        if infos and fits:
            self.lanes[lane].infos[: len(infos)] = infos
        self._words[2 * WORDS * lane + WORDS + 1] = len(infos) if fits else ELSEWHERE
        self._words[2 * WORDS * lane + WORDS] = number
        return fits

    def infos(self, lane: int) -> bytes | None:
        """The packed infos of the newest answer; None if they travel as a message."""
        size = self._words[2 * WORDS * lane + WORDS + 1]
        return None if size == ELSEWHERE else bytes(self.lanes[lane].infos[:size])

    def close(self) -> None:
        """Let go of the descriptor; the memory goes with the last view on it."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


class Bell:
    """An eventfd: rung by one process, waited for by another."""

    def __init__(self, fd: int | None = None) -> None:
        """A new one, or one that was handed over."""
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC) if fd is None else fd
        self._poll = select.poll()
        self._poll.register(self.fd, select.POLLIN)

    def ring(self, by: int = 1) -> None:
        """Wake whoever waits, or will: for a step, or by MESSAGE for a message."""
        os.eventfd_write(self.fd, by)

    def wait(self, timeout_s: float) -> int:
        """Sleep until it is rung, at most `timeout_s`: the sum of what it was rung by, 0 if it was not.

        Rung for a step that was seen without sleeping, it wakes the next sleeper for nothing.
        """
        if not self._poll.poll(timeout_s * 1000):
            return 0
        try:
            return os.eventfd_read(self.fd)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Let go of it."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


def spin(seconds: float) -> Iterator[None]:
    """Turns of waiting awake, each of which lets others run first."""
    if not MAY_SPIN or seconds <= 0:
        return
    until = perf_counter() + seconds
    while perf_counter() < until:
        yield
        os.sched_yield()
