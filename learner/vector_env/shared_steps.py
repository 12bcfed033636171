"""Steps through shared memory: which lanes are under way, and how this program and its workers wake each other.

Rule: a lane's step is done when the number of its answer is that of its order. Until then nothing of the lane is read or
written. A worker that was sent a message is woken too: it may sleep until its next step.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from millrace.protocol.address import worker_name
from millrace.protocol.wire.learner_link import LearnerLink
from millrace.protocol.wire.shared_memory import SharedMemory
from millrace.protocol.wire.wake_up import SpinWait, WakePipe, WakeReason


class SharedSteps:
    """The steps of a vector environment that go through shared memory."""

    def __init__(
        self, memory: SharedMemory, to_workers: Mapping[str, WakePipe], to_learner: WakePipe, spin_s: float = 0.0
    ) -> None:
        """`to_workers`: the pipe that wakes each worker that inherited the memory, by its name. `to_learner` wakes us.

        `spin_s`: how long to wait awake before sleeping.
        """
        self.memory = memory
        self.under_way: dict[int, int] = {}
        """by lane: number of its order"""
        self._to_workers = to_workers
        self._to_learner = to_learner
        self._spin_s = spin_s
        self.pipes: dict[int, WakePipe | None] = {}
        """by lane: what wakes its worker, if that worker has the memory"""
        self._spin = SpinWait()

    def opened(self, lane: int, worker: str) -> None:
        """The lane's copies are with the worker of this name."""
        self.pipes[lane] = self._to_workers.get(worker)

    def step(self, lanes: Iterable[int], *, together: bool) -> None:
        """Step these lanes with the actions in the memory. `together`: they are waited for together."""
        self.under_way |= self.memory.order(lanes, wake=not together)
        for pipe in {self.pipes[lane] for lane in lanes}:
            assert pipe is not None
            pipe.wake()

    def done(self) -> dict[int, bytes | None]:
        """By lane: packed infos of the steps under way that are done; None if they come as a message."""
        memory = self.memory
        return {lane: memory.infos(lane) for lane, number in self.under_way.items() if memory.answered(lane) == number}

    def is_done(self, lane: int) -> bool:
        """Whether the lane's step, which is under way, is done."""
        return self.memory.answered(lane) == self.under_way[lane]

    def worker_left(self, lane: int) -> None:
        """The lane's worker is gone. A step that is not done will not be."""
        self.pipes.pop(lane, None)
        if lane in self.under_way and not self.is_done(lane):
            del self.under_way[lane]

    def lanes_move(self) -> None:
        """Lanes may go to other workers."""
        self.pipes.clear()

    def spin(self, *, together: bool) -> bool:
        """Wait awake, for a short time, until all lanes that are under way are done, or else one of them. False: in vain."""
        if not self._spin_s:
            return False
        waiting = list(self.under_way)

        def all_done() -> bool:
            while waiting and self.is_done(waiting[-1]):
                waiting.pop()
            return not waiting

        return self._spin.wait(all_done if together else lambda: any(map(self.is_done, waiting)), self._spin_s)

    def sleep(self, link: LearnerLink, timeout_s: float, *, together: bool) -> bool:
        """Sleep until a worker wakes us. `together`: messages wake us too. True if a message may have arrived."""
        if together:
            return not self._to_learner.wait(timeout_s)
        arrived = link.poll_beside([self._to_learner.read_fd], timeout_s)
        self._to_learner.wait(0.0)
        return arrived

    def wake_for_message(self, peer: bytes) -> None:
        """A message was sent to the worker with this routing id."""
        if (pipe := self._to_workers.get(worker_name(peer).decode(errors="replace"))) is not None:
            pipe.wake(WakeReason.MESSAGE)

    def wake_all(self) -> None:
        """Every worker was sent a message."""
        for pipe in self._to_workers.values():
            pipe.wake(WakeReason.MESSAGE)
