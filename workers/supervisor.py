"""Starts, watches, restarts and stops the workers of this machine. Knows nothing of their conversation with the learner.

Rule: a worker that left on purpose (exit code 0), was refused (2) or found no learner (EXIT_NO_LEARNER) is not started
again. Any other is restarted with backoff: the pause doubles with each death, and is reset once a worker has run for
`HEALTHY_S`. No worker outlives its supervisor.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import zmq

from protocol.env_spec import AllowedCode
from protocol.keys.key_folder import TOKEN_VARIABLE
from protocol.keys.keys import Token
from protocol.wire.shared_memory import InheritedDescriptors
from protocol.wire.worker_link import WorkerLink
from workers.session import Leave, Session
from workers.watchdog import where_it_hung
from workers.worker import MakeCollector, Worker, WorkerOptions, identity, make_local_collector

BACKOFF_FIRST_S, BACKOFF_MOST_S, HEALTHY_S = 0.5, 30.0, 30.0
POLL_S = 0.1
LEAVE_WITHIN_S = 30.0  # after the request to leave: a rollout of a slow environment takes long
EXIT_NO_LEARNER = 69  # EX_UNAVAILABLE of sysexits: no learner answered. A supervisor gets this code, others get 1


class Running(Protocol):
    """A started worker: a process or a thread."""

    def ended(self) -> tuple[int, str] | None:
        """Exit code and reason, or None while it runs."""
        ...

    def stop(self) -> None:
        """Ask it to leave."""
        ...

    def wait(self, timeout_s: float) -> None:
        """Wait until it has ended. A process that is still running after that is killed."""
        ...

    def kill(self) -> None:
        """End it at once. A thread cannot be killed, and is asked to leave at once."""
        ...


@dataclass(frozen=True)
class WorkerCommand:
    """How to start a worker process."""

    address: str
    name: str
    log: Path | None = None
    """File for the worker's stderr. None: the supervisor's own stderr."""
    token: Token | None = None
    flags: Sequence[str] = ()
    """Further flags of `python -m workers`."""
    shared_memory: InheritedDescriptors | None = None
    """File descriptors that the worker inherits, to step a vector environment through shared memory."""


class WorkerProcess:
    """A worker in a process of its own."""

    def __init__(self, start: WorkerCommand) -> None:
        self._log = log = start.log
        command = [sys.executable, "-P", "-m", "workers", start.address, "--name", start.name]
        command += ["--parent", str(os.getpid()), *start.flags]
        if start.shared_memory is not None:
            command += ["--handed", ",".join(map(str, start.shared_memory))]
        # The child must find the modules that its parent found: a user's environment may lie beside the user's script.
        path = os.pathsep.join(entry or os.getcwd() for entry in [*sys.path, str(Path(__file__).parents[1])])
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        secret = {} if start.token is None else {TOKEN_VARIABLE: start.token.to_text()}
        with (log or Path(os.devnull)).open("ab") as stderr:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=stderr if log else None,
                stderr=stderr if log else None,
                start_new_session=True,  # only the learner gets the Ctrl-C of the terminal
                env={**os.environ, **threads, **secret, "PYTHONPATH": path},
                pass_fds=start.shared_memory or (),
            )

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def ended(self) -> tuple[int, str] | None:
        """Exit code and reason, or None while it runs. The code is negative if a signal ended it."""
        code = self._process.poll()
        if code is None:
            return None
        if code < 0:
            return code, f"was killed by {signal.Signals(-code).name}"
        output = self._log.read_text(errors="replace") if self._log and code else ""
        if (where := where_it_hung(output)) is not None:
            return code, f"was ended: a step of its environment took too long (--step-timeout-s), at {where}"
        last = output.strip().splitlines()[-1:]
        return code, f"ended with exit code {code}{f' ({last[0]})' if last else ''}"

    def stop(self) -> None:
        """SIGTERM: it finishes the rollout in progress, and leaves."""
        if self._process.poll() is None:
            self._process.terminate()

    def wait(self, timeout_s: float) -> None:
        """Wait until it has ended; kill it if it is still running after that."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def kill(self) -> None:
        """SIGKILL, for a worker that hangs."""
        if self._process.poll() is None:
            self._process.kill()


def core_flags(cores: Sequence[int], name: str) -> list[str]:
    """Flags of `python -m workers` that pin worker w0, w1, … to one of these cores, in turn. None if there are no cores."""
    return ["--core", str(cores[int(name.removeprefix("w")) % len(cores)])] if cores else []


