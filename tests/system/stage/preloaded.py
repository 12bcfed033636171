"""Starts learners and workers as children that a preloaded parent forks: imports happen once.

Rule: a command is forked only if nothing that the interpreter or a library reads when it starts differs from the parent's:
else it is executed (`may_be_forked`). With TESTS_EXEC=1, and outside a test, every command is executed. Each process of
pytest has one parent for learners and one for workers; it starts with its first command and ends with pytest.
"""

from __future__ import annotations

import ctypes
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
from typing import IO, Any, Literal

import psutil

from millrace.workers.supervise.worker_process import NONCE_VARIABLE

PROGRAM = Path(__file__).with_name("preloaded_parent.py")
LEARNERS = (["millrace", "train"], ["millrace", "learner"], ["millrace", "evaluate"], ["millrace", "record"])
"""Modules, and their first argument: what the parent with PyTorch forks."""
WITHOUT_PYTORCH = (["millrace.workers"], ["millrace", "worker"], ["millrace", "status"], ["millrace", "keys"])
WORKER = ["-P", "-m", "millrace.workers"]  # as a supervisor starts it
PER_COMMAND = {
    "COLUMNS", "HOME", "MILLRACE_KEYS", "MILLRACE_SLOTS", "MILLRACE_TOKEN", "MILLRACE_TOY_SLEEPS_S",
    "MINARI_DATASETS_PATH", "MPLBACKEND", "PYTEST_CURRENT_TEST", "PYTHONPATH", "PYTHONUNBUFFERED",
    "TERM", "TMPDIR", "WANDB_MODE", NONCE_VARIABLE,
}  # fmt: skip
"""Variables that a child may have otherwise than its parent: nobody reads them before the command runs, or `become` does."""
BY_IMPORTS = {
    "KMP_DUPLICATE_LIB_OK", "LD_LIBRARY_PATH", "OMP_WAIT_POLICY", "PYGAME_HIDE_SUPPORT_PROMPT", "SDL_AUDIODRIVER",
    "SDL_VIDEODRIVER", "TORCHINDUCTOR_CACHE_DIR",
}  # fmt: skip
"""Set by packages, and by `known_environment`, that a test has used in its own process. No test is about them."""

ENVIRONMENT = {name: value for name, value in os.environ.items() if name not in PER_COMMAND}
"""That of the parent: of the process of pytest at its start, before a test changes it."""
PYTHON = sys.executable
ANSWERS_WITHIN_S = 300.0  # importing PyTorch takes seconds, and much longer on a crowded machine

PR_SET_CHILD_SUBREAPER = 36  # of linux/prctl.h

Stream = int | IO[Any] | None
Imports = Literal["learner", "worker"]
"""What a preloaded parent has imported."""


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
    program, environment, namespace = without_words_before(command, env)
    if may_be_forked(program, environment):
        return ForkedProcess(program, (stdin, stdout, stderr), cwd or Path.cwd(), environment, namespace)
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


def start_worker(
    command: Sequence[str],
    *,
    stdin: int,
    stdout: IO[Any] | None,
    stderr: IO[Any] | None,
    start_new_session: Literal[True],
    env: Mapping[str, str],
    pass_fds: Sequence[int],
) -> subprocess.Popen[bytes] | ForkedWorker:
    """Start a worker, as `subprocess.Popen` does for its supervisor: forked if it may be, or executed."""
    if may_be_forked(command, env):
        return ForkedWorker(command, (stdin, stdout, stderr), env, pass_fds)
    return subprocess.Popen(
        command, stdin=stdin, stdout=stdout, stderr=stderr, start_new_session=start_new_session, env=env, pass_fds=pass_fds
    )


def without_words_before(command: Sequence[str], env: Mapping[str, str] | None) -> tuple[list[str], dict[str, str], str]:
    """The command that `env` or `ip netns exec` would execute, its environment, and its network namespace or ""."""
    rest, environment, namespace = list(command), dict(os.environ if env is None else env), ""
    while True:
        match rest:
            case ["env", "-u", name, *after]:
                environment.pop(name, None)
                rest = ["env", *after]
            case ["env", word, *after] if "=" in word:
                name, _, value = word.partition("=")
                environment[name] = value
                rest = ["env", *after]
            case ["env", *after]:
                rest = after
            case ["ip", "netns", "exec", namespace, *after]:
                rest = after
            case _:
                return rest, environment, namespace


def may_be_forked(command: Sequence[str], env: Mapping[str, str] | None = None) -> bool:
    """Whether a command is one of ours, and its environment is the parent's as far as it is read at the start."""
    if os.environ.get("TESTS_EXEC") or "PYTEST_CURRENT_TEST" not in os.environ or not hasattr(os, "pidfd_open"):
        return False  # a benchmark or the soak starts processes as a user does
    forked = [["-m", *each] for each in (*LEARNERS, *WITHOUT_PYTORCH)] + [WORKER]
    if command[0] != PYTHON or not any(list(command[1:][: len(each)]) == each for each in forked):
        return False
    environment = os.environ if env is None else env
    if any(Path(folder, "sitecustomize.py").exists() for folder in environment.get("PYTHONPATH", "").split(os.pathsep)):
        return False  # Python imports it when it starts
    return _read_at_start(environment) == _read_at_start(ENVIRONMENT)


def _read_at_start(environment: Mapping[str, str]) -> dict[str, str]:
    """The part that must be the parent's."""
    return {name: value for name, value in environment.items() if name not in PER_COMMAND | BY_IMPORTS}


