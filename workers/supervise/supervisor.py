"""Starts, watches, restarts and stops the workers of this machine.

The supervisor doesn't follow the workers' conversation with the learner; it is only told when the run is over.

Rule: a worker that left on purpose with exit code 0, was refused (2), found no learner (EXIT_NO_LEARNER) or cannot take part
in this run (EXIT_UNSUITABLE) is not started again. Any other worker is restarted with backoff: the pause doubles with each
death, and is reset once calls to the environment have returned, or the worker has run for `HEALTHY_S` seconds. A simulator
that works and then dies is therefore restarted quickly; the learner counts its failures. A worker counts as having left on
purpose only if it has announced this; if an environment makes the process exit, that is a failure, whatever the exit code.
No worker outlives its supervisor.

A worker that has never joined a run, and has ended early `MOST_FAILED_STARTS` times in a row, is not started again, because
its problem, such as a broken installation, won't go away by itself.

With `stay`, only a refusal is final. Each worker that has left a run is replaced by a new one, which waits for the next run.

All time limits for leaving, including those of the learner, are in docs/explanation/faults.md, "How long a worker may take
to leave".
"""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from millrace.protocol.alive import StartFailed, WorkerActivity, WorkerExit
from millrace.protocol.bounds import one_line
from millrace.protocol.errors import UsageError
from millrace.workers.exit_codes import EXIT_NO_LEARNER, EXIT_REFUSED, EXIT_UNSUITABLE
from millrace.workers.supervise.how_it_ended import Ending
from millrace.workers.supervise.process_group import SessionUse, use_of_sessions

log = logging.getLogger("millrace.worker")

BACKOFF_FIRST_S = 0.5
BACKOFF_MOST_S = 30.0
HEALTHY_S = 30.0
MOST_FAILED_STARTS = 4
GIVEN_UP = f"; after {MOST_FAILED_STARTS} such ends it is not started again"
POLL_S = 0.1
ENFORCE_EVERY_S = 0.2
STOP_WITHIN_S = 3.0  # how long local workers may take to end after SIGTERM at the end of a run, before they are killed
FINISH_ROLLOUT_WITHIN_S = 30.0  # time to finish a rollout after a request to leave, while environment calls return
HANGS_AFTER_S = 8.0  # after a request to leave or the end of the run, a longer call counts as hung


class Running(Protocol):
    """A started worker: a process or a thread."""

    @property
    def name(self) -> str:
        """The worker's name, as the learner knows it."""
        ...

    @property
    def process_nonce(self) -> int:
        """The worker's secret number: `process_nonce` of its Hello."""
        ...

    @property
    def session(self) -> int | None:
        """The id of the session in which the worker and the processes of its environment run; None for a thread."""
        ...

    def ended(self) -> Ending | None:
        """How the worker ended; None while it runs."""
        ...

    def activity(self, now: float) -> WorkerActivity | None:
        """What the worker is doing. None if it has ended, or if its process is paused."""
        ...

    def last_line(self) -> str:
        """The last line of the worker's own log; empty if it has written nothing, or has no log."""
        ...

    def end_if_hung(self, now: float) -> None:
        """End the worker if a call to user code takes longer than its run allows."""
        ...

    def lower_priority(self) -> None:
        """Give the worker the lowest CPU priority, so that it uses only CPU time that other processes leave unused.

        A thread keeps its priority.
        """
        ...

    def stop(self) -> None:
        """Ask the worker to leave."""
        ...

    def wait(self, timeout_s: float) -> None:
        """Wait for at most `timeout_s` seconds until the worker has ended. A process still running after that is killed."""
        ...

    def kill(self) -> None:
        """End the worker immediately. A thread cannot be killed, so it is asked to leave immediately."""
        ...


class LearnerNotice(Protocol):
    """Reports to the learner what the workers are doing."""

    def send(self, running: Sequence[WorkerActivity], ended: Sequence[WorkerExit], now: float) -> None:
        """Report the running workers, and those that have ended since the last call, if a report is due at `now`."""
        ...

    def listen(self, for_s: float) -> bool:
        """Handle the learner's messages for this many seconds. Returns whether it has said that the run is over."""
        ...


@dataclass
class _NamedWorker:
    """A worker's name, and the process or thread that currently has it."""

    name: str
    running: Running | None
    started_s: float
    backoff_s: float = BACKOFF_FIRST_S
    restart_s: float | None = None
    exit_code: int = 0  # exit code of the last process that ended
    has_joined: bool = False  # whether a process with this name has joined a run
    failed_starts: int = 0  # number of consecutive failed starts


