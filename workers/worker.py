"""Runs a worker: connects its session with the link, the env copies and signals. All decisions are made in the session.

Rule: the worker reads all messages before a rollout or an evaluation starts, and again between env steps, so it answers
while it works. Every failure of the environment is reported to the learner. A connection that only seems to be open is
replaced. In a vector environment, where one step may take as long as the caller allows, a second thread sends the
heartbeats.
"""

from __future__ import annotations

import logging
import math
import os
import platform
import socket
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TypeGuard

from millrace.protocol.bounds import Stages
from millrace.protocol.env_spec import AllowedCode
from millrace.protocol.errors import BadMessage, EnvironmentFailed, PolicyFailed, UsageError, UserFacingError, first_line
from millrace.protocol.messages import Describe, Described, EpisodeRows, Stepped, ToLearner
from millrace.protocol.specs import RunSpec, StepSpec, WaitSpec
from millrace.protocol.wire.codec import decode_to_worker, encode
from millrace.protocol.wire.shared_memory import InheritedDescriptors
from millrace.protocol.wire.worker_link import WorkerLink
from millrace.workers.activity import PREPARING, WAITING, activity
from millrace.workers.actors import Actors, MakeActors, make_local_actors
from millrace.workers.conversation.heartbeat_thread import HeartbeatThread
from millrace.workers.conversation.session import (
    BeginRun,
    CloseLanes,
    EvaluationTask,
    Leave,
    RolloutTask,
    SendMessage,
    Session,
    SharedOrders,
    StartSession,
    Statistics,
    Work,
    WorkAnswer,
    WorkerEffect,
    WorkerIdentity,
)
from millrace.workers.conversation.worker_states import WorkerState
from millrace.workers.copy_slots import UNUSED_S, close_described
from millrace.workers.described_copy import describe
from millrace.workers.exit_codes import EXIT_UNSUITABLE
from millrace.workers.machine_slots import NoSlot, slots
from millrace.workers.shared_weights import SharedWeightsReader
from millrace.workers.vector_env.stepper import Stepper

log = logging.getLogger("millrace.worker")

CONNECT_AGAIN_S = 20.0  # a learner that can be reached answers a Hello sooner than this
PULSE_S = 0.05  # time between two checks for messages while environments are stepped
IDLE_S = 0.5  # longest wait while idle, so that a signal or the end of the parent process is noticed
AFTER_WAKE_UP_S = 0.02  # longest wait for a message that a wake-up has announced
STATM = Path("/proc/self/statm")  # contains numbers of pages: total, resident, …


class _Abandoned(Exception):
    """The work in progress is no longer wanted."""


def _no_stop_requests() -> int:
    return 0


def _no_watchdog(now: float) -> None: ...


def _same_exit_code(code: int, reason: str) -> int:
    return code


@dataclass(frozen=True)
class WorkerOptions:
    """A worker's options, which depend on the process or thread that runs it."""

    code: AllowedCode = AllowedCode.MODULES
    """Which code the learner may make the worker run."""
    stop_requests: Callable[[], int] = _no_stop_requests
    """Returns how many times this worker was asked to leave."""
    feed_watchdog: Callable[[float], None] = _no_watchdog
    """Called regularly with the current time; the calls stop if the environment hangs."""
    shared_memory: InheritedDescriptors | None = None
    """Shared memory and wake pipes, for a vector environment on this machine."""
    shared_weights: SharedWeightsReader | None = None
    """Reads the weights that the supervisor receives for all its workers."""
    exit_code: Callable[[int, str], int] = _same_exit_code
    """Converts the conversation's exit code and the reason for leaving to the exit code of the process."""
    make_actors: MakeActors = make_local_actors
    """Makes the actors of a run."""


