"""Checks a client: opens the learner's port, starts the client's process, and passes its messages to the examiner.

Rule: this file decides nothing about the conversation; the examiner does (`examiner.py`). It only sends and receives
messages, and starts and ends processes, always with a deadline. No process that it starts outlives the test.
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import zmq

from millrace.extras.conformance.examiner import Check, CheckResult, Examiner
from millrace.extras.conformance.learner import Settings
from millrace.extras.conformance.script import (
    AskToStop,
    CutConnection,
    EndClient,
    Ended,
    Heard,
    LearnerEffect,
    Listen,
    SendFrames,
    StartClient,
)
from millrace.learner.members.bound import bind
from millrace.protocol.bounds import escaped
from millrace.protocol.errors import UsageError
from millrace.protocol.keys.key_folder import KeyFolder, Keyring
from millrace.protocol.keys.keys import Token
from millrace.protocol.keys.worker_token import TOKEN_VARIABLE
from millrace.protocol.wire.learner_link import LearnerLink

ADDRESS_VARIABLE = "MILLRACE_ADDRESS"
ADDRESS_WORD = "{address}"
TOKEN_WORD = "{token}"
POLL_S = 0.05
STOP_CLIENT_WITHIN_S = 4.0  # time from SIGTERM until the client is killed
LISTEN_WITHIN_S = 3.0  # a closed socket's port may stay in use for a moment
KEPT_LINES = 40  # number of lines of the client's output to keep
MOST_PACKED_BYTES = 1 << 26  # largest size of one message


@dataclass(frozen=True)
class ClientCommand:
    """The command that starts the client."""

    command: tuple[str, ...]
    """the words of the command, in which `{address}` and `{token}` are replaced"""
    with_keys: bool = False
    """whether the connection is encrypted; if so, the client needs a token"""


def conform(
    client: ClientCommand, checks: Sequence[Check], settings: Settings, limit_s: float, watch: Callable[[CheckResult], None]
) -> list[CheckResult]:
    """Run the checks. `watch` is called with each result. Raises `UsageError` if the command cannot be started."""
    with ExitStack() as resources:
        port = resources.enter_context(_Port(client.with_keys or any(TOKEN_WORD in word for word in client.command)))
        process = resources.enter_context(_Process(client.command, port.address, port.token))
        token = None if port.token is None else Token.from_text(port.token.read_text().strip(), "the client's token")
        examiner = Examiner(checks, replace(settings, token=token), time.monotonic(), limit_s)
        told = 0

        def perform(effects: list[LearnerEffect]) -> None:
            for effect in effects:
                match effect:
                    case SendFrames(peer, frames):
                        port.send(peer, frames)
                    case StartClient():
                        process.start()
                    case AskToStop():
                        process.ask_to_stop()
                    case EndClient():
                        process.end()
                        port.discard()
                    case CutConnection():
                        port.cut()
                    case Listen():
                        port.listen()

        while not examiner.done:
            perform(examiner.tick(time.monotonic()))
            for event in port.heard(min(POLL_S, examiner.next_due_s() - time.monotonic())):
                perform(examiner.handle(event, time.monotonic()))
            if (ended := process.ended()) is not None:
                for event in port.heard(POLL_S):  # the ended process's last messages
                    perform(examiner.handle(event, time.monotonic()))
                perform(examiner.handle(ended, time.monotonic()))
            for result in examiner.results[told:]:
                watch(result)
            told = len(examiner.results)
        return examiner.results


class _Port:
    """The learner's socket, which can be closed and opened again at the same address."""

    def __init__(self, with_keys: bool) -> None:
        self._resources = ExitStack()
        self._socket = ExitStack()
        self.token: Path | None = None
        self._keyring: Keyring | None = None
        if with_keys:
            folder = KeyFolder(Path(self._resources.enter_context(tempfile.TemporaryDirectory(prefix="millrace-conform-"))))
            now = datetime.now(UTC).replace(microsecond=0)
            self.token = folder.new("client", now)
            self._keyring = Keyring(folder.server(), folder.allowed())
        self.address = "tcp://127.0.0.1:*"
        self._link: LearnerLink | None = None
        self.listen()

    def __enter__(self) -> _Port:
        return self

    def __exit__(self, *error: object) -> None:
        self.cut()
        self._resources.close()

    def listen(self) -> None:
        """Open the socket."""
        until_s = time.monotonic() + LISTEN_WITHIN_S
        while self._link is None:
            try:
                self._link = bind(self.address, self._keyring, self._socket, linger_s=0.0).link
            except UsageError:
                if time.monotonic() > until_s:
                    raise
                time.sleep(POLL_S)
        self._link.packed_bytes_limit = MOST_PACKED_BYTES
        self.address = self._link.address

    def cut(self) -> None:
        """Close the socket with all its connections."""
        self._socket.close()
        self._link = None

    def send(self, peer: bytes, frames: Sequence[bytes | memoryview]) -> None:
        """Send these frames, unless the peer isn't connected."""
        if self._link is not None:
            with suppress(zmq.ZMQError):
                self._link.send(peer, frames)

    def heard(self, timeout_s: float) -> list[Heard]:
        """The messages that have arrived. Waits at most `timeout_s` for the first one."""
        if self._link is None:
            time.sleep(max(0.0, timeout_s))
            return []
        if not self._link.poll(max(0.0, timeout_s)):
            return []
        return [Heard(peer, message) for peer, message in self._link.receive()]

    def discard(self) -> None:
        """Discard the messages that have arrived, because the process that sent them was ended."""
        self.heard(0.0)


