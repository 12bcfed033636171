"""A worker in its own process, which its supervisor starts, watches and ends.

Rule: the worker has its own session. When the worker has ended, every process that its environment started in that session
is killed. The slots of its env copies become free only when all of these processes are gone, because the supervisor holds
the slots too. If a call to user code takes longer than its run allows, the worker writes its stacks and is killed. A worker
that leaves on purpose announces it; any other end is a failure, whatever the exit code.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from millrace.protocol.alive import WorkerActivity
from millrace.protocol.bounds import escaped, one_line
from millrace.protocol.call_timeouts import CALLS, OF_POLICY, OUR_CODE
from millrace.protocol.keys.keys import Token
from millrace.protocol.keys.worker_token import TOKEN_VARIABLE
from millrace.workers.activity import STACK_SIGNAL, ActivityReader
from millrace.workers.machine_slots import free_all, open_slots, touch
from millrace.workers.supervise.how_it_ended import Ending
from millrace.workers.supervise.process_group import kill, live_members, process_stat
from millrace.workers.supervise.short_log import keep_short
from millrace.workers.watchdog import deepest_frame, where_it_hung

log = logging.getLogger("millrace.worker")

popen = subprocess.Popen  # tests replace this to start workers in another way

NONCE_VARIABLE = "MILLRACE_WORKER_NONCE"
WRITE_STACKS_S = 0.3  # time for writing stacks, from the signal until the worker is killed
CLOSE_ENVS_WITHIN_S = 5.0  # how long a worker may take to close its environments and end after announcing that it leaves
KILLED_WITHIN_S = 5.0  # how long to wait for processes to end after SIGKILL
POLL_S = 0.02
LONGEST_OUTPUT = 1 << 20  # at most this many bytes are read, from the end of a log
MOST_LAST_LINES = 12  # at most this many lines of the log are shown if a worker cannot start
MAX_LAST_TEXT = 2_000  # and at most this many characters of those lines
LOWEST_PRIORITY = 19  # niceness
SINGLE_THREADED = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class WorkerCommand:
    """How to start a worker process."""

    address: str
    name: str
    log: Path | None = None
    """The file for the worker's output. If None, the worker writes to the stdout and stderr of the supervisor."""
    token: Token | None = None
    flags: Sequence[str] = ()
    """Additional flags for `python -m millrace.workers`."""
    handed: Sequence[int] = ()
    """File descriptors that these flags name, and that the worker inherits."""


