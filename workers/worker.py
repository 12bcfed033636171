"""The shell round a session: link + session + collector or stepper + signals. All decisions are the session's.

The law: the inbox is emptied before a rollout starts, and looked into between env steps, so a worker answers while it
collects and acts under the newest weights it holds. Whatever the environment does, the learner is told. In the lock-step of
a vector environment, whose steps may take as long as the caller allows, a second thread says that this worker lives.
"""

from __future__ import annotations

import logging
import os
import platform
import socket
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from protocol.errors import BadMessage, OurError, first_line
from protocol.messages import Order, Stepped, Weights
from protocol.policy.policy import make_policy
from protocol.specs import Code, RunSpec, StepSpec
from protocol.wire.codec import encode
from protocol.wire.link import WorkerLink
from protocol.wire.shared_memory import Handed
from protocol.wire.weight_dtypes import widened
from workers.collect.collector import Collector
from workers.env_errors import LaneFailed
from workers.heartbeat_thread import Breath
from workers.session import Begin, Close, Effect, Identity, Leave, Say, Session, Task
from workers.step.stepper import Stepper

log = logging.getLogger("millrace.worker")

PULSE_S = 0.05  # how often the inbox is looked into while collecting
IDLE_S = 0.5  # longest sleep while idle, so that a signal or a dead parent is noticed
MAX_TRACEBACK = 20_000  # characters
ON_ITS_WAY_S = 0.02  # a message is announced by a bell, which is faster
STATM = Path("/proc/self/statm")  # pages: all, resident, …


MakeCollector = Callable[[RunSpec], Collector]


def acting_by_itself(run: RunSpec) -> Collector:
    """Copies of its own, one lane after another, and a policy of its own."""
    return Collector(run, make_policy(run.policy, run.images_dtype))


class _Abandoned(Exception):
    """Nobody wants the rollouts in hand any more."""