class Worker:
    """A worker, from its first Hello until it exits."""

    def __init__(
        self,
        link: WorkerLink,
        session: Session,
        options: WorkerOptions | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link = link
        self._session = session
        self._clock = clock
        self._options = options or WorkerOptions()
        self._handled_stop_requests = 0
        self._actors: Actors | None = None
        self._stepper: Stepper | None = None
        self._packing = link.packing
        if self._options.shared_weights is not None:
            link.watch(self._options.shared_weights.wake_fd)
        self._pulse_due_s = 0.0
        self._unused_from_s = math.inf  # time at which the described copy is closed if it is still unused
        self._resident_bytes = 0
        self._left: Leave | None = None
        self._heartbeats = HeartbeatThread(lambda: self._do(self._session.heartbeat_if_due(self._clock())))
        self._waited_s = 0.0
        self._statistics = self._earlier = Statistics()  # the newest figures, and those at the end of the previous session
        # `_waited_s` at the learner's last message, or when this worker last began to join or made a new connection.
        self._unheard_from_s = 0.0

    def run(self) -> Leave:
        """Work until the conversation is over. Exceptions of the environment are reported to the learner, never raised."""
        try:
            while self._left is None:
                self._do(self._session.tick(self._clock()))
                self._connect_again_if_unheard()
                self._close_unused()
                if self._left is None:
                    idle_s = min(IDLE_S, max(0.0, self._session.due_s - self._clock()))
                    self._listen(self._serve_shared_memory(idle_s))
                while self._left is None and self._work():
                    self._listen(0.0)
        finally:
            self._heartbeats.stop()
            self._close_all()
            self._link.close()
        return self._left

    def _work(self) -> bool:
        """Do the next piece of work. Returns False if there is none."""
        work = self._session.next_work()
        if work is None:
            return False
        try:
            answers = self._do_work(work)
        except _Abandoned:
            answers = []
        except Exception as error:
            if self._cannot_take_part(error, work):
                self._decline(error)
            else:
                self._fail(error)
            return True
        self._update_statistics()
        self._do(self._session.work_ended(answers))
        return True

    def _do_work(self, work: Work) -> Sequence[WorkAnswer]:
        """Describe, collect, evaluate, or execute an order. Raises `_Abandoned` once the work is no longer wanted."""

        def pulse() -> None:
            self._pulse(work)

        match work:
            case Describe():
                return [self._describe(work)]
            case RolloutTask() | EvaluationTask():
                assert self._actors is not None
                return self._actors.do(work, self._send_rows, pulse)
        assert self._stepper is not None
        with self._heartbeats.lock_released():
            return [self._stepper.execute(work, lambda: self._pulse_from_env_code(work))]

    def _listen(self, timeout_s: float) -> None:
        """Wait for a message, for at most `timeout_s` seconds. Then handle requests to stop, and all messages that have
        arrived.
        """
        began_s = self._clock()
        self._options.feed_watchdog(began_s)
        arrived = self._link.poll(timeout_s)
        self._waited_s += self._clock() - began_s
        while self._handled_stop_requests < self._options.stop_requests():
            self._handled_stop_requests += 1
            self._do(self._session.stop())  # rule STOP
        if (problem := self._link.problem) is not None and problem.final:
            self._do(self._session.refused(problem.line))
        if arrived:
            self._unheard_from_s = self._waited_s
            for message in self._link.receive():
                if isinstance(message, BadMessage):  # rule IGNORE_UNREADABLE
                    log.warning("the learner sent an unreadable message: %s", message)
                else:
                    self._do(self._session.handle(message, self._clock()))
        if self._options.shared_weights is not None:
            self._take_shared_weights(self._options.shared_weights)

    def _take_shared_weights(self, shared: SharedWeightsReader) -> None:
        """Handle weights from the supervisor in the same way as weights that the learner sends to this worker."""
        for frames in shared.find(self._session.session, self._session.missing_versions()):
            with suppress(BadMessage):  # the learner will send them to this worker directly
                self._do(self._session.handle(decode_to_worker(frames), self._clock()))

    def _connect_again_if_unheard(self) -> None:
        """Make a new connection if the learner has not answered for too long while this worker is joining.

        A proxy or a tunnel may keep a connection open after its other end is gone. If there is no connection yet, making a
        new one drops the queued Hellos. Only time spent listening counts, because no messages are read while a simulator
        starts or is closed.
        """
        if self._session.state is not WorkerState.JOINING:
            self._unheard_from_s = self._waited_s
        elif self._waited_s - self._unheard_from_s > CONNECT_AGAIN_S:
            if self._link.connected:
                log.warning(
                    "no answer over the connection to %s for %.0f s; connecting again", self._link.address, CONNECT_AGAIN_S
                )
            self._unheard_from_s = self._waited_s
            self._link.connect_again()  # rule CONNECTION

    def _serve_shared_memory(self, timeout_s: float) -> float:
        """If shared memory is used, execute the orders in it until a message may have arrived.

        Returns for how many seconds to wait for a message.
        """
        stepper = self._stepper
        orders = SharedOrders(self._session.session)
        if stepper is None or not stepper.uses_shared_memory:
            return timeout_s
        message_announced = False
        began_s = self._clock()
        stepped_s = stepper.stages["step"]
        try:
            with self._heartbeats.lock_released():
                message_announced = stepper.serve_shared_memory(
                    min(timeout_s, PULSE_S),
                    lambda: self._pulse_from_env_code(orders),
                    orders.session,
                    self._send_from_env_code,
                )
        except _Abandoned:
            pass
        except Exception as error:
            self._fail(error)
        self._waited_s += self._clock() - began_s - (stepper.stages["step"] - stepped_s)
        self._update_statistics()
        return AFTER_WAKE_UP_S if message_announced else 0.0

    def _pulse(self, work: Work | SharedOrders) -> None:
        """Every `PULSE_S` seconds, handle messages and send what is due; otherwise, do nothing.

        Raises `_Abandoned` once the work is no longer wanted.
        """
        now = self._clock()
        if now >= self._pulse_due_s:
            self._pulse_due_s = now + PULSE_S
            self._resident_bytes = _resident_bytes()
            self._update_statistics()
            self._listen(0.0)
            self._do(self._session.tick(now))
            if self._session.is_unwanted(work):
                raise _Abandoned

    def _pulse_from_env_code(self, work: Work | SharedOrders) -> None:
        """Like `_pulse`, for calls during environment code, while the lock of the heartbeat thread is released."""
        if self._clock() >= self._pulse_due_s:
            with self._heartbeats.lock_reacquired():
                self._pulse(work)

    def _send_rows(self, rows: EpisodeRows) -> None:
        self._do([SendMessage(rows)])

    def _send_from_env_code(self, answer: Stepped) -> None:
        with self._heartbeats.lock_reacquired():
            self._do([SendMessage(answer)])

    def _fail(self, error: Exception) -> None:
        """Tell the learner that the environment, a user-defined policy or millrace's own code raised this error, and leave.

        If the error is that no slot was free, decline the run instead.
        """
        if isinstance(error, NoSlot) and self._session.state is not WorkerState.LEFT:
            self._decline(error)
            return
        detail = error.detail if isinstance(error, UserFacingError) else traceback.format_exc()
        lane = error.lane if isinstance(error, EnvironmentFailed) else None
        log.error("%s\n%s", error, detail)
        self._do(self._session.fail(_line(error), detail, lane, of_policy=isinstance(error, PolicyFailed)))

    def _cannot_take_part(self, error: Exception, work: Work) -> TypeGuard[UserFacingError]:
        """Whether the error means that this worker can't do such work, because something is missing here."""
        begins = isinstance(work, Describe) or (isinstance(work, RolloutTask) and not self._statistics.steps)
        return begins and _is_missing_here(error)

    def _decline(self, error: UserFacingError) -> None:
        """Leave the run. If the reason is that no slot was free, exit only once there is room for a lane, because the
        supervisor then restarts the worker.
        """
        self._close_all()
        *said, leave = self._session.decline(_line(error), 1 if isinstance(error, NoSlot) else EXIT_UNSUITABLE)
        self._do(said)
        copies = getattr(self._session.run, "copies", 1)
        while isinstance(error, NoSlot) and not (self._options.stop_requests() or slots().have_room(copies)):
            self._options.feed_watchdog(self._clock())
            time.sleep(PULSE_S)
        self._do([leave])

    def _update_statistics(self) -> None:
        earlier = self._earlier.stages
        stages: Stages = {**earlier, "wait": self._waited_s}
        steps = self._earlier.steps
        if (source := self._actors or self._stepper) is not None:
            stages |= {stage: earlier.get(stage, 0.0) + seconds for stage, seconds in source.stages.items()}
            steps += source.steps
        note = "" if self._actors is None else self._actors.note
        self._statistics = Statistics(steps, stages, self._resident_bytes, note)
        self._session.update_statistics(self._statistics)

    def _do(self, effects: list[WorkerEffect]) -> None:
        for effect in effects:
            match effect:
                case SendMessage(message):
                    self._send(message)
                case StartSession(run):
                    self._unused_from_s = math.inf
                    self._close_all()
                    self._begin(run)
                case BeginRun(run):
                    self._unused_from_s = self._clock() + UNUSED_S
                    self._begin(run)
                case CloseLanes(lanes):
                    if (owner := self._actors or self._stepper) is not None:
                        owner.lanes.close([lane.lane for lane in lanes])
                case Leave(exit_code, reason):
                    activity().leave(self._options.exit_code(exit_code, reason))
                    self._left = effect

    def _send(self, message: ToLearner) -> None:
        try:
            frames = encode(message, self._packing)
        except ValueError as error:  # a rollout with too many episodes for a message
            self._fail(error)
        else:
            self._link.send(frames)

    def _begin(self, run: WaitSpec | RunSpec | StepSpec) -> None:
        """Make the actors or the stepper for this run, unless the run has yet to begin. Those of the previous session are
        already closed.
        """
        activity().begin(WAITING)
        activity().limit(run.call_timeouts)
        self._options.feed_watchdog(self._clock())
        self._update_statistics()
        self._earlier = self._statistics
        self._actors = self._stepper = None
        if isinstance(run, WaitSpec):
            return
        why = run.rejection_reason(self._options.code)
        if self._session.identity.evaluates and isinstance(run, StepSpec):
            why = "the workers of this learner only step, and play no evaluations; start this worker without --evaluate"
        if why:
            self._do(self._session.decline(why))
            return
        try:
            match run:
                case RunSpec():
                    with activity().during(PREPARING):  # may take long, because it may import torch and user modules
                        self._actors = self._options.make_actors(run)
                    self._packing = replace(self._link.packing, zstd=run.zstd and self._link.packing.zstd)
                case StepSpec():
                    self._stepper = Stepper(
                        run,
                        self._options.shared_memory,
                        allow_private_names=self._options.code is not AllowedCode.REGISTERED,
                    )
                    self._heartbeats.start()
        except Exception as error:  # torch and the system raise many types
            if _is_missing_here(error):
                self._decline(error)
            else:
                self._fail(error)

    def _describe(self, order: Describe) -> Described:
        """Describe an environment. While the environment's code runs, a second thread sends heartbeats.

        Raises what `describe` raises, and `UsageError` if this worker isn't allowed to run the environment's code.
        """
        if why := order.env.rejection_reason(self._options.code):
            raise UsageError(why)
        heartbeats = HeartbeatThread(lambda: self._do(self._session.heartbeat_if_due(self._clock())))
        heartbeats.start()
        try:
            with heartbeats.lock_released():
                return Described(order.session, order.ticket, describe(order))
        finally:
            heartbeats.stop()

    def _close_unused(self) -> None:
        """Close the described copy if it has been unused for too long."""
        if self._clock() > self._unused_from_s:
            self._unused_from_s = math.inf
            close_described()

    def _close_all(self) -> None:
        close_described()
        if (owner := self._actors or self._stepper) is not None:
            owner.close()


def _is_missing_here(error: Exception) -> TypeGuard[UserFacingError]:
    """Whether the error means that this worker lacks the environment, a wrapper, the encoder, the policy or an opponent, or
    has another version of it.

    If the user's own code raised (`detail` is its traceback), the worker has that code.
    """
    cause = error.__cause__ if isinstance(error, PolicyFailed) else error  # a `PolicyFailed` may be about a missing module
    return isinstance(error, UserFacingError) and isinstance(cause, UsageError) and not error.detail


def _resident_bytes() -> int:
    """Resident memory of this process; 0 on a system without /proc. A call takes as long as five CartPole steps."""
    try:
        return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def _line(error: Exception) -> str:
    if isinstance(error, UserFacingError):
        return first_line(error, type(error).__name__)
    return f"{type(error).__name__}: {first_line(error, '')}".strip()


def identity(name: str, process_nonce: int | None = None, *, evaluates: bool = False) -> WorkerIdentity:
    """The identity of a worker in this process, or in one of its threads.

    `process_nonce` is its secret number; if it is None, one is drawn. `evaluates` says whether it only plays evaluations.
    """
    try:
        software = f"millrace {version('millrace-rl')}"
    except PackageNotFoundError:
        software = "millrace"
    software = f"{software}, python {platform.python_version()}"
    nonce = int.from_bytes(os.urandom(6), "little") if process_nonce is None else process_nonce  # rule REAPPEARS
    return WorkerIdentity(name, socket.gethostname(), os.getpid(), nonce, software, evaluates)


def parent_is_gone(parent: int) -> bool:
    """Whether the process that started this one has ended."""
    return os.getppid() != parent
