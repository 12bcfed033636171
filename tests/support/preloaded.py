"""Starts `python -m learner` and `python -m millrace` as children that a preloaded parent forks: PyTorch is imported once.

Rule: a command is forked only if nothing that the interpreter or a library reads when it starts differs from the parent's:
else it is executed (`may_be_forked`). With TESTS_EXEC=1, and outside a test, every command is executed. There is one
parent for each process of pytest; it starts with the first command and ends with pytest.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Any

PROGRAM = Path(__file__).with_name("preloaded_parent.py")
LEARNERS = (["learner"], ["millrace", "train"], ["millrace", "learner"], ["millrace", "evaluate"], ["millrace", "record"])
"""Modules, and their first argument. Other commands do without PyTorch, and must be seen to."""
PER_COMMAND = {"COLUMNS", "PYTEST_CURRENT_TEST", "PYTHONPATH", "PYTHONUNBUFFERED", "TMPDIR"}
"""Variables that a child may have otherwise than its parent: nobody reads them before the command runs, or `become` does."""
BY_IMPORTS = {
    "LD_LIBRARY_PATH", "OMP_WAIT_POLICY", "PYGAME_HIDE_SUPPORT_PROMPT", "SDL_VIDEODRIVER", "TORCHINDUCTOR_CACHE_DIR",
}  # fmt: skip
"""Set by packages, and by `known_environment`, that a test has used in its own process. No test is about them."""

ENVIRONMENT = {name: value for name, value in os.environ.items() if name not in PER_COMMAND}
"""That of the parent: of the process of pytest at its start, before a test changes it."""
ANSWERS_WITHIN_S = 300.0  # importing PyTorch takes seconds, and much longer on a crowded machine

Stream = int | IO[Any] | None


def start(
    command: Sequence[str],
    *,
    stdin: Stream = None,
    stdout: Stream = None,
    stderr: Stream = None,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
) -> subprocess.Popen[bytes] | ForkedProcess:
    """Start a process, as `subprocess.Popen` does: forked if it may be, or executed."""
    if may_be_forked(command, env):
        return ForkedProcess(command, (stdin, stdout, stderr), cwd or Path.cwd(), env or os.environ)
    return subprocess.Popen(command, stdin=stdin, stdout=stdout, stderr=stderr, cwd=cwd, env=env)


def run(
    command: Sequence[str], *, timeout: float, cwd: Path | None = None, env: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a process to its end, as `subprocess.run` does, and capture what it says."""
    with start(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=cwd, env=env) as process:
        try:
            stdout, stderr = process.communicate(timeout=timeout)
        except BaseException:
            process.kill()
            raise
    assert process.returncode is not None
    return subprocess.CompletedProcess(list(command), process.returncode, stdout.decode(), stderr.decode())


def may_be_forked(command: Sequence[str], env: Mapping[str, str] | None = None) -> bool:
    """Whether a command is one of ours, and its environment is the parent's as far as it is read at the start."""
    if os.environ.get("TESTS_EXEC") or "PYTEST_CURRENT_TEST" not in os.environ or not hasattr(os, "pidfd_open"):
        return False  # a benchmark or the soak starts processes as a user does
    if list(command[:2]) != [sys.executable, "-m"] or not any(list(command[2:][: len(each)]) == each for each in LEARNERS):
        return False
    return _read_at_start(os.environ if env is None else env) == _read_at_start(ENVIRONMENT)


def _read_at_start(environment: Mapping[str, str]) -> dict[str, str]:
    """The part that must be the parent's."""
    return {name: value for name, value in environment.items() if name not in PER_COMMAND | BY_IMPORTS}