class Worker:
    """One worker, from its first Hello to its exit code."""

    def __init__(
        self,
        link: WorkerLink,
        session: Session,
        *,
        told_to_stop: Callable[[], int] = lambda: 0,
        alive: Callable[[float], None] = lambda now: None,
        code: Code = Code.MODULES,
        handed: Handed | None = None,
        make_collector: MakeCollector = acting_by_itself,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`told_to_stop` counts the requests to leave; `alive` is called now and then, unless the environment hangs;
        `code`: how much the learner may have it run; `handed`: shared memory and bells, for a vector environment of this
        machine; `make_collector`: what collects in a run, and how it acts.
        """
        self._link, self._session, self._clock = link, session, clock
        self._told_to_stop, self._code = told_to_stop, code
        self._alive = alive
        self._stops_heeded = 0
        self._handed, self._make_collector = handed, make_collector
        self._collector: Collector | None = None
        self._stepper: Stepper | None = None
        self._loaded: Weights | None = None
        self._packing = link.packing
        self._pulse_due_s = 0.0
        self._left: Leave | None = None
        self._breath = Breath(lambda: self._do(self._session.breathe(self._clock())))
        self._waited_s = 0.0

    def run(self) -> Leave:
        """Work until the conversation is over. Raises nothing that the environment raised."""
        try:
            while self._left is None:
                self._do(self._session.tick(self._clock()))
                if self._left is None:
                    idle_s = min(IDLE_S, max(0.0, self._session.next_due_s() - self._clock()))
                    self._listen(self._serve(idle_s))
                while self._left is None and (task := self._session.next_task()) is not None:
                    self._collect(task)
                    self._listen(0.0)
                while self._left is None and (order := self._session.next_order()) is not None:
                    self._obey(order)
                    self._listen(0.0)
        finally:
            self._breath.stop()
            self._close_all()
            self._link.close()
        return self._left

    def _listen(self, timeout_s: float) -> None:
        """Heed signals, then everything that has arrived."""
        began_s = self._clock()
        self._alive(began_s)
        arrived = self._link.poll(timeout_s)
        self._waited_s += self._clock() - began_s
        while self._stops_heeded < self._told_to_stop():
            self._stops_heeded += 1
            self._do(self._session.terminate())
        if (trouble := self._link.trouble) is not None and trouble.final:
            self._do(self._session.turned_away(trouble.line))
        if not arrived:
            return
        for message in self._link.receive():
            if isinstance(message, BadMessage):
                log.warning("the learner sent what cannot be read: %s", message)
            else:
                self._do(self._session.handle(message, self._clock()))

    def _collect(self, task: Task) -> None:
        collector = self._collector
        assert collector is not None

        def pulse() -> None:
            self._pulse(task.session)

        try:
            if self._loaded is not task.weights:
                collector.load(widened(task.weights.parameters), task.weights.buffers)
                self._loaded = task.weights
            rollouts = collector.collect(task.assignments, task.weights.version, task.session, pulse)
        except _Abandoned:
            rollouts = []
        except Exception as error:
            self._broke(error)
            return
        self._account()
        self._do(self._session.finished(rollouts))

    def _obey(self, order: Order) -> None:
        stepper = self._stepper
        assert stepper is not None
        try:
            with self._breath.away():
                answer = stepper.obey(order, lambda: self._pulse_back(order.session))
        except _Abandoned:
            return
        except Exception as error:
            self._broke(error)
            return
        self._do(self._session.answered(answer))

    def _serve(self, timeout_s: float) -> float:
        """Step what shared memory asks for, if there is any, until there may be a message: how long to wait for it."""
        stepper, session = self._stepper, self._session.session
        if stepper is None or not stepper.shares:
            return timeout_s
        rung = False
        began_s, stepped_s = self._clock(), stepper.stages["step"]
        try:
            with self._breath.away():
                rung = stepper.serve(min(timeout_s, PULSE_S), lambda: self._pulse_back(session), session, self._say_back)
        except _Abandoned:
            pass
        except Exception as error:
            self._broke(error)
        self._waited_s += self._clock() - began_s - (stepper.stages["step"] - stepped_s)
        self._account()
        return ON_ITS_WAY_S if rung else 0.0

    def _pulse(self, session: int) -> None:
        """Show, now and then, that this worker is alive. Raises `_Abandoned` once nobody wants what it does."""
        now = self._clock()
        if now >= self._pulse_due_s:
            self._pulse_due_s = now + PULSE_S
            self._account()
            self._session.resident_bytes = _resident_bytes()
            self._listen(0.0)
            self._do(self._session.tick(now))
            if self._session.abandoned(session):
                raise _Abandoned

    def _pulse_back(self, session: int) -> None:
        """The same, out of the midst of orders."""
        if self._clock() >= self._pulse_due_s:
            with self._breath.back():
                self._pulse(session)

    def _say_back(self, answer: Stepped) -> None:
        with self._breath.back():
            self._do([Say(answer)])

    def _broke(self, error: Exception) -> None:
        """The environment's code raised, or ours on its data: the learner must hear of either."""
        detail = error.detail if isinstance(error, OurError) else traceback.format_exc()
        lane = error.lane if isinstance(error, LaneFailed) else None
        log.error("%s\n%s", error, detail)
        self._do(self._session.broke(_line(error), detail[-MAX_TRACEBACK:], lane))

    def _account(self) -> None:
        if (busy := self._collector or self._stepper) is not None:
            self._session.steps = busy.steps
            self._session.stages = {**busy.stages, "wait": self._waited_s}

    def _do(self, effects: list[Effect]) -> None:
        for effect in effects:
            match effect:
                case Say(message):
                    self._link.send(encode(message, self._packing))
                case Begin(run):
                    self._begin(run)
                case Close(lanes):
                    if (busy := self._collector or self._stepper) is not None:
                        busy.close([life.lane for life in lanes])
                case Leave():
                    self._left = effect

    def _begin(self, run: RunSpec | StepSpec) -> None:
        """A new session: a new collector or stepper, and nothing of the old one."""
        self._close_all()
        self._collector = self._stepper = None
        if why := run.why_not(self._code):
            self._do(self._session.decline(why))
            return
        try:
            match run:
                case RunSpec():
                    self._collector = self._make_collector(run)
                    self._packing = replace(self._link.packing, zstd=run.compress == "zstd")
                case StepSpec():
                    self._stepper = Stepper(run, self._handed, private=self._code is not Code.REGISTERED)
                    self._breath.start()
            self._loaded = None
        except (OurError, ImportError, ValueError) as error:
            self._do(self._session.broke(_line(error), traceback.format_exc(), None))

    def _close_all(self) -> None:
        if (busy := self._collector or self._stepper) is not None:
            busy.close_all()


def _resident_bytes() -> int:
    """Memory of this process; 0 where the system does not tell it so. As long as five steps of CartPole: ask rarely."""
    try:
        return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def _line(error: Exception) -> str:
    if isinstance(error, OurError):
        return first_line(error, type(error).__name__)[:1000]
    return f"{type(error).__name__}: {first_line(error, '')}".strip()[:1000]


def identity(name: str) -> Identity:
    """Who this process (or thread of it) is."""
    try:
        software = f"millrace {version('millrace-rl')}"
    except PackageNotFoundError:
        software = "millrace"
    software = f"{software}, python {platform.python_version()}"
    return Identity(name, socket.gethostname(), os.getpid(), int.from_bytes(os.urandom(6), "little"), software)


def parent_is_gone(parent: int) -> bool:
    """True when the process that started this one has ended."""
    return os.getppid() != parent
