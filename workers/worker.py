"""The shell round a session: link + session + collector + signals. All decisions are the session's.

The law: the inbox is emptied before a rollout starts, and looked into between env steps, so a worker answers while it
collects and acts under the newest weights it holds. Whatever the environment does, the learner is told.
"""

from __future__ import annotations

import logging
import os
import platform
import socket
import time
import traceback
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from protocol.codec import encode
from protocol.errors import BadMessage, OurError
from protocol.link import WorkerLink
from protocol.messages import Weights
from protocol.policy import make_policy
from protocol.specs import Code, RunSpec
from workers.collector import Collector
from workers.lane import EnvironmentBroke
from workers.session import Begin, Close, Effect, Identity, Leave, Say, Session, Task

log = logging.getLogger("millrace.worker")

PULSE_S = 0.05  # how often the inbox is looked into while collecting
IDLE_S = 0.5  # longest sleep while idle, so that a signal or a dead parent is noticed
MAX_TRACEBACK = 20_000  # characters
STATM = Path("/proc/self/statm")  # pages: all, resident, …


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
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`told_to_stop` counts the requests to leave; `alive` is called now and then, unless the environment hangs;
        `code`: how much the learner may have it run.
        """
        self._link, self._session, self._clock = link, session, clock
        self._told_to_stop, self._code = told_to_stop, code
        self._alive = alive
        self._stops_heeded = 0
        self._collector: Collector | None = None
        self._loaded: Weights | None = None
        self._pulse_due_s = 0.0
        self._left: Leave | None = None
        self._waited_s = 0.0

    def run(self) -> Leave:
        """Work until the conversation is over. Raises nothing that the environment raised."""
        try:
            while self._left is None:
                self._do(self._session.tick(self._clock()))
                if self._left is None:
                    self._listen(min(IDLE_S, max(0.0, self._session.next_due_s() - self._clock())))
                while self._left is None and (task := self._session.next_task()) is not None:
                    self._collect(task)
                    self._listen(0.0)
        finally:
            if self._collector is not None:
                self._collector.close_all()
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
            now = self._clock()
            if now >= self._pulse_due_s:
                self._pulse_due_s = now + PULSE_S
                self._account()
                self._listen(0.0)
                self._do(self._session.tick(now))
                if self._session.abandoned(task):
                    raise _Abandoned

        try:
            if self._loaded is not task.weights:
                collector.load(task.weights.parameters, task.weights.buffers)
                self._loaded = task.weights
            rollouts = collector.collect(task.assignments, task.weights.version, task.session, pulse)
        except _Abandoned:
            rollouts = []
        except Exception as error:  # the environment's code, or ours on its data: the learner must hear of either
            detail = error.detail if isinstance(error, OurError) else traceback.format_exc()
            lane = error.lane if isinstance(error, EnvironmentBroke) else None
            log.error("%s\n%s", error, detail)
            self._do(self._session.broke(_line(error), detail[-MAX_TRACEBACK:], lane))
            return
        self._account()
        self._do(self._session.finished(rollouts))

    def _account(self) -> None:
        if self._collector is not None:
            self._session.steps = self._collector.steps
            self._session.stages = {**self._collector.stages, "wait": self._waited_s}
            self._session.resident_bytes = _resident_bytes()

    def _do(self, effects: list[Effect]) -> None:
        for effect in effects:
            match effect:
                case Say(message):
                    self._link.send(encode(message))
                case Begin(run):
                    self._begin(run)
                case Close(lanes):
                    if self._collector is not None:
                        self._collector.close(life.lane for life in lanes)
                case Leave():
                    self._left = effect

    def _begin(self, run: RunSpec) -> None:
        """A new session: a new collector, and nothing of the old one."""
        if self._collector is not None:
            self._collector.close_all()
        if why := run.why_not(self._code):
            self._do(self._session.decline(why))
            return
        try:
            self._collector = Collector(run, make_policy(run.policy))
            self._loaded = None
        except (OurError, ImportError) as error:
            self._do(self._session.broke(_line(error), traceback.format_exc(), None))


def _resident_bytes() -> int:
    """Memory of this process; 0 where the system does not tell it so."""
    try:
        return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def _line(error: Exception) -> str:
    text = str(error) if isinstance(error, OurError) else f"{type(error).__name__}: {error}"
    return (text.strip().splitlines() or [type(error).__name__])[0][:1000]


def identity(name: str) -> Identity:
    """Who this process (or thread of it) is."""
    try:
        software = f"millrace {version('millrace')}"
    except PackageNotFoundError:
        software = "millrace"
    software = f"{software}, python {platform.python_version()}"
    return Identity(name, socket.gethostname(), os.getpid(), int.from_bytes(os.urandom(6), "little"), software)


def parent_is_gone(parent: int) -> bool:
    """True when the process that started this one has ended."""
    return os.getppid() != parent
