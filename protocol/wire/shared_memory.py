"""Memory that a learner and its worker processes share, and the bells by which they wake each other.

The law: a lane's words are written by one side each. The learner lays the actions and then raises `ordered`; the worker
lays what the step gave and then raises `answered` to the same number; only then does the other side look. Nothing of it has
a name in any file system: the memory is an unlinked file and the bells are pipes, handed to the children at their start,
so nothing can be left behind, whoever dies. Linux only; elsewhere everything travels as messages.
"""

from __future__ import annotations

import mmap
import os
import threading
from typing import NamedTuple

import numpy as np

from protocol.arrays import Array
from protocol.specs import StepSpec

SUPPORTED = hasattr(os, "memfd_create") and hasattr(os, "pipe2")
LINE = 64  # bytes of a cache line: each lane's words have lines of their own
WORDS = LINE // 8
INFO_BYTES = 1 << 20  # of a lane, at least; what is longer travels as a message
ELSEWHERE = -1  # in place of the number of bytes: the infos of this step travel as a message


class InheritedDescriptors(NamedTuple):
    """What a worker process is given at its start: file descriptors that it inherits."""

    memory: int
    to_worker: int
    """the end of a pipe where the learner's ringing is heard"""
    to_learner: int
    """the end of a pipe where the worker rings"""


class LaneArrays(NamedTuple):
    """A lane's part of the memory, as views."""

    actions: tuple[Array, ...]  # [N, *leaf] each
    obs: tuple[Array, ...]  # [N, *leaf] each
    reward: Array  # [N] float64
    terminated: Array  # [N] bool
    truncated: Array  # [N] bool
    infos: memoryview  # bytes


class SharedMemory:
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
        numbers = np.frombuffer(memory, np.int64, 2 * WORDS * lanes).reshape(lanes, 2, WORDS)[:, :, 0]
        self._ordered, self._answered = numbers[:, 0], numbers[:, 1]
        self._fence = threading.Lock()
        arrays = [
            np.frombuffer(memory, dtype, N * int(np.prod(shape)), at).reshape(N, *shape)
            for at, shape, dtype in (*places, *flags)
        ]
        self.actions, self.obs = tuple(arrays[: len(spec.action)]), tuple(arrays[len(spec.action) : -3])
        """[num_envs, *leaf] each, all lanes together"""
        self.reward, self.terminated, self.truncated = arrays[-3:]
        self.lanes = []
        for lane, copies in enumerate(spec.lanes):
            rows = slice(spec.first_copy(lane), spec.first_copy(lane) + copies)
            actions, obs = (tuple(array[rows] for array in leaves) for leaves in (self.actions, self.obs))
            view = memoryview(memory)[infos : infos + self.info_bytes[lane]]
            reward, terminated, truncated = self.reward[rows], self.terminated[rows], self.truncated[rows]
            self.lanes.append(LaneArrays(actions, obs, reward, terminated, truncated, view))
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

    def unanswered_orders(self) -> int:
        """How many lanes have an order that is not done, as whoever has just done one sees it.

        Of workers that end at the same moment at least one sees none: taking the lock is what makes one's own answer seen
        before the others' are looked at. Not on every machine: see `MAY_SPIN`.
        """
        with self._fence:
            return int(np.count_nonzero(self._ordered != self._answered))

    def infos(self, lane: int) -> bytes | None:
        """The packed infos of the newest answer; None if they travel as a message."""
        size = self._words[2 * WORDS * lane + WORDS + 1]
        return None if size == ELSEWHERE else bytes(self.lanes[lane].infos[:size])

    def close(self) -> None:
        """Let go of the descriptor; the memory goes with the last view on it."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1
