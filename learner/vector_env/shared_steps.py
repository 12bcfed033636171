"""Steps through shared memory: which lanes are under way, and how this program and its workers wake each other.

Rule: a lane's step is done when the number of its answer equals the number of its order. Until then, this program neither
reads nor writes the lane's memory. It also wakes each worker to which it has sent a message, because the worker may be
asleep until its next step.
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
        """`to_workers` has, by worker name, the pipes that wake the workers that inherited the memory.

        `to_learner` is the pipe that wakes this process. `spin_s` is how many seconds to spin before sleeping.
        """
        self.memory = memory
        self.under_way: dict[int, int] = {}
        """by lane, the number of the order whose step is under way"""
        self._to_workers = to_workers
        self._to_learner = to_learner
        self._spin_s = spin_s
        self.pipes: dict[int, WakePipe | None] = {}
        """by lane, the pipe that wakes its worker; None if that worker doesn't have the memory"""
        self._spin = SpinWait()

    def opened(self, lane: int, worker: str) -> None:
        """Record that the worker of this name has the lane's copies."""
        self.pipes[lane] = self._to_workers.get(worker)

    def step(self, lanes: Iterable[int], *, together: bool) -> None:
        """Step these lanes with the actions in the memory. `together` says that the caller waits for all of them."""
        self.under_way |= self.memory.order(lanes, wake=not together)
        for pipe in {self.pipes[lane] for lane in lanes}:
            assert pipe is not None
            pipe.wake()

    def done(self) -> dict[int, bytes | None]:
        """The packed infos of the steps that are done, by lane; None if they are sent as a message."""
        memory = self.memory
        return {lane: memory.infos(lane) for lane, number in self.under_way.items() if memory.answered(lane) == number}

    def is_done(self, lane: int) -> bool:
        """Whether the lane's step is done. Call this only while a step of the lane is under way."""
        return self.memory.answered(lane) == self.under_way[lane]

    def worker_left(self, lane: int) -> None:
        """Record that the lane's worker is gone. If the lane's step is not done, it never will be."""
        self.pipes.pop(lane, None)
        if lane in self.under_way and not self.is_done(lane):
            del self.under_way[lane]

    def spin(self, *, together: bool) -> bool:
        """Spin for a short time until all lanes that are under way are done or, unless `together`, until one of them is.

        Returns whether this has happened.
        """
        if not self._spin_s:
            return False
        waiting = list(self.under_way)

        def all_done() -> bool:
            while waiting and self.is_done(waiting[-1]):
                waiting.pop()
            return not waiting

        return self._spin.wait(all_done if together else lambda: any(map(self.is_done, waiting)), self._spin_s)

    def sleep(self, link: LearnerLink, timeout_s: float, *, together: bool) -> bool:
        """Sleep until a worker wakes this process, at most for `timeout_s`. Returns whether a message may have arrived.

        Unless `together`, the arrival of a message also wakes this process.
        """
        if together:
            return not self._to_learner.wait(timeout_s)
        arrived = link.poll_beside([self._to_learner.read_fd], timeout_s)
        self._to_learner.wait(0.0)
        return arrived

    def wake_for_message(self, peer: bytes) -> None:
        """Wake the worker with this routing id, because a message was sent to it."""
        if (pipe := self._to_workers.get(worker_name(peer).decode(errors="replace"))) is not None:
            pipe.wake(WakeReason.MESSAGE)

    def wake_all(self) -> None:
        """Wake all workers, because a message was sent to each."""
        for pipe in self._to_workers.values():
            pipe.wake(WakeReason.MESSAGE)