class _Process:
    """The client's process. It has its own session, so that all processes that it starts can be ended with it."""

    def __init__(self, command: Sequence[str], address: str, token: Path | None) -> None:
        words = {ADDRESS_WORD: address, TOKEN_WORD: "" if token is None else str(token)}
        self._command = [_replaced(word, words) for word in command]
        self._environment = {**os.environ, ADDRESS_VARIABLE: address}
        self._environment.pop(TOKEN_VARIABLE, None)
        if token is not None:
            self._environment[TOKEN_VARIABLE] = str(token)
        self._running: subprocess.Popen[bytes] | None = None
        self._lines: deque[str] = deque(maxlen=KEPT_LINES)
        self._reader: threading.Thread | None = None

    def __enter__(self) -> _Process:
        return self

    def __exit__(self, *error: object) -> None:
        self.end()

    def start(self) -> None:
        """Start the client. Raises `UsageError` if there is no such command."""
        self._lines.clear()
        try:
            self._running = subprocess.Popen(
                self._command,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        except OSError as error:
            raise UsageError(
                f"conform: {self._command[0]}: {error.strerror}; expected a command that starts the client after --"
            ) from error
        self._reader = threading.Thread(target=self._read, args=(self._running,), daemon=True)
        self._reader.start()

    def _read(self, running: subprocess.Popen[bytes]) -> None:
        assert running.stdout is not None
        with suppress(ValueError, OSError):
            for line in running.stdout:
                if text := escaped(line.decode(errors="replace")).strip():
                    self._lines.append(text[:300])

    def ask_to_stop(self) -> None:
        """Send SIGTERM."""
        if self._running is not None:
            os.kill(self._running.pid, signal.SIGTERM)  # `send_signal` would reap the process if it has just ended

    def ended(self) -> Ended | None:
        """How the client ended; None while it runs, and before it was started."""
        if self._running is None or not self._has_ended():
            return None
        code = self._close()
        return Ended(code, self._lines[-1] if self._lines else "")

    def end(self) -> None:
        """End the client and all processes that it started: SIGTERM, then SIGKILL."""
        if self._running is None:
            return
        self.ask_to_stop()
        until_s = time.monotonic() + STOP_CLIENT_WITHIN_S
        while not self._has_ended() and time.monotonic() < until_s:
            time.sleep(POLL_S)
        self._close()

    def _has_ended(self) -> bool:
        """Whether the client has ended. It stays a zombie, so that its id isn't reused before its group is killed."""
        assert self._running is not None
        return os.waitid(os.P_PID, self._running.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    def _close(self) -> int:
        """Kill what is left of the client's process group, so that its output pipe is closed. Returns the exit code."""
        assert self._running is not None
        assert self._reader is not None
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._running.pid, signal.SIGKILL)
        code = self._running.wait(STOP_CLIENT_WITHIN_S)
        self._reader.join(STOP_CLIENT_WITHIN_S)
        assert self._running.stdout is not None
        if not self._reader.is_alive():
            self._running.stdout.close()
        self._running = self._reader = None
        return code


def _replaced(word: str, words: dict[str, str]) -> str:
    for placeholder, value in words.items():
        word = word.replace(placeholder, value)
    return word
