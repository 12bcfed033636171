"""A worker in a thread of this process, over inproc: for debugging, tests, and inference on the learner's side."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from typing import Any

import zmq

from millrace.protocol.alive import WorkerActivity
from millrace.protocol.bounds import one_line
from millrace.protocol.env_spec import AllowedCode
from millrace.protocol.wire.worker_link import WorkerLink
from millrace.workers.activity import Activity, ActivityReader, share_activity
from millrace.workers.actors import MakeActors, make_local_actors
from millrace.workers.conversation.connection_rules import LEARNER_STARTED_IT_S, wait_limits_s
from millrace.workers.conversation.session import Leave, Session
from millrace.workers.supervise.how_it_ended import Ending
from millrace.workers.worker import Worker, WorkerOptions, identity


class WorkerThread:
    """A worker in a thread of this process. A thread cannot be killed."""

    def __init__(
        self,
        address: str,
        name: str,
        context: zmq.Context[Any],
        make_actors: MakeActors = make_local_actors,
        *,
        evaluates: bool = False,
    ) -> None:
        """Start the thread. `evaluates` says whether the worker only plays evaluations."""
        self.name = name
        self.session = None
        self._identity = identity(name, evaluates=evaluates)
        self.process_nonce = self._identity.process_nonce
        self._page = Activity()
        self._reader = ActivityReader(self._page)
        self._stop_requests = 0
        self._left: Leave | None = None
        self._make_actors = make_actors
        self._thread = threading.Thread(target=self._run, args=(address, context), name=name, daemon=True)
        self._thread.start()

    def _run(self, address: str, context: zmq.Context[Any]) -> None:
        share_activity(self._page)
        join_timeout_s, rejoin_timeout_s = wait_limits_s(LEARNER_STARTED_IT_S, stay=False)
        session = Session(self._identity, time.monotonic(), join_timeout_s=join_timeout_s, rejoin_timeout_s=rejoin_timeout_s)
        link = WorkerLink(address, self.name, context)
        options = WorkerOptions(
            code=AllowedCode.CALLABLES, stop_requests=lambda: self._stop_requests, make_actors=self._make_actors
        )
        with suppress(zmq.ContextTerminated):  # the run ended without waiting for this thread
            self._left = Worker(link, session, options).run()

    def ended(self) -> Ending | None:
        """How the worker ended; None while it runs."""
        if self._thread.is_alive():
            return None
        if self._left is None:
            return Ending(1, "its thread raised", failed=True)
        return Ending(self._left.exit_code, one_line(self._left.reason), on_purpose=True)

    def activity(self, now: float) -> WorkerActivity | None:
        """What the worker is doing; None if it has ended."""
        if not self._thread.is_alive():
            return None
        page = self._reader.read(now)
        return WorkerActivity(self.name, self.process_nonce, page.doing, page.for_s, page.env_calls)

    def last_line(self) -> str:
        """Always empty, because a thread has no log of its own: it writes to this process's stderr."""
        return ""

    def end_if_hung(self, now: float) -> None:
        """Do nothing, because a thread cannot be ended from outside."""

    def lower_priority(self) -> None:
        """Do nothing, because a thread keeps its priority."""

    def stop(self) -> None:
        """Ask the worker to leave after the rollout in progress."""
        self._stop_requests += 1

    def wait(self, timeout_s: float) -> None:
        """Wait for at most `timeout_s` seconds until the worker has ended. A thread still running can't be killed."""
        self._thread.join(timeout_s)

    def kill(self) -> None:
        """Ask the worker to leave immediately, because a thread can't be killed."""
        self._stop_requests += 2