class WorkerProcess:
    """A worker in its own process, as its supervisor sees it."""

    def __init__(self, start: WorkerCommand) -> None:
        self.name = start.name
        self._owner = os.getpid()
        self._log = start.log
        self.process_nonce = int.from_bytes(os.urandom(6), "little")
        self._slots = open_slots()
        self._page = ActivityReader()
        self._because = ""  # why the supervisor ended the worker, if it did
        self._kill_at_s = float("inf")
        self._end: Ending | None = None
        self._exit_code: int | None = None  # set when the worker has ended; processes that it started may still run
        self._give_up_at_s = float("inf")
        self._was_reaped = False  # whether the system has reaped the worker, so that its exit code is not known
        command = [sys.executable, "-P", "-m", "millrace.workers", start.address, "--name", start.name]
        command += ["--parent", str(os.getpid()), "--activity", str(self._page.fd)]
        command += ["--slots", str(self._slots), *start.flags]
        # The child must find the modules that its parent found, because a user's environment may be in their script's
        # folder.
        path = os.pathsep.join(entry or os.getcwd() for entry in [*sys.path, str(Path(__file__).parents[3])])
        # Remove the variable, because a token in it is for another learner. A token for this learner is `start.token`.
        environment = {name: value for name, value in os.environ.items() if name != TOKEN_VARIABLE}
        environment |= SINGLE_THREADED | {NONCE_VARIABLE: str(self.process_nonce), "PYTHONPATH": path}
        try:
            with _opened(start.log) as stderr, _token_pipe(start.token) as token:
                command += [word for fd in token for word in ("--token", f"/dev/fd/{fd}")]
                self._log_from = stderr.tell()  # earlier text comes from another process
                self._process = popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=stderr if start.log else None,
                    stderr=stderr if start.log else None,
                    start_new_session=True,  # only the supervisor gets the Ctrl-C of the terminal
                    env=environment,
                    pass_fds=(self._page.fd, self._slots, *token, *start.handed),
                )
        except BaseException:
            self._page.close()
            free_all(self._slots)
            raise

    @property
    def pid(self) -> int:
        """The process id of the worker."""
        return self._process.pid

    @property
    def session(self) -> int:
        """The worker leads a session of its own."""
        return self._process.pid

    def ended(self) -> Ending | None:
        """How the worker ended; None while it, or a process that it started, still runs."""
        if self._is_inherited:
            return Ending(0, "belongs to the process that started it", on_purpose=True)
        if self._runs():
            return None
        if self._end is None:
            if left := live_members(self.pid):
                if time.monotonic() < self._give_up_at_s:
                    return None
                line = "worker %s has ended, but processes %s of its environment have not, so its slots stay taken"
                log.warning(line, self.name, left)
            else:
                free_all(self._slots)
            assert self._exit_code is not None
            self._end = self._ending(self._exit_code)
            self._page.close()
        return self._end

    def activity(self, now: float) -> WorkerActivity | None:
        """What the worker is doing.

        None if it has ended, or if its process is paused; the learner then considers the worker silent. While processes that
        an ended worker started still run, the worker's last activity is reported, because a learner that considered the
        worker silent during that time would not count the failure.
        """
        if self.ended() is not None or _is_stopped(self.pid):
            return None
        page = self._page.read(now)
        return WorkerActivity(self.name, self.process_nonce, page.doing, page.for_s, page.env_calls)

    def last_line(self) -> str:
        """The last line that this process has written to its log; empty if there is none."""
        return one_line("".join(self._output().strip().splitlines()[-1:]))

    def end_if_hung(self, now: float) -> None:
        """End the worker if a call to user code takes longer than its run allows, or if it has announced its exit but
        doesn't end.
        """
        if not self._runs():
            return
        touch(self._slots)
        self._keep_log_short()
        if now >= self._kill_at_s:
            self.kill()
        elif not self._because:
            page = self._page.read(now)
            if page.exit_code is not None:
                if page.leaves_for_s > CLOSE_ENVS_WITHIN_S:
                    self.kill()
            elif page.for_s > page.timeouts.limit_s(page.doing):
                self._because = page.timeouts.reason(page.doing)
                self._kill_at_s = now + WRITE_STACKS_S
                if STACK_SIGNAL is not None:
                    self._process.send_signal(STACK_SIGNAL)

    def lower_priority(self) -> None:
        """Give the worker's main thread, which steps the environments, the lowest CPU priority.

        With Linux's autogroup, the niceness of a process matters only within its session, and a worker has its own session.
        The session therefore gets the lowest priority too.
        """
        if self._runs():
            os.setpriority(os.PRIO_PROCESS, self.pid, LOWEST_PRIORITY)
            with suppress(OSError):  # this system has no autogroup
                Path(f"/proc/{self.pid}/autogroup").write_text(str(LOWEST_PRIORITY))

    def stop(self) -> None:
        """Send SIGTERM: the worker finishes the rollout in progress, and leaves."""
        if self._runs():
            self._process.terminate()

    def wait(self, timeout_s: float) -> None:
        """Wait for at most `timeout_s` seconds until the worker has ended; kill it if it is still running after that.

        A process that survives even SIGKILL, because it waits for a device or a network file system, is left behind.
        """
        if not self._ends_within(timeout_s):
            self.kill()
            if not self._ends_within(KILLED_WITHIN_S):
                log.warning("worker %s (process %d) was killed and has not ended; it is left behind", self.name, self.pid)

    def _ends_within(self, seconds: float) -> bool:
        deadline_s = time.monotonic() + seconds
        while self.ended() is None:
            if time.monotonic() >= deadline_s:
                return False
            time.sleep(POLL_S)
        return True

    def kill(self) -> None:
        """Send SIGKILL to the worker's whole session."""
        if self._runs():
            self._kill_session()

    # ---------------------------------------------------------------- inside

    @property
    def _is_inherited(self) -> bool:
        """Whether this process was forked from the one that started the worker. It must leave the worker alone."""
        return os.getpid() != self._owner

    def _runs(self) -> bool:
        """Whether the worker runs and belongs to this process. If it has ended, its session is killed and it is reaped."""
        if self._is_inherited:
            return False
        if self._exit_code is None and self._has_ended():
            self._kill_session()  # before the process is reaped: until then no other process can have its id
            self._exit_code = self._process.wait()
            self._give_up_at_s = time.monotonic() + KILLED_WITHIN_S
        return self._exit_code is None

    def _has_ended(self) -> bool:
        """Whether the worker has ended. If the system allows, this doesn't reap it."""
        if not hasattr(os, "waitid"):
            return self._process.poll() is not None
        try:
            return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
        except ChildProcessError:  # the worker was reaped already, because this program ignores SIGCHLD
            self._was_reaped = True
            return True

    def _kill_session(self) -> None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)
        kill(live_members(self.pid))

    def _ending(self, code: int) -> Ending:
        """How the worker ended. `code` is negative if a signal ended it."""
        page = self._page.read(time.monotonic())
        output = self._output()
        last = "".join(f" ({line})" for line in output.strip().splitlines()[-1:])
        meanwhile = f" in {CALLS[page.doing]}" if page.doing in CALLS else ""
        if page.doing == "starting":
            meanwhile = " while it started"
        worked = page.env_calls > 0
        if self._because:
            stacks = self._page.stacks()
            self._write(stacks)
            where = deepest_frame(stacks)
            line = self._because + (f", at {where}" if where else "")
        elif page.exit_code is not None:
            line = f"ended with exit code {page.exit_code}{last if page.exit_code else ''}"
            last_lines = _end_of(output) if page.exit_code and page.doing == "starting" else None
            return Ending(page.exit_code, one_line(line), on_purpose=True, worked=worked, last_lines=last_lines)
        elif code < 0:
            line = f"was killed by {_signal_name(-code)}{meanwhile}"
        elif (hung := where_it_hung(output)) is not None:
            line = f"was ended: it made no progress, at {hung}"
        elif self._was_reaped:
            line = f"ended{meanwhile}; its exit code is not known"
        else:
            line = f"ended with exit code {code}{meanwhile}{last if code else ''}"
        # When an environment is closed, its work is done. If the process ends in `close`, that doesn't count as a failure.
        failed = page.doing != "closing" and (worked or page.doing not in OUR_CODE)
        of_policy = failed and page.doing in OF_POLICY
        last_lines = _end_of(output) if page.doing == "starting" else None
        return Ending(
            code=code,
            reason=one_line(line),
            failed=failed,
            of_policy=of_policy,
            hung=failed and bool(self._because),
            worked=worked,
            last_lines=last_lines,
        )

    def _output(self) -> str:
        """The worker's output in the log; only the end if it is long, because a simulator may write without limit."""
        with suppress(OSError):  # the log may have been deleted
            if self._log is not None:
                with self._log.open("rb") as log:
                    log.seek(max(self._log_from, log.seek(0, os.SEEK_END) - LONGEST_OUTPUT))
                    return log.read().decode(errors="replace")
        return ""

    def _keep_log_short(self) -> None:
        with suppress(OSError):  # the log may have been deleted
            if self._log is not None:
                self._log_from = keep_short(self._log, self._log_from)

    def _write(self, stacks: str) -> None:
        """Append to the worker's output the reason for ending the worker, and its stacks."""
        text = f"worker {self.name} {self._because}\n{stacks}"
        with suppress(OSError):
            if self._log is None:
                sys.stderr.write(text)
            else:
                with self._log.open("a") as log:
                    log.write(text)