class ForkedProcess:
    """A child of the preloaded parent. Its methods are those of `subprocess.Popen`."""

    def __init__(
        self,
        command: Sequence[str],
        streams: tuple[Stream, Stream, Stream],
        folder: Path,
        env: Mapping[str, str],
        namespace: str = "",
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
            argv = list(command[2:])
            request = {"argv": argv, "environment": dict(env), "folder": str(folder), "namespace": namespace}
            light = any(argv[: len(each)] == each for each in WITHOUT_PYTORCH)
            self._parent = _parent("worker" if light else "learner")
            self.pid = self._parent.ask(request, theirs)
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
            self.returncode = os.waitstatus_to_exitcode(self._parent.ask({"reap": self.pid}))
            os.close(self._ended)
        return self.returncode

    def __del__(self) -> None:
        if self.returncode is None and hasattr(self, "_ended"):
            os.close(self._ended)


class ForkedWorker:
    """A worker that was forked for this process, and is its child. Its methods are those of `subprocess.Popen`."""

    def __init__(
        self,
        command: Sequence[str],
        streams: tuple[Stream, Stream, Stream],
        env: Mapping[str, str],
        passed: Sequence[int],
    ) -> None:
        self.args = list(command)
        self.returncode: int | None = None
        given: list[int] = []
        made: list[int] = []
        try:
            for number, stream in enumerate(streams):
                given.append(_stream(number, stream, given, made)[1])
            request = {"argv": self.args[3:], "environment": dict(env), "folder": os.getcwd(), "passed": list(passed)}
            self.pid = _parent("worker").ask(request, [*given, *passed])
        finally:
            for each in made:
                os.close(each)
        _commands[self.pid] = self.args

    def wait(self) -> int:
        """Wait until it has ended, and reap it. Returns the exit code, negative for a signal."""
        if self.returncode is None:
            self.returncode = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self.returncode

    def poll(self) -> int | None:
        """The exit code, negative for a signal, or None while it runs. Reaps it."""
        if self.returncode is None and (found := os.waitpid(self.pid, os.WNOHANG))[0]:
            self.returncode = os.waitstatus_to_exitcode(found[1])
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal, if it has not ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)


_commands: dict[int, list[str]] = {}


def command_line(process: psutil.Process) -> list[str]:
    """The command of a process, also if it is a worker that was forked. Empty if it has ended."""
    with suppress(psutil.NoSuchProcess, psutil.ZombieProcess):
        found: list[str] = process.cmdline()
        return _commands.get(process.pid, found) if str(PROGRAM) in found else found
    return []


def workers_of(supervisor: int) -> list[psutil.Process]:
    """The workers of the process with this id. Each leads a session of its own; a preloaded parent does not."""
    children = psutil.Process(supervisor).children()
    return [child for child in children if _leads_session(child.pid)]


def _leads_session(pid: int) -> bool:
    with suppress(ProcessLookupError):
        return os.getsid(pid) == pid
    return False


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
    """A preloaded parent, and our end of its socket."""

    def __init__(self, imports: Imports, connected: socket.socket | None = None) -> None:
        """`connected`: our end, if the parent runs already and ends with this process."""
        self._imports = imports
        self._lock = threading.Lock()
        self.process: subprocess.Popen[bytes] | None = None
        if connected is not None:
            self._socket = connected
            return
        self._socket, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(ANSWERS_WITHIN_S)
        command = [sys.executable, "-P", str(PROGRAM), str(other.fileno()), imports]
        with other:
            self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, env=ENVIRONMENT, pass_fds=[other.fileno()])

    def ask(self, request: dict[str, Any], descriptors: Sequence[int] = ()) -> int:
        """What it answers: the id of a new child, or the wait status of one that has ended."""
        with self._lock:
            _adopt_orphans("passed" in request)
            try:
                socket.send_fds(self._socket, [json.dumps(request).encode()], list(descriptors))
                answer = self._socket.recv(64)
                assert answer, "the preloaded parent has ended"
            except BaseException:  # a deadline of the test, say: nobody may take the late answer for one to something else
                del _started[self._imports]
                self.close()
                raise
            finally:
                _adopt_orphans(False)
        return int(answer)

    def close(self) -> None:
        """End it, and wait for its end."""
        self._socket.close()
        if self.process is not None:
            self.process.kill()  # it has nothing to finish
            self.process.wait()


_started: dict[Imports, _Parent] = {}
_starting = threading.Lock()  # two threads of a test may start processes


def _adopt_orphans(adopts: bool) -> None:
    """Make this process the parent of orphans among its descendants, or of no orphans."""
    assert ctypes.CDLL(None, use_errno=True).prctl(PR_SET_CHILD_SUBREAPER, int(adopts), 0, 0, 0) == 0, ctypes.get_errno()


def _parent(imports: Imports) -> _Parent:
    """The parent with these imports. That of workers starts with that of learners: a learner gives workers little time."""
    with _starting:
        for each in (imports, *(("worker",) if imports == "learner" else ())):
            if each not in _started:
                _started[each] = _Parent(each)
        return _started[imports]


def use_parent(connected: socket.socket) -> None:
    """Let the preloaded parent at the other end fork the workers of this process."""
    _started["worker"] = _Parent("worker", connected)


def parent_pids() -> set[int]:
    """The process ids of the preloaded parents that were started. They are not left behind by a test."""
    return {parent.process.pid for parent in _started.values() if parent.process is not None}


def close_parents() -> None:
    """End the preloaded parents that were started."""
    while _started:
        _started.popitem()[1].close()
