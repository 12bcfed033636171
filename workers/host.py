"""Many workers on this machine: started, watched, restarted with backoff, stopped. Knows nothing of what they say.

The law: a worker that ends on purpose (exit code 0), was refused (2) or found no learner for too long (NOBODY) stays away;
any other comes back, after a pause that doubles with each death and starts anew once it has been healthy for a while. No
worker outlives its host.
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

from protocol.keys.key_folder import TOKEN_VARIABLE
from protocol.keys.keys import Token
from protocol.specs import Code
from protocol.wire.link import WorkerLink
from protocol.wire.shared_memory import Handed
from workers.session import Leave, Session
from workers.watchdog import where_it_hung
from workers.worker import MakeCollector, Worker, acting_by_itself, identity

BACKOFF_FIRST_S, BACKOFF_MOST_S, HEALTHY_S = 0.5, 30.0, 30.0
POLL_S = 0.1
LEAVE_WITHIN_S = 30.0  # of being told to: a rollout of a slow environment takes its time
NOBODY = 69  # sysexits' EX_UNAVAILABLE: no learner answered; a worker says it to its host alone, anybody else is told 1


class Running(Protocol):
    """A worker that was started: a process or a thread."""

    def ended(self) -> tuple[int, str] | None:
        """Exit code and reason, or None while it runs."""
        ...

    def stop(self) -> None:
        """Ask it to leave."""
        ...

    def wait(self, timeout_s: float) -> None:
        """Wait until it has ended; a process that has not by then is killed."""
        ...

    def kill(self) -> None:
        """End it at once, if it is a process."""
        ...


class Process:
    """A worker process of its own; its stderr goes to a file."""

    def __init__(
        self,
        address: str,
        name: str,
        log: Path | None,
        token: Token | None = None,
        flags: Sequence[str] = (),
        handed: Handed | None = None,
    ) -> None:
        """`flags`: further ones of `python -m workers`; `handed`: descriptors that it inherits, to step a vector
        environment through shared memory.
        """
        self._log = log
        command = [sys.executable, "-P", "-m", "workers", address, "--name", name, "--parent", str(os.getpid()), *flags]
        if handed is not None:
            command += ["--handed", ",".join(map(str, handed))]
        # A child must find what its parent found: a user's environment may lie beside the user's script.
        path = os.pathsep.join(entry or os.getcwd() for entry in [*sys.path, str(Path(__file__).parents[1])])
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        secret = {} if token is None else {TOKEN_VARIABLE: token.to_text()}
        with (log or Path(os.devnull)).open("ab") as stderr:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=stderr if log else None,
                stderr=stderr if log else None,
                start_new_session=True,  # Ctrl-C in the terminal is the learner's to answer
                env={**os.environ, **threads, **secret, "PYTHONPATH": path},
                pass_fds=handed or (),
            )

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def ended(self) -> tuple[int, str] | None:
        """Exit code and reason; a signal is negative."""
        code = self._process.poll()
        if code is None:
            return None
        if code < 0:
            return code, f"was killed by {signal.Signals(-code).name}"
        said = self._log.read_text(errors="replace") if self._log and code else ""
        if (where := where_it_hung(said)) is not None:
            return code, f"was ended: a step of its environment took too long (--step-timeout-s), at {where}"
        last = said.strip().splitlines()[-1:]
        return code, f"ended with exit code {code}{f' ({last[0]})' if last else ''}"

    def stop(self) -> None:
        """SIGTERM: it finishes the rollout in hand."""
        if self._process.poll() is None:
            self._process.terminate()

    def wait(self, timeout_s: float) -> None:
        """Wait, then kill."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def kill(self) -> None:
        """SIGKILL: it hangs."""
        if self._process.poll() is None:
            self._process.kill()


def keeping_to(cores: Sequence[int], name: str) -> list[str]:
    """Flags of `python -m workers` for w0, w1, …: each keeps to one of these cores, in turn; to none, if there are none."""
    return ["--core", str(cores[int(name.removeprefix("w")) % len(cores)])] if cores else []


