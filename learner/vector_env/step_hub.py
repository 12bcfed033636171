"""The hub of a vector environment: a shell around its coordinator and its shared memory.

Rule: a lane gets its orders as messages, or steps through shared memory; results are taken lane by lane. A worker that does
not answer in time is treated as lost, and is killed if it is a child of this process. Workers that have been silent for too
long are removed only while the hub listens, so the caller may take as long as it likes between two waits.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence

from millrace.learner.members.events import Event, Failed, WorkerLeft, WorkerProcessFailed, WorkerRefused
from millrace.learner.members.member_server import MemberServer, ServerSettings
from millrace.learner.members.membership import Membership
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.learner.vector_env.order_coordinator import MakeOrder, OrderCoordinator, WaitingOrder
from millrace.learner.vector_env.shared_steps import SharedSteps
from millrace.learner.vector_env.vector_env_status import status
from millrace.protocol.errors import NoWorkers
from millrace.protocol.messages import Answer, Status
from millrace.protocol.specs import StepSpec
from millrace.protocol.wire.learner_link import LearnerLink

POLL_S = 0.05  # interval at which to check whether a child process has ended
LISTEN_EVERY_S = 0.5  # interval at which heartbeats are answered while steps go through shared memory
# How long a lost lane waits for a restarted worker, at most half the timeout, before it goes to a worker that has lanes.
PATIENCE_S = 10.0
BUSY_S = 1.0  # how long `close` waits for a running step, which may hang and whose result nobody uses


class StepHub:
    """A vector environment's connection to its workers: sends orders to lanes, and takes their results."""

    def __init__(
        self,
        link: LearnerLink,
        spec: StepSpec,
        *,
        first_session: int,
        processes: WorkerProcesses,
        shared: SharedSteps | None = None,
        worker_timeout_s: float = math.inf,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """A worker that is silent for longer than `worker_timeout_s` while the hub listens is treated as lost.

        The timeout is infinite if this program notices in another way that worker processes have ended.
        """
        self.shared = shared
        self.now = clock
        """returns the time of the hub's clock"""
        self.while_waiting: Callable[[], None] = lambda: None
        """called now and then while the hub waits; an exception that it raises ends the wait"""
        self.on_death: Callable[[Failed], None] = lambda event: None
        """called when a worker's process has ended in code of its environment; the lost copies are reported in any case"""
        self.status_of_run: Callable[[float], Status] | None = None
        """returns the status of the run that acts on these copies, to which `status` adds the workers of this hub"""
        self._link = link
        self.coordinator = OrderCoordinator(spec, first_session, worker_timeout_s)
        self._processes = processes
        self._infos_to_come = False  # whether the newest look found a step whose infos arrive later, as a message
        self._patience_s = PATIENCE_S
        self._listen_due_s = 0.0
        self._failure: Failed | None = None  # the first failure since the last `raise_failure`
        # Losing a worker costs the user episodes. Therefore, after this process was away, each worker has its whole timeout
        # to be heard again, instead of the server's short grace. After a long suspension, a worker even has to reconnect.
        settings = ServerSettings(grace_s=worker_timeout_s, log_tracebacks=False)
        self._server = MemberServer(link, self.coordinator, self, processes, settings, clock)

    def take_over(self, waiting: Membership, described_in_s: float) -> None:
        """Begin the vector environment for the workers waiting for it.

        `described_in_s`: how long the environment's description took.
        """
        self._server.take_over(waiting, described_in_s)

    @property
    def address(self) -> str:
        """The address to which workers connect."""
        return self._link.address

    # ---------------------------------------------------------------- asking

    def send_order(self, lane: int, make: MakeOrder) -> None:
        """Send an order to this lane as soon as it has a worker. `take` returns the result."""
        self.coordinator.ask(lane, make, self.now())
        self._send_waiting_orders([lane])

    def send_steps(self, lanes: Sequence[int], *, together: bool) -> None:
        """Step these lanes with the actions in shared memory. `together` says that the caller waits for all of them."""
        assert self.shared is not None
        self.shared.step(lanes, together=together)

    def can_share(self, lane: int) -> bool:
        """Whether a step of this lane may use shared memory: its worker must have the memory, and no order may be pending.

        An order is still pending if the wait for its answer was interrupted. The worker might execute that order after the
        step.
        """
        shared = self.shared
        record = self.coordinator.lanes[lane]
        if shared is None or record.order is not None:
            return False
        if lane not in shared.pipes:
            member = self.coordinator.owner(lane)
            if member is None or not record.started:
                return False
            shared.opened(lane, member.hello.worker)
        return shared.pipes[lane] is not None

    def take(self) -> dict[int, Answer | bytes]:
        """Take the results of the newest orders, by lane: answers that arrived as messages, and packed infos of steps
        through shared memory. Lanes that have no result yet, or are lost, are left out.
        """
        results: dict[int, Answer | bytes] = {**self.coordinator.take()}
        self._infos_to_come = False
        if (shared := self.shared) is not None:
            for lane, infos in shared.done().items():
                if (packed := self._long_infos(lane, shared.under_way[lane]) if infos is None else infos) is None:
                    self._infos_to_come = True
                    continue
                results[lane] = packed
                del shared.under_way[lane]
        return results

    def _long_infos(self, lane: int, number: int) -> bytes | None:
        """The infos of a lane's step that are too long for the shared memory; None if they have not arrived yet.

        `number` is the number of the step in the shared memory.
        """
        record = self.coordinator.lanes[lane]
        arrived = record.long_infos
        if arrived is not None and arrived.ticket == -number:
            record.long_infos = None
            return bytes(arrived.infos.data)
        return None if record.started else b""  # if its worker is gone, `OrderCoordinator.take_lost` returns the lane

    def is_awaited(self, lane: int) -> bool:
        """Whether the caller wants the result of an order to the lane that has no result yet: a message, or a step through
        shared memory.
        """
        shared = self.shared
        return self.coordinator.lanes[lane].is_awaited or (shared is not None and lane in shared.under_way)

    def forget(self, lanes: Iterable[int]) -> None:
        """Forget the last orders of these lanes, because their results are no longer wanted."""
        self._infos_to_come = False
        for lane in lanes:
            self.coordinator.forget(lane)
            if self.shared is not None:
                self.shared.under_way.pop(lane, None)

    def begin_anew(self) -> None:
        """Forget all orders after a call that was cut short, which may have noticed a loss but not recorded all of it."""
        self._infos_to_come = False
        self.coordinator.begin_anew()
        if self.shared is not None:
            self.shared.under_way.clear()
            self._forget_pipes(self.shared)

    # ---------------------------------------------------------------- waiting

    def listen_if_due(self) -> None:
        """Send the orders that can be sent. Read the messages that have arrived, if any of them may matter now."""
        self._send_waiting_orders()
        if self.coordinator.has_orders or self.now() > self._listen_due_s:
            self._turn(0.0)

    def listen(self) -> None:
        """Read the messages that have arrived, and notice which workers are gone."""
        self._turn(0.0)

    def wait(self, timeout_s: float, *, together: bool) -> None:
        """Wait, at most for a short time, until a lane may have a result or, if `together`, until all may have one.

        `timeout_s` is how many seconds a worker may take.
        """
        self._patience_s = min(PATIENCE_S, timeout_s / 2)
        self._send_waiting_orders()
        shared = self.shared
        due = self.now() > self._listen_due_s
        if shared is None or not shared.under_way or self._infos_to_come:
            self._turn(POLL_S)
            return
        only_shared = not self.coordinator.has_orders
        seen = only_shared and shared.spin(together=together)
        arrived = not seen and shared.sleep(self._link, POLL_S, together=together and only_shared)
        if arrived or due or not only_shared:
            self._turn(0.0)

    def give_up(self, lane: int, timeout_s: float) -> None:
        """Treat a lane's worker as lost, because it took longer than `timeout_s`.

        Raises `NoWorkers` if the lane had no worker all that time.
        """
        if isinstance(self.coordinator.lanes[lane].order, WaitingOrder):
            raise self.no_workers(timeout_s)
        member = self.coordinator.owner(lane)
        if member is not None:
            why = f"did not answer within {timeout_s:g} s"
            killed = self._processes.kill(member.hello.worker)
            self._server.send(self.coordinator.give_up(member, f"{why}, and was killed" if killed else why))

    # ---------------------------------------------------------------- lanes and workers

    def refuse_owner(self, lane: int, why: str) -> None:
        """Refuse this lane's worker because it sent something unusable."""
        if (member := self.coordinator.owner(lane)) is not None:
            self._server.send(self.coordinator.reject_message(member.peer, why, self.now()))

    def wait_for(self, workers: int, timeout_s: float) -> None:
        """Wait until this many `workers` have joined. Raises `NoWorkers` after `timeout_s`."""
        self._server.wait_for(workers, timeout_s, lambda: self._turn(POLL_S))

    def no_workers(self, timeout_s: float) -> NoWorkers:
        """The error to raise when there has been no worker for this long."""
        return self._server.no_workers(1, timeout_s)

    def raise_failure(self) -> None:
        """Raise `EnvironmentFailed` if an environment has failed since the last call."""
        failure = self._failure
        self._failure = None
        if failure is not None:
            raise failure.exception()

    def close(self, timeout_s: float) -> None:
        """Ask every worker to leave, wait up to `timeout_s` for their Goodbyes, and end this program's worker processes."""
        busy = self.coordinator.has_orders or (self.shared is not None and bool(self.shared.memory.unanswered_orders()))
        deadline_s = self.now() + (min(BUSY_S, timeout_s) if busy else timeout_s)
        self._server.send(self.coordinator.drain("the vector environment was closed"))
        if self.shared is not None:
            self.shared.wake_all()
        self._server.wait_until_all_left(deadline_s, POLL_S)
        self._processes.stop(max(0.0, deadline_s - self.now()))
        self._server.close()

    # ---------------------------------------------------------------- called by the server

    def status(self, now: float) -> Status:
        """The answer to `millrace status`."""
        return status(self.coordinator, now, self.status_of_run)

    def happened(self, event: Event) -> None:
        """Handle an event: a worker may have failed, or left its lanes without a worker."""
        match event:
            case WorkerProcessFailed(spare=False):
                self.on_death(event)
            case Failed(spare=False):
                self._failure = self._failure or event
            case WorkerLeft() | WorkerRefused() if self.shared is not None:
                self._forget_pipes(self.shared)
            case _:
                pass

    def sent(self, peer: bytes) -> None:
        """Wake the receiver of a message, which may be asleep until its next step through shared memory."""
        if self.shared is not None:
            self.shared.wake_for_message(peer)

    # ---------------------------------------------------------------- inside

    def _forget_pipes(self, shared: SharedSteps) -> None:
        """Forget which pipes woke the workers of lanes that have no worker now."""
        for lane in self.coordinator.lanes:
            if lane.owner is None:
                shared.worker_left(lane.number)

    def _turn(self, timeout_s: float) -> None:
        """Listen, remove the workers that are gone, and send the orders that can be sent.

        Raises `NoWorkers` if an order waits for a worker, and none can join any more.
        """
        self._listen_due_s = self.now() + LISTEN_EVERY_S
        self.while_waiting()
        self._server.listen(timeout_s)
        if not self.coordinator.members and self.coordinator.waiting:
            self._server.check_left(1, collecting=True)
        self._send_waiting_orders()

    def _send_waiting_orders(self, lanes: Sequence[int] | None = None) -> None:
        """Send the orders of these lanes, or of all lanes that wait for a worker."""
        if not (waiting := self.coordinator.waiting if lanes is None else lanes):
            return
        ours = min(self._processes.expected, self._processes.left(collecting=False))
        awaited = len(self.coordinator.membership.active()) < ours  # a process that this program started has yet to join
        self._server.send(self.coordinator.send_waiting(waiting, self.now(), self._patience_s if awaited else 0.0))