class ForkedProcess:
    """A child of the preloaded parent. Its methods are those of `subprocess.Popen`."""

    def __init__(
        self, command: Sequence[str], streams: tuple[Stream, Stream, Stream], folder: Path, env: Mapping[str, str]
    ) -> None:
        self.args = list(command)
        self.returncode: int | None = None
        ours: list[IO[bytes] | None] = []
        theirs: list[int] = []
        made: list[int] = []
        try:
            for number, stream in enumerate(streams):
                own, given = _stream(number, stream, theirs, made)
                ours.append(own)
                theirs.append(given)
            self.stdin, self.stdout, self.stderr = ours
            request = {"argv": list(command[2:]), "environment": dict(env), "folder": str(folder)}
            self.pid = _parent().ask(request, theirs)
        finally:
            for each in made:
                os.close(each)
        self._ended = os.pidfd_open(self.pid)  # until it is reaped, the id is its own

    def poll(self) -> int | None:
        """The exit code, negative for a signal, or None while it runs."""
        return self._wait(0)

    def wait(self, timeout: float | None = None) -> int:
        """Wait until it has ended. Raises `subprocess.TimeoutExpired`."""
        if self._wait(timeout) is None:
            assert timeout is not None
            raise subprocess.TimeoutExpired(self.args, timeout)
        assert self.returncode is not None
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal, if it has not ended."""
        if self.poll() is None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._ended, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout: float | None = None) -> tuple[bytes, bytes]:
        """Read stdout and stderr, where they are pipes, to their ends, and wait for the end of the process."""
        said = {}

        def read(name: str, stream: IO[bytes]) -> None:
            said[name] = stream.read()

        pipes = {"stdout": self.stdout, "stderr": self.stderr}
        readers = [threading.Thread(target=read, args=pipe, daemon=True) for pipe in pipes.items() if pipe[1] is not None]
        for reader in readers:
            reader.start()
        self.wait(timeout)
        for reader in readers:
            reader.join(timeout)
            if reader.is_alive():
                raise subprocess.TimeoutExpired(self.args, timeout or 0)
        for stream in (self.stdin, self.stdout, self.stderr):
            if stream is not None:
                stream.close()
        return said.get("stdout", b""), said.get("stderr", b"")

    def __enter__(self) -> ForkedProcess:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for stream in (self.stdout, self.stderr, self.stdin):
            if stream is not None:
                stream.close()
        self.wait()

    def _wait(self, timeout: float | None) -> int | None:
        if self.returncode is None and select.select([self._ended], [], [], timeout)[0]:
            self.returncode = os.waitstatus_to_exitcode(_parent().ask({"reap": self.pid}))
            os.close(self._ended)
        return self.returncode

    def __del__(self) -> None:
        if self.returncode is None and hasattr(self, "_ended"):
            os.close(self._ended)


def _stream(number: int, stream: Stream, before: list[int], made: list[int]) -> tuple[IO[bytes] | None, int]:
    """Our end of a standard stream, if it is a pipe, and the descriptor that the child gets; `made` must be closed here."""
    if stream is None:
        return None, number
    if stream == subprocess.STDOUT:
        return None, before[1]
    if stream == subprocess.DEVNULL:
        made.append(os.open(os.devnull, os.O_RDWR))
        return None, made[-1]
    if stream == subprocess.PIPE:
        reads, writes = os.pipe()
        made.append(reads if number == 0 else writes)
        return (open(writes, "wb") if number == 0 else open(reads, "rb")), made[-1]
    return None, stream if isinstance(stream, int) else stream.fileno()


class _Parent:
    """The preloaded parent, and our end of its socket."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._socket, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(ANSWERS_WITHIN_S)
        command = [sys.executable, "-P", str(PROGRAM), str(other.fileno())]
        with other:
            self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, env=ENVIRONMENT, pass_fds=[other.fileno()])

    def ask(self, request: dict[str, Any], descriptors: Sequence[int] = ()) -> int:
        """What it answers: the id of a new child, or the wait status of one that has ended."""
        with self._lock:
            try:
                socket.send_fds(self._socket, [json.dumps(request).encode()], list(descriptors))
                answer = self._socket.recv(64)
                assert answer, "the preloaded parent has ended"
            except BaseException:  # a deadline of the test, say: nobody may take the late answer for one to something else
                _started.remove(self)
                self.close()
                raise
        return int(answer)

    def close(self) -> None:
        """End it, and wait for its end."""
        self._socket.close()
        self.process.kill()  # it has nothing to finish
        self.process.wait()


_started: list[_Parent] = []


def _parent() -> _Parent:
    if not _started:
        _started.append(_Parent())
    return _started[0]


def parent_pid() -> int | None:
    """The process id of the preloaded parent, or None if it was not started. It is not left behind by a test."""
    return _started[0].process.pid if _started else None


def close_parent() -> None:
    """End the preloaded parent, if it was started."""
    while _started:
        _started.pop().close()
