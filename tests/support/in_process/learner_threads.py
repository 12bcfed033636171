"""Learner processes of a run with shards, as threads that gather through memory."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch
from torch import Tensor

from millrace.learner.shards.division import Division
from millrace.learner.shards.learners import Learners
from millrace.learner.shards.messages import HEAD, FromRankZero, encode
from millrace.protocol.errors import LearnerLost

TIMEOUT_S = 60.0
T = TypeVar("T")


class Meeting:
    """Where the threads exchange their tensors, and what rank 0 tells."""

    def __init__(self, processes: int) -> None:
        self.told: list[queue.SimpleQueue[Any]] = [queue.SimpleQueue() for _ in range(processes)]
        self._processes = processes
        self._brought: dict[int, dict[int, Tensor]] = {}  # of each gather, by rank
        self._ended: set[int] = set()
        self._changed = threading.Condition()

    def gather(self, number: int, rank: int, own: Tensor) -> Tensor:
        """The tensors of all ranks in this gather. Raises `LearnerLost` if one has ended before it."""
        with self._changed:
            brought = self._brought.setdefault(number, {})
            brought[rank] = own.clone()
            self._changed.notify_all()
            here = self._changed.wait_for(lambda: len(brought) == self._processes or self._ended - brought.keys(), TIMEOUT_S)
            if not here or len(brought) < self._processes:
                raise LearnerLost("another thread has ended")
            return torch.cat([brought[each] for each in range(self._processes)])

    def end(self, rank: int) -> None:
        """Note that a rank gathers nothing any more."""
        with self._changed:
            self._ended.add(rank)
            self._changed.notify_all()


class LearnerThread(Learners):
    """One of them."""

    def __init__(self, division: Division, meeting: Meeting) -> None:
        super().__init__(division)
        self._meeting = meeting
        self._gathers = 0

    def gather(self, own: Tensor) -> Tensor:
        self._gathers += 1
        return self._meeting.gather(self._gathers, self.division.rank, own)

    def tell(self, rank: int, message: FromRankZero) -> None:
        head, arrays = encode(message)
        self._meeting.told[rank].put((head, [array.copy() for array in arrays]))

    def hear(self) -> FromRankZero:
        head, arrays = self._meeting.told[self.division.rank].get(timeout=TIMEOUT_S)
        message: FromRankZero = HEAD.decode(head)
        for array, values in zip(encode(message)[1], arrays, strict=True):
            array[...] = values
        return message


def in_threads(shards: int, processes: int, body: Callable[[Learners], T]) -> list[T | BaseException]:
    """What each rank's body returned or raised."""
    meeting = Meeting(processes)

    def of_rank(rank: int) -> T | BaseException:
        try:
            return body(LearnerThread(Division(shards, processes, rank), meeting))
        except BaseException as error:
            return error
        finally:
            meeting.end(rank)

    with ThreadPoolExecutor(processes) as pool:
        return list(pool.map(of_rank, range(processes)))