class Thread:
    """A worker in a thread of this process, over inproc: for debugging, for tests, and to act on the learner's side."""

    def __init__(
        self, address: str, name: str, context: zmq.Context[Any], make_collector: MakeCollector = acting_by_itself
    ) -> None:
        self._stops = 0
        self._left: Leave | None = None
        self._make_collector = make_collector
        self._thread = threading.Thread(target=self._run, args=(address, name, context), name=name, daemon=True)
        self._thread.start()

    def _run(self, address: str, name: str, context: zmq.Context[Any]) -> None:
        session = Session(identity(name), time.monotonic())
        link = WorkerLink(address, name, context)
        worker = Worker(
            link, session, told_to_stop=lambda: self._stops, code=Code.CALLABLES, make_collector=self._make_collector
        )
        with suppress(zmq.ContextTerminated):  # it could not be killed when all others were
            self._left = worker.run()

    def ended(self) -> tuple[int, str] | None:
        """Exit code and reason, as a process would have."""
        if self._thread.is_alive():
            return None
        return (self._left.exit_code, self._left.reason) if self._left else (1, "its thread raised")

    def stop(self) -> None:
        """Ask it to leave."""
        self._stops += 1

    def wait(self, timeout_s: float) -> None:
        """Wait; a thread cannot be killed."""
        self._thread.join(timeout_s)

    def kill(self) -> None:
        """A thread cannot be killed."""
        self._stops += 2


@dataclass
class _Place:
    """One worker's place, whoever fills it."""

    name: str
    running: Running | None
    started_s: float
    backoff_s: float = BACKOFF_FIRST_S
    restart_s: float | None = None
    code: int = 0  # with which the last one ended


class Host:
    """N workers, w0 to wN-1."""

    def __init__(
        self,
        start: Callable[[str], Running],
        count: int,
        clock: Callable[[], float] = time.monotonic,
        *,
        called: str = "w",
    ) -> None:
        """`start` starts the worker of that name, which is `called` so and has a number."""
        self._start, self._clock = start, clock
        self._stopping = False
        self.places = [_Place(name, start(name), clock()) for name in (f"{called}{number}" for number in range(count))]

    def poll(self) -> list[tuple[str, str]]:
        """The workers that have ended since the last call, and why; those that are due are started again."""
        ended, now = [], self._clock()
        for place in self.places:
            if place.running is not None and (end := place.running.ended()) is not None:
                code, why = end
                ended.append((place.name, why))
                place.running, place.code = None, code
                if now - place.started_s > HEALTHY_S:
                    place.backoff_s = BACKOFF_FIRST_S
                if code not in (0, 2, NOBODY) and not self._stopping:
                    place.restart_s = now + place.backoff_s
                    place.backoff_s = min(2 * place.backoff_s, BACKOFF_MOST_S)
            if place.restart_s is not None and now >= place.restart_s and not self._stopping:
                place.restart_s = None
                place.started_s = now
                place.running = self._start(place.name)
        return ended

    @property
    def count(self) -> int:
        """How many are here, or will come back."""
        return sum(
            place.running is not None or (place.restart_s is not None and not self._stopping) for place in self.places
        )

    @property
    def exit_code(self) -> int:
        """What became of the workers: 2 if one was refused, 1 if one ended badly, else 0."""
        codes = {place.code for place in self.places}
        return 2 if 2 in codes else 1 if codes - {0} else 0

    def ask_to_leave(self) -> None:
        """All: after the rollout in hand, or at once when asked again. Nobody is started any more."""
        self._stopping = True
        for place in self.places:
            if place.running is not None:
                place.running.stop()

    def kill(self, name: str) -> bool:
        """End the worker of this name at once; False if it is none of ours."""
        running = [place.running for place in self.places if place.name == name and place.running is not None]
        for worker in running:
            worker.kill()
        return bool(running)

    def stop(self, timeout_s: float = 5.0) -> None:
        """Ask all to leave, wait at most `timeout_s` for all together, and kill who is left."""
        self.ask_to_leave()
        deadline_s = self._clock() + timeout_s
        for place in self.places:
            if place.running is not None:
                place.running.wait(max(0.0, deadline_s - self._clock()))

    def keep(self, told_to_stop: Callable[[], int], say: Callable[[str], None]) -> int:
        """Until nobody is here any more; the exit code. Each request to stop is passed on to all."""
        heeded, leave_by_s = 0, float("inf")
        while True:
            for name, why in self.poll():
                say(f"{name} {why}")
            if not self.count:
                return self.exit_code
            if heeded < told_to_stop():
                heeded += 1
                leave_by_s = min(leave_by_s, self._clock() + LEAVE_WITHIN_S)
                self.ask_to_leave()
            if self._clock() > leave_by_s:
                self.stop(0.0)
            time.sleep(POLL_S)