class Supervisor:
    """Supervises N workers, which are called w0 to wN-1 unless there is another prefix."""

    def __init__(
        self,
        start: Callable[[str], Running],
        count: int,
        clock: Callable[[], float] = time.monotonic,
        *,
        prefix: str = "w",
        stay: bool = False,
    ) -> None:
        """Start `count` workers, each by calling `start` with its name. A name consists of `prefix` and a number.

        With `stay`, they serve one run after another.
        """
        self._start = start
        self._clock = clock
        self._stay = stay
        self._stopping = False
        self._low_priority = False
        self._enforce_due_s = 0.0
        self._workers: list[_NamedWorker] = []
        try:
            for name in (f"{prefix}{number}" for number in range(count)):
                self._workers.append(_NamedWorker(name, start(name), clock()))
        except BaseException:  # if only some have started, don't leave them behind
            self.stop(0.0)
            raise

    def poll(self) -> list[WorkerExit | StartFailed]:
        """End workers that hang, restart those whose restart is due, and return those that have ended since the
        last call.
        """
        return [
            worker_exit if end.last_lines is None else StartFailed(worker_exit.worker, worker_exit.reason, end.last_lines)
            for worker_exit, end in self._ended()
        ]

    def _ended(self) -> list[tuple[WorkerExit, Ending]]:
        ended = list[tuple[WorkerExit, Ending]]()
        now = self._clock()
        enforce = now >= self._enforce_due_s
        if enforce:
            self._enforce_due_s = now + ENFORCE_EVERY_S
        for worker in self._workers:
            if worker.running is not None and enforce:
                worker.running.end_if_hung(now)
            if worker.running is not None and (end := worker.running.ended()) is not None:
                name = worker.running.name  # the learner knows it by this name
                nonce = worker.running.process_nonce
                self._record_end(worker, end, now)
                reason = end.reason + (GIVEN_UP if worker.failed_starts == MOST_FAILED_STARTS else "")
                ended.append((WorkerExit(name, nonce, one_line(reason), end.failed, end.of_policy, end.hung), end))
            if worker.restart_s is not None and now >= worker.restart_s and not self._stopping:
                self._restart(worker, now)
        return ended

    def _restart(self, worker: _NamedWorker, now: float) -> None:
        try:
            worker.running = self._start(worker.name)
        except (OSError, UsageError) as error:  # for example, the system has run out of memory, processes or files
            log.warning("worker %s cannot be started and will be tried again: %s", worker.name, error)
            self._schedule(worker, now)
            return
        worker.restart_s = None
        worker.started_s = now
        if self._low_priority:
            worker.running.lower_priority()

    def _record_end(self, worker: _NamedWorker, end: Ending, now: float) -> None:
        left = end.on_purpose and end.code in (0, EXIT_REFUSED, EXIT_NO_LEARNER, EXIT_UNSUITABLE)
        told_early = self._stopping and end.code == -signal.SIGTERM  # SIGTERM arrived before the worker could handle it
        worker.running = None
        worker.exit_code = end.code if left else 0 if told_early else 1
        healthy = end.worked or now - worker.started_s > HEALTHY_S or (left and end.code == 0)
        if healthy:
            worker.backoff_s = BACKOFF_FIRST_S
        worker.has_joined |= end.last_lines is None
        worker.failed_starts = 0 if healthy or worker.has_joined or self._stay else worker.failed_starts + 1
        final = left and (end.code == EXIT_REFUSED or not self._stay)
        if not final and not self._stopping and worker.failed_starts < MOST_FAILED_STARTS:
            self._schedule(worker, now)

    def _schedule(self, worker: _NamedWorker, now: float) -> None:
        worker.restart_s = now + worker.backoff_s
        worker.backoff_s = min(2 * worker.backoff_s, BACKOFF_MOST_S)

    def activities(self) -> list[WorkerActivity]:
        """What each running worker is doing. Paused processes are left out."""
        now = self._clock()
        activities = (worker.running.activity(now) for worker in self._workers if worker.running is not None)
        return [activity for activity in activities if activity is not None]

    def used(self) -> dict[str, SessionUse]:
        """The resources that each worker and its environment's processes use on this machine. Threads are left out."""
        sessions = {
            each.name: each.running.session
            for each in self._workers
            if each.running is not None and each.running.session is not None
        }
        used = use_of_sessions(set(sessions.values()))
        return {name: used[session] for name, session in sessions.items() if session in used}

    def said(self) -> dict[str, str]:
        """The last line of each running worker's log, if it has written one."""
        last_lines = {worker.name: worker.running.last_line() for worker in self._workers if worker.running is not None}
        return {name: line for name, line in last_lines.items() if line}

    @property
    def names(self) -> list[str]:
        """The names of the workers that are running or will be restarted."""
        restarts = not self._stopping
        return [each.name for each in self._workers if each.running is not None or (restarts and each.restart_s is not None)]

    @property
    def count(self) -> int:
        """The number of workers that are running or will be restarted."""
        return len(self.names)

    @property
    def exit_code(self) -> int:
        """2 if a worker was refused or could not take part, 1 if one failed or found no learner, else 0."""
        codes = {worker.exit_code for worker in self._workers}
        return 2 if codes & {EXIT_REFUSED, EXIT_UNSUITABLE} else 1 if codes - {0} else 0

    def ask_to_leave(self) -> None:
        """Ask all workers to leave after the rollout in progress; if called again, immediately. No worker is restarted."""
        self._stopping = True
        for worker in self._workers:
            if worker.running is not None:
                worker.running.stop()

    def lower_priority(self) -> None:
        """Give all workers the lowest CPU priority, including those that will be restarted."""
        self._low_priority = True
        for worker in self._workers:
            if worker.running is not None:
                worker.running.lower_priority()

    def kill(self, name: str) -> bool:
        """End the worker with this name immediately. Returns False if no such worker runs here."""
        running = [worker.running for worker in self._workers if worker.name == name and worker.running is not None]
        for process in running:
            process.kill()
        return bool(running)

    def stop(self, timeout_s: float = STOP_WITHIN_S) -> None:
        """Ask all workers to leave, wait at most `timeout_s` seconds for all of them, and kill those still running."""
        self.ask_to_leave()
        deadline_s = self._clock() + timeout_s
        for worker in self._workers:
            if worker.running is not None:
                worker.running.wait(max(0.0, deadline_s - self._clock()))

    def run(
        self, stop_requests: Callable[[], int], report: Callable[[str], None], notice: LearnerNotice | None = None
    ) -> int:
        """Watch the workers until none is left. Returns the exit code.

        Each request to stop is passed on to all workers. After the first one, or once the run is over, no worker is
        restarted, and a worker whose environment hangs is killed. With `stay`, workers are restarted after the end of a run,
        but one that hangs at that time is killed too. `report` gets a line about each worker that ends.
        """
        handled = 0
        leave_by_s = float("inf")
        kill_hanging_from_s = float("inf")
        over = False
        while True:
            ended = self._ended()
            for each, end in ended:
                if (
                    len(self._workers) > 1 or not end.on_purpose
                ):  # a lone worker that ends on purpose has already said why it left
                    report(f"{each.worker} {each.reason}")
            if notice is not None:
                notice.send(self.activities(), [each for each, _ in ended], self._clock())
            if not self.count:
                return self.exit_code
            now = self._clock()
            if handled < stop_requests():
                handled += 1
                leave_by_s = min(leave_by_s, now + FINISH_ROLLOUT_WITHIN_S)
                kill_hanging_from_s = min(kill_hanging_from_s, now + HANGS_AFTER_S)
                self.ask_to_leave()
            if over and not self._stopping:
                self._stopping = not self._stay
                kill_hanging_from_s = min(kill_hanging_from_s, now + HANGS_AFTER_S)
                leave_by_s = kill_hanging_from_s if self._stopping else leave_by_s
            if now > kill_hanging_from_s:
                self._kill_hanging(HANGS_AFTER_S, now)
                if not self._stopping:  # with `stay`, the workers that remain wait for the next run
                    kill_hanging_from_s = float("inf")
            if now > leave_by_s:
                self.stop(0.0)
            if notice is not None:
                over = notice.listen(POLL_S)
            else:
                time.sleep(POLL_S)

    def _kill_hanging(self, longer_than_s: float, now: float) -> None:
        """Kill the workers whose current activity has lasted longer than this."""
        for worker in self._workers:
            doing = None if worker.running is None else worker.running.activity(now)
            if worker.running is not None and doing is not None and doing.for_s > longer_than_s:
                worker.running.kill()


def core_flags(cores: Sequence[int], name: str) -> list[str]:
    """The flags that pin worker `name`, one of w0, w1, …, to one of these cores. Empty if there are no cores."""
    return ["--core", str(cores[int(name.removeprefix("w")) % len(cores)])] if cores else []
