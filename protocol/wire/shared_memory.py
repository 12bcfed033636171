"""Memory that a learner shares with worker processes of the same machine, for the steps of a vector environment.

Rule: each counter of a lane has one writer. The learner writes the actions and then increments `ordered`; the worker writes
the results of the step and then sets `answered` to the same number. Each side reads what the other has written only after
the other's counter has changed. The memory is an unlinked file and the wake-up pipes have no names; child processes inherit
the descriptors, so nothing is left behind when a process dies. This works only on Linux; elsewhere, everything is sent as
messages.
"""

from __future__ import annotations

import mmap
import os
import threading
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.specs import StepSpec

SUPPORTED = hasattr(os, "memfd_create") and hasattr(os, "pipe2")
CACHE_LINE_BYTES = 64  # each counter of a lane has its own cache line
WORDS = CACHE_LINE_BYTES // 8
MIN_INFO_BYTES = 1 << 20  # minimum space for the infos of a lane; infos that don't fit are sent as a message
INFOS_IN_MESSAGE = -1  # stands in place of the number of bytes if the infos of this step are sent as a message


class InheritedDescriptors(NamedTuple):
    """File descriptors that a worker process inherits at its start."""

    memory: int
    to_worker: int
    """read end of the pipe by which the learner wakes the worker"""
    to_learner: int
    """write end of the pipe by which the worker wakes the learner"""


class LaneArrays(NamedTuple):
    """Views of a lane's part of the shared memory."""

    actions: tuple[Array, ...]  # [N, *leaf] each
    obs: tuple[Array, ...]  # [N, *leaf] each
    reward: Array  # [N] float64
    terminated: Array  # [N] bool
    truncated: Array  # [N] bool
    infos: memoryview  # bytes


def new_memory() -> int:
    """The file descriptor of an empty shared memory. Workers may inherit it before its size is known."""
    return os.memfd_create("millrace", os.MFD_CLOEXEC)


class SharedMemory:
    """The shared memory of one vector environment, as one side sees it."""

    def __init__(self, spec: StepSpec, fd: int, *, resize: bool = False) -> None:
        """Map the memory. With `resize`, which the learner uses, first give it the size that the spec needs.

        Raises `ValueError` if it has another size.
        """
        lanes = [spec.rows(lane) for lane in range(len(spec.lanes))]
        N = lanes[-1].stop
        self._offset = 2 * CACHE_LINE_BYTES * len(lanes)
        places = [self._reserve(N, leaf.shape, leaf.dtype) for leaf in (*spec.action, *spec.leaves)]
        flags = [self._reserve(N, (), dtype) for dtype in ("float64", "bool", "bool")]
        observed = sum(np.dtype(leaf.dtype).itemsize * int(np.prod(leaf.shape)) for leaf in spec.leaves)
        self.info_bytes: list[int] = [MIN_INFO_BYTES + 2 * observed * (rows.stop - rows.start) for rows in lanes]
        infos = self._offset
        self.fd = fd
        size = infos + sum(self.info_bytes)
        if resize:
            os.ftruncate(fd, size)
        if os.fstat(fd).st_size != size:
            raise ValueError(f"shared memory: expected {size} bytes, got {os.fstat(fd).st_size}")
        memory = mmap.mmap(self.fd, size)
        self._words = memoryview(memory)[: 2 * CACHE_LINE_BYTES * len(lanes)].cast("q")
        numbers = np.frombuffer(memory, np.int64, 2 * WORDS * len(lanes)).reshape(len(lanes), 2, WORDS)[:, :, 0]
        self._ordered = numbers[:, 0]
        self._answered = numbers[:, 1]
        self._fence = threading.Lock()
        arrays = [
            np.frombuffer(memory, dtype, N * int(np.prod(shape)), at).reshape(N, *shape)
            for at, shape, dtype in (*places, *flags)
        ]
        self.actions = tuple(arrays[: len(spec.action)])
        self.obs = tuple(arrays[len(spec.action) : -3])
        """[N, *leaf] each, where N counts the rows of all lanes"""
        self.reward, self.terminated, self.truncated = arrays[-3:]
        self.lanes = []
        for lane, rows in enumerate(lanes):
            actions, obs = (tuple(array[rows] for array in leaves) for leaves in (self.actions, self.obs))
            view = memoryview(memory)[infos : infos + self.info_bytes[lane]]
            reward = self.reward[rows]
            terminated = self.terminated[rows]
            truncated = self.truncated[rows]
            self.lanes.append(LaneArrays(actions, obs, reward, terminated, truncated, view))
            infos += self.info_bytes[lane]

    def _reserve(self, copies: int, shape: tuple[int, ...], dtype: str) -> tuple[int, tuple[int, ...], str]:
        at = self._offset
        size = copies * int(np.prod(shape)) * np.dtype(dtype).itemsize
        self._offset += -(-size // CACHE_LINE_BYTES) * CACHE_LINE_BYTES
        return at, shape, dtype

    def ordered(self, lane: int) -> int:
        """The number of the lane's newest order."""
        return self._words[2 * WORDS * lane]

    def order(self, lanes: Iterable[int], *, wake: bool = False) -> dict[int, int]:
        """Order a step of these lanes. Write the actions first. Returns the number of the order for each lane.

        With `wake`, a worker wakes the learner as soon as one of these lanes is done, even if others are not.
        """
        words = self._words
        numbers = dict[int, int]()
        for lane in lanes:
            at = 2 * WORDS * lane
            words[at + 1] = wake
            words[at] = numbers[lane] = words[at] + 1
        return numbers

    def wakes(self, lane: int) -> bool:
        """Whether to wake the learner when the lane's newest order is done, even if other lanes are not."""
        return bool(self._words[2 * WORDS * lane + 1])

    def answered(self, lane: int) -> int:
        """The number of the lane's newest finished order."""
        return self._words[2 * WORDS * lane + WORDS]

    def answer(self, lane: int, number: int, infos: bytes) -> bool:
        """Mark the order with this number as finished. Write the results first.

        Returns False if the infos do not fit, so that the caller must send them as a message.
        """
        fits = len(infos) <= self.info_bytes[lane]
        if infos and fits:
            self.lanes[lane].infos[: len(infos)] = infos
        self._words[2 * WORDS * lane + WORDS + 1] = len(infos) if fits else INFOS_IN_MESSAGE
        self._words[2 * WORDS * lane + WORDS] = number
        return fits

    def unanswered_orders(self) -> int:
        """The number of lanes with an unfinished order. A worker calls this after it has finished an order.

        If the last workers finish at the same moment, at least one of them gets 0, because taking the lock makes the
        worker's own answer visible before the worker reads those of the others. This does not hold on every processor: see
        `CAN_SPIN`.
        """
        with self._fence:
            return int(np.count_nonzero(self._ordered != self._answered))

    def infos(self, lane: int) -> bytes | None:
        """The packed infos of the lane's newest answer; None if they are sent as a message."""
        if not (size := self._words[2 * WORDS * lane + WORDS + 1]):
            return b""
        return None if size == INFOS_IN_MESSAGE else bytes(self.lanes[lane].infos[:size])

    def close(self) -> None:
        """Close the descriptor. The memory is freed once the last view of it is gone."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1