def _end_of(output: str) -> str:
    """The last lines of a worker's output."""
    return escaped("\n".join(output.strip().splitlines()[-MOST_LAST_LINES:]))[-MAX_LAST_TEXT:]


def _signal_name(number: int) -> str:
    """The name of a signal, or its number if it has no name, like most real-time signals."""
    return signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"


@contextmanager
def _token_pipe(token: Token | None) -> Iterator[list[int]]:
    """The file descriptor of a pipe from which the worker can read its token; none without a token.

    Every process of the user can read the command line and the environment variables with which a process was started.
    """
    if token is None:
        yield []
        return
    reads, writes = os.pipe()
    try:
        with os.fdopen(writes, "w") as file:
            file.write(token.to_text())
        yield [reads]
    finally:
        os.close(reads)


def _opened(log: Path | None) -> BinaryIO:
    """Open the file for a worker's output. If its folder was deleted, it is recreated; if that fails, output is dropped."""
    with suppress(OSError):
        if log is not None:
            log.parent.mkdir(parents=True, exist_ok=True)
            return log.open("ab")
    return Path(os.devnull).open("ab")


def _is_stopped(pid: int) -> bool:
    """Whether a signal or a debugger has paused the process. False on a system without /proc."""
    return process_stat(pid)[:1] in (["T"], ["t"])