class WorkerThread:
    """A worker in a thread of this process, over inproc: for debugging, tests, and inference on the learner's side."""

    def __init__(
        self, address: str, name: str, context: zmq.Context[Any], make_collector: MakeCollector = make_local_collector
    ) -> None:
        self._stop_requests = 0
        self._left: Leave | None = None
        self._make_collector = make_collector
        self._thread = threading.Thread(target=self._run, args=(address, name, context), name=name, daemon=True)
        self._thread.start()

    def _run(self, address: str, name: str, context: zmq.Context[Any]) -> None:
        session = Session(identity(name), time.monotonic())
        link = WorkerLink(address, name, context)
        options = WorkerOptions(
            code=AllowedCode.CALLABLES, stop_requests=lambda: self._stop_requests, make_collector=self._make_collector
        )
        with suppress(zmq.ContextTerminated):  # the run has ended, and a thread could not be killed
            self._left = Worker(link, session, options).run()

    def ended(self) -> tuple[int, str] | None:
        """Exit code and reason, or None while it runs."""
        if self._thread.is_alive():
            return None
        return (self._left.exit_code, self._left.reason) if self._left else (1, "its thread raised")

    def stop(self) -> None:
        """Ask it to leave."""
        self._stop_requests += 1

    def wait(self, timeout_s: float) -> None:
        """Wait until it has ended. A thread cannot be killed."""
        self._thread.join(timeout_s)

    def kill(self) -> None:
        """Ask it to leave at once: a thread cannot be killed."""
        self._stop_requests += 2


@dataclass
class _WorkerSlot:
    """A worker's name, and the process or thread that runs under it at present."""

    name: str
    running: Running | None
    started_s: float
    backoff_s: float = BACKOFF_FIRST_S
    restart_s: float | None = None
    exit_code: int = 0  # of the last one that ended


class Supervisor:
    """N workers, w0 to wN-1."""

    def __init__(
        self,
        start: Callable[[str], Running],
        count: int,
        clock: Callable[[], float] = time.monotonic,
        *,
        prefix: str = "w",
    ) -> None:
        """`start` starts the worker of a name; the names are `prefix` and a number."""
        self._start, self._clock = start, clock
        self._stopping = False
        self._slots = [_WorkerSlot(name, start(name), clock()) for name in (f"{prefix}{number}" for number in range(count))]

    def poll(self) -> list[tuple[str, str]]:
        """(name, reason) of each worker that has ended since the last call. Starts those whose restart is due."""
        ended, now = [], self._clock()
        for slot in self._slots:
            if slot.running is not None and (end := slot.running.ended()) is not None:
                code, reason = end
                ended.append((slot.name, reason))
                slot.running, slot.exit_code = None, code
                if now - slot.started_s > HEALTHY_S:
                    slot.backoff_s = BACKOFF_FIRST_S
                if code not in (0, 2, EXIT_NO_LEARNER) and not self._stopping:
                    slot.restart_s = now + slot.backoff_s
                    slot.backoff_s = min(2 * slot.backoff_s, BACKOFF_MOST_S)
            if slot.restart_s is not None and now >= slot.restart_s and not self._stopping:
                slot.restart_s = None
                slot.started_s = now
                slot.running = self._start(slot.name)
        return ended

    @property
    def count(self) -> int:
        """Number of workers that run or will be restarted."""
        return sum(slot.running is not None or (slot.restart_s is not None and not self._stopping) for slot in self._slots)

    @property
    def exit_code(self) -> int:
        """2 if a worker was refused, 1 if one failed, else 0."""
        codes = {slot.exit_code for slot in self._slots}
        return 2 if 2 in codes else 1 if codes - {0} else 0

    def ask_to_leave(self) -> None:
        """Ask all workers to leave after the rollout in progress, or at once when asked again. Restart none."""
        self._stopping = True
        for slot in self._slots:
            if slot.running is not None:
                slot.running.stop()

    def kill(self, name: str) -> bool:
        """End the worker of this name at once; False if no such worker runs here."""
        running = [slot.running for slot in self._slots if slot.name == name and slot.running is not None]
        for worker in running:
            worker.kill()
        return bool(running)

    def stop(self, timeout_s: float = 5.0) -> None:
        """Ask all to leave, wait at most `timeout_s` for all together, and kill those still running."""
        self.ask_to_leave()
        deadline_s = self._clock() + timeout_s
        for slot in self._slots:
            if slot.running is not None:
                slot.running.wait(max(0.0, deadline_s - self._clock()))

    def run(self, stop_requests: Callable[[], int], report: Callable[[str], None]) -> int:
        """Watch the workers until none is left; the exit code. Each request to stop is passed on to all of them."""
        handled, leave_by_s = 0, float("inf")
        while True:
            for name, reason in self.poll():
                report(f"{name} {reason}")
            if not self.count:
                return self.exit_code
            if handled < stop_requests():
                handled += 1
                leave_by_s = min(leave_by_s, self._clock() + LEAVE_WITHIN_S)
                self.ask_to_leave()
            if self._clock() > leave_by_s:
                self.stop(0.0)
            time.sleep(POLL_S)
