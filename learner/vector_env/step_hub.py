"""The hub of a vector environment: a shell round its coordinator and shared memory. Only `wait_for_answers` waits.

Rule: every wait has a deadline. When it passes, the workers that have not answered are given up, and killed if they are
child processes of ours. So a wait ends with every lane answered or lost. Workers that have been silent for too long
are removed only while the hub listens: the caller may take as long as it likes between two waits.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from learner.members.events import Event, Failed, WorkerLeft, WorkerProcessFailed, WorkerRefused
from learner.members.member_server import MemberServer, ServerCallbacks, ServerSettings
from learner.members.membership import Member
from learner.members.process_callbacks import ProcessCallbacks
from learner.vector_env.order_coordinator import MakeOrder, OrderCoordinator
from learner.vector_env.status import status, status_of_run
from protocol.address import worker_name
from protocol.errors import EnvironmentFailed, NoWorkers
from protocol.messages import Answer, Order, Status, WorkerActivity, WorkerExit
from protocol.specs import StepSpec
from protocol.wire.learner_link import LearnerLink
from protocol.wire.shared_memory import SharedMemory
from protocol.wire.wake_up import SpinWait, WakePipe, WakeReason

log = logging.getLogger("millrace.learner")

POLL_S = 0.05  # between two checks whether a child process has ended
LISTEN_EVERY_S = 0.5  # interval of answers to heartbeats while steps go through shared memory
PATIENCE_S = 10.0  # how long a lost lane waits for a restarted worker (at most half the timeout) before it goes to a worker
# that already has lanes
BUSY_S = 1.0  # how long closing waits for a step under way: the step may hang, and its result is not used


class LocalWorkers(Protocol):
    """The worker processes that this program started."""

    def poll(self) -> Iterable[WorkerExit]:
        """Each process that ended since the last call. Restarts the processes whose backoff is over."""
        ...

    def activities(self) -> Iterable[WorkerActivity]:
        """What each running worker does."""
        ...

    def kill(self, name: str) -> bool:
        """Kill the process of this name. False if this program did not start it."""
        ...

    @property
    def count(self) -> int:
        """Number of processes that run or will be restarted."""
        ...

    def stop(self, timeout_s: float) -> None:
        """Stop all processes within `timeout_s`."""
        ...


class NoLocalWorkers:
    """No local processes: all workers are started elsewhere."""

    def poll(self) -> Iterable[WorkerExit]:
        """No process has ended."""
        return ()

    def activities(self) -> Iterable[WorkerActivity]:
        """Nothing: no worker runs here."""
        return ()

    def kill(self, name: str) -> bool:
        """No process to kill."""
        return False

    @property
    def count(self) -> int:
        """Zero processes."""
        return 0

    def stop(self, timeout_s: float) -> None:
        """Nothing to do."""


@dataclass(frozen=True)
class SharedSteps:
    """Resources of steps through shared memory: the memory, and the wake pipes of each worker that inherited it."""

    memory: SharedMemory
    wake_pipes: Mapping[str, tuple[WakePipe, WakePipe]]
    """Pipe that wakes the worker, and pipe by which it wakes us; by worker name."""


class StepHub:
    """Everything the vector environment knows of workers."""

    def __init__(
        self,
        link: LearnerLink,
        spec: StepSpec,
        *,
        first_session: int,
        local_workers: LocalWorkers | None = None,
        shared: SharedSteps | None = None,
        spin_s: float = 0.0,
        worker_timeout_s: float = math.inf,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`spin_s`: how long to wait awake for a step through shared memory before sleeping. `worker_timeout_s`: a worker
        that is silent for longer while the hub listens is given up; infinite where the end of a process is known otherwise.
        """
        self._link = link
        self._coordinator = OrderCoordinator(spec, first_session, worker_timeout_s)
        self._local_workers: LocalWorkers = local_workers or NoLocalWorkers()
        self._shared, self._spin_s, self._clock = shared, spin_s, clock
        self._spin_wait = SpinWait()
        self._waiting_orders: dict[int, MakeOrder] = {}  # lane -> an order that is sent as soon as the lane is placed
        self._waiting_since_s: dict[int, float] = {}  # of these lanes
        self._newest_tickets: dict[int, int] = {}  # lane -> ticket of its newest order, if its answer is wanted
        self._patience_s = PATIENCE_S
        self._while_waiting: Callable[[], None] = lambda: None
        self._on_death: Callable[[Failed], None] = lambda event: None
        self._status_of_run: Callable[[float], Status] | None = None
        self.stepped: set[int] = set()
        """Lanes whose last step, through shared memory, is done."""
        self._under_way: dict[int, int] = {}  # lane -> number of its order through shared memory
        self._wake_pipes: dict[int, tuple[WakePipe, WakePipe] | None] = {}  # lane -> its worker's pipes, if it has any
        self._wake_ins = [] if shared is None else list({id(pipe): pipe for _, pipe in shared.wake_pipes.values()}.values())
        self._listen_due_s = 0.0
        # To lose a worker costs the user's episodes. So a worker has its whole timeout to be heard again, not only the
        # server's short grace: after a long suspension even its connection must be made anew.
        settings = ServerSettings(grace_s=worker_timeout_s, log_tracebacks=False)
        callbacks = ServerCallbacks(self._coordinator.receive, self._status, self._on_event, self._wake_sleeping)
        processes = ProcessCallbacks(self._local_workers.poll, self._local_workers.activities)
        self._server = MemberServer(link, self._coordinator, callbacks, processes, settings, clock)

    @property
    def address(self) -> str:
        """The address that workers connect to."""
        return self._link.address

    @property
    def members(self) -> list[Member]:
        """The workers that have joined. For any thread."""
        return list(self._coordinator.members.values())

    def call_while_waiting(self, callback: Callable[[], None]) -> None:
        """Call this now and then while waiting; what it raises ends the wait."""
        self._while_waiting = callback

    def call_on_death(self, callback: Callable[[Failed], None]) -> None:
        """Call this when a worker's process has ended in its environment: `make_vec` only tells of the lost copies."""
        self._on_death = callback

    def answer_for(self, run: Callable[[float], Status]) -> None:
        """From now on answer `millrace status` for the run that acts on these copies: its figures, and the workers here."""
        self._status_of_run = run

    def _status(self, now: float) -> Status:
        if self._status_of_run is None:
            return status(self._coordinator, now)
        return status_of_run(self._status_of_run(now), self._coordinator, now)

    # ---------------------------------------------------------------- orders

    def send_orders(self, makes: Mapping[int, MakeOrder]) -> None:
        """Send an order to each of these lanes. Lanes that have no worker are placed while `wait_for_answers` waits."""
        self._coordinator.begin()
        self.stepped.clear()
        self._waiting_orders = dict(makes)
        self._waiting_since_s = dict.fromkeys(makes, self._clock())
        self._send_waiting_orders()

    def uses_shared_memory(self, lane: int) -> bool:
        """Whether a step of this lane may go through shared memory: its worker was handed it, and has no other order.

        It has one if the wait for the answer was interrupted. The worker might execute it after the step.
        """
        if any(order.lane == lane for order in self._coordinator.orders.values()):
            return False
        if lane not in self._wake_pipes:
            member = self._coordinator.owner(lane)
            if member is None or not self._coordinator.lanes[lane].started or self._shared is None:
                return False
            self._wake_pipes[lane] = self._shared.wake_pipes.get(member.hello.worker)
        return self._wake_pipes[lane] is not None

    def step_shared(self, lanes: Sequence[int]) -> None:
        """Step these lanes with the actions that are in shared memory."""
        self._coordinator.begin()
        self.stepped.clear()
        assert self._shared is not None
        memory = self._shared.memory
        for lane in lanes:
            self._under_way[lane] = self._coordinator.shared_orders[lane] = number = memory.ordered(lane) + 1
            memory.order(lane, number)
        for lane in lanes:
            pipes = self._wake_pipes[lane]
            assert pipes is not None
            pipes[0].wake()

    # ---------------------------------------------------------------- lanes that do not wait for each other

    def send_order(self, lane: int, make: MakeOrder) -> None:
        """Send an order to this lane, whatever other lanes do. `take_result` returns its result."""
        self._forget(lane)
        self._waiting_orders[lane], self._waiting_since_s[lane] = make, self._clock()
        self._send_waiting_orders()

    def begin_shared_step(self, lane: int) -> None:
        """Step this lane with the actions that are in shared memory, whatever other lanes do."""
        self._forget(lane)
        pipes = self._wake_pipes[lane]
        assert self._shared is not None
        assert pipes is not None
        memory = self._shared.memory
        self._under_way[lane] = self._coordinator.shared_orders[lane] = number = memory.ordered(lane) + 1
        memory.order(lane, number, wake=True)
        pipes[0].wake()

    def take_result(self, lane: int) -> Answer | bytes | None:
        """What became of the lane's order: the answer that came as a message, or the packed infos of a step through shared
        memory. None: nothing yet, or the lane is lost.
        """
        if lane in self._under_way and self._is_answered(lane):
            self._step_ended(lane)
        result: Answer | bytes | None = None
        answer = self._coordinator.answers.get(lane)
        if answer is not None and answer.ticket == self._newest_tickets.get(lane):  # else nobody waits for it any more
            result = answer
        if lane in self.stepped:
            assert self._shared is not None
            result = self._shared.memory.infos(lane)
            if result is None:
                result = self._coordinator.infos.get(lane)
            if result is None and lane not in self._coordinator.shared_orders:
                result = b""  # its worker is gone, and the lane is in `take_lost`
        if result is not None:
            self._forget(lane)
        return result

    def is_ordered(self, lane: int) -> bool:
        """Whether the lane has an order that is not answered, or waits for a worker to take it."""
        ticket = self._newest_tickets.get(lane)
        return lane in self._waiting_orders or lane in self._under_way or ticket in self._coordinator.orders

    def listen_if_due(self) -> None:
        """Read the messages that have come, if some may matter."""
        if self._waiting_orders or self._coordinator.orders or self._clock() > self._listen_due_s:
            self._turn(0.0)

    def wait_for_any(self, timeout_s: float) -> None:
        """Wait until a lane may have a result, for a short time at most. `timeout_s`: how long a worker may take."""
        self._patience_s = min(PATIENCE_S, timeout_s / 2)
        only_shared = bool(self._under_way) and not self._waiting_orders and not self._coordinator.orders
        if only_shared and self._spin_wait.wait(lambda: any(map(self._is_answered, self._under_way)), self._spin_s):
            return
        if self._under_way:
            arrived = self._link.poll_beside([pipe.read_fd for pipe in self._wake_ins], POLL_S)
            for pipe in self._wake_ins:
                pipe.wait(0.0)
            if arrived or not only_shared or self._clock() > self._listen_due_s:
                self._turn(0.0)
        else:
            self._turn(POLL_S)

    def give_up(self, lane: int, timeout_s: float) -> None:
        """Give up the worker of a lane that took longer than this. Raises `NoWorkers` if the lane had none all the time."""
        if lane in self._waiting_orders:
            raise self.no_workers(timeout_s)
        self._give_up_lane(lane, f"did not answer within {timeout_s:g} s")

    def raise_failures(self) -> None:
        """Raise `EnvironmentFailed` if an environment raised."""
        if self._coordinator.failures:
            self._raise_failure()

    def now(self) -> float:
        """Time by the hub's clock."""
        return self._clock()

    def _forget(self, lane: int) -> None:
        """The result of the lane's last order was taken, or is not wanted any more."""
        self._coordinator.forget(lane)
        self.stepped.discard(lane)
        self._under_way.pop(lane, None)
        self._newest_tickets.pop(lane, None)

    def _is_answered(self, lane: int) -> bool:
        return self._shared is not None and self._shared.memory.answered(lane) == self._under_way[lane]

    # ---------------------------------------------------------------- waiting

    def wait_for_answers(self, timeout_s: float) -> dict[int, Answer]:
        """Wait until every order is answered or its lane is lost. Returns the answers that came as messages, by lane.

        Raises `EnvironmentFailed` if an environment raised, `NoWorkers` if there was no worker to take a lane in time.
        """
        deadline_s = self._clock() + timeout_s
        self._patience_s = min(PATIENCE_S, timeout_s / 2)
        for lane in list(self._under_way):
            if lane in self._under_way:  # not lost while another was waited for
                self._wait_for_shared_step(lane, deadline_s)
        while self._waiting_orders or self._coordinator.orders:
            self._turn(POLL_S)
            if self._clock() > deadline_s:
                self._give_up(timeout_s)
        if self._clock() > self._listen_due_s:
            self._turn(0.0)
        self.raise_failures()
        return dict(self._coordinator.answers)

    def infos(self, lane: int, timeout_s: float) -> bytes:
        """The packed infos of a lane that was stepped through shared memory."""
        assert self._shared is not None
        packed = self._shared.memory.infos(lane)
        if packed is not None:
            return packed
        deadline_s = self._clock() + timeout_s
        while True:
            if (packed := self._coordinator.infos.get(lane)) is not None:
                return packed
            if lane not in self._coordinator.shared_orders:
                return b""  # its worker is gone, and the lane is in `take_lost`
            if self._clock() > deadline_s:
                self._give_up_lane(lane, "did not send its infos in time")
            else:
                self._turn(POLL_S)

    def refuse_owner(self, lane: int, why: str) -> None:
        """Refuse this lane's worker because it sent something unusable."""
        if (member := self._coordinator.owner(lane)) is not None:
            log.warning("worker %s: %s", member.hello.worker, why)
            self._server.send(self._coordinator.reject_message(member.peer, why, self._clock()))

    def take_lost(self) -> dict[int, str]:
        """Lanes whose env copies were lost since the last call, and why."""
        lost, self._coordinator.lost = self._coordinator.lost, {}
        return lost

    def is_started(self, lane: int) -> bool:
        """Whether the lane's env copies are with a worker."""
        return self._coordinator.lanes[lane].started

    def incarnation(self, lane: int) -> int:
        """Number of times that the lane was restarted on new env copies."""
        return self._coordinator.lanes[lane].incarnation

    def rebalance(self) -> None:
        """Even out the lanes of the workers. Call it when all lanes are about to be reset."""
        self._turn(0.0)
        self._wake_pipes.clear()
        self._server.send(self._coordinator.rebalance())

    def wait_for(self, workers: int, timeout_s: float) -> None:
        """Wait until this number of `workers` have joined. Raises `NoWorkers`."""
        self._server.wait_for(workers, timeout_s, lambda: self._turn(POLL_S))

    def no_workers(self, timeout_s: float) -> NoWorkers:
        """The error when no worker has been there for this long."""
        return self._server.no_workers(1, timeout_s)

    def close(self, timeout_s: float) -> None:
        """Ask every worker to leave, wait a moment for their Goodbye, and end those that are ours."""
        busy = bool(self._under_way or self._coordinator.orders)
        deadline_s = self._clock() + (min(BUSY_S, timeout_s) if busy else timeout_s)
        self._server.send(self._coordinator.drain("the vector environment was closed"))
        for pipe, _ in self._shared.wake_pipes.values() if self._shared is not None else ():
            pipe.wake(WakeReason.MESSAGE)
        self._server.wait_until_all_left(deadline_s, POLL_S)
        self._local_workers.stop(max(0.0, deadline_s - self._clock()))
        self._server.close()

    # ---------------------------------------------------------------- inside

    def _wait_for_shared_step(self, lane: int, deadline_s: float) -> None:
        """Wait for one lane's step, awake for a moment, then asleep. It is done when its number is that of the order."""
        assert self._shared is not None
        memory, number, pipes = self._shared.memory, self._under_way[lane], self._wake_pipes[lane]
        assert pipes is not None
        self._spin_wait.wait(lambda: memory.answered(lane) == number, self._spin_s)
        while memory.answered(lane) != number and lane in self._under_way:
            if not pipes[1].wait(POLL_S):
                self._turn(0.0)
                if self._clock() > deadline_s:
                    self._give_up_lane(lane, "did not answer in time")
            elif self._clock() > self._listen_due_s:
                self._turn(0.0)
        self._step_ended(lane)

    def _step_ended(self, lane: int) -> None:
        """The lane's step is done, or the lane is lost."""
        number = self._under_way.pop(lane, None)
        if number is not None and self._shared is not None and self._shared.memory.answered(lane) == number:
            self.stepped.add(lane)

    def _turn(self, timeout_s: float) -> None:
        """Listen, remove the workers that are gone, and send the orders that can be sent."""
        self._listen_due_s = self._clock() + LISTEN_EVERY_S
        self._while_waiting()
        self._server.listen(timeout_s)
        self._send_waiting_orders()

    def _on_event(self, event: Event) -> None:
        """Release the lanes of a worker that has left."""
        if isinstance(event, WorkerProcessFailed) and not event.spare:
            self._on_death(event)
        if isinstance(event, WorkerLeft | WorkerRefused):
            for lane in [lane for lane in self._wake_pipes if self._coordinator.owner(lane) is None]:
                del self._wake_pipes[lane]
                self._step_ended(lane)

    def _send_waiting_orders(self) -> None:
        awaited = len(self._coordinator.membership.active()) < self._local_workers.count  # one of ours has yet to join
        now = self._clock()
        for lane, make in list(self._waiting_orders.items()):
            if self._coordinator.place(lane, awaited and now - self._waiting_since_s[lane] < self._patience_s):
                del self._waiting_orders[lane]
                sent = self._coordinator.order(lane, make)
                for _, order in sent:
                    assert isinstance(order, Order)
                    self._newest_tickets[lane] = order.ticket
                self._server.send(sent)

    def _wake_sleeping(self, peer: bytes) -> None:
        """Wake a worker that was sent a message: it may sleep until its next step through shared memory."""
        if self._shared is not None and (pipes := self._shared.wake_pipes.get(worker_name(peer).decode(errors="replace"))):
            pipes[0].wake(WakeReason.MESSAGE)

    def _give_up(self, timeout_s: float) -> None:
        """The deadline has passed: give up every worker that has not answered."""
        if self._waiting_orders and not self._coordinator.orders:
            self._waiting_orders.clear()
            raise self.no_workers(timeout_s)
        for order in list(self._coordinator.orders.values()):
            self._give_up_lane(order.lane, f"did not answer within {timeout_s:g} s")

    def _give_up_lane(self, lane: int, why: str) -> None:
        member = self._coordinator.owner(lane)
        if member is not None:
            killed = self._local_workers.kill(member.hello.worker)
            self._server.send(self._coordinator.give_up(member, f"{why}, and was killed" if killed else why))

    def _raise_failure(self) -> None:
        failure, self._coordinator.failures = self._coordinator.failures[0], []
        error = EnvironmentFailed(f"worker {failure.worker} ({failure.host}): {failure.error}", failure.traceback)
        error.add_note(failure.traceback)
        raise error
