"""Signals at any time end the command with exit code 130 and without a traceback, and end what it has started."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any

import pytest

from benchmarks.program import _run
from millrace.learner.interrupts import Interrupts, Stopped, stopped_by_signals
from millrace.learner.members.bound import bind
from millrace.protocol.machine.deferred_signals import SIGNALS, signals_deferred
from millrace.protocol.wire.socket_options import set_options

INTERRUPTED = """
import os, signal, sys, types
from millrace.__main__ import command

def main():
    try:
        os.kill(os.getpid(), signal.{signal})
    finally:
        for _ in range(30):
            os.kill(os.getpid(), signal.SIGINT)
        sys.stderr.write("cleaned up\\n")

sys.modules["millrace.cli.main"] = types.SimpleNamespace(main=main)
command()
"""


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    before = {each: signal.getsignal(each) for each in SIGNALS}
    yield
    for each, handler in before.items():
        signal.signal(each, handler)


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_where_nothing_is_to_be_saved_ends_the_command_as_later(number: signal.Signals) -> None:
    """So do thirty Ctrl-C during its clean-up."""
    command = [sys.executable, "-c", INTERRUPTED.format(signal=number.name)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (130, "cleaned up\nmillrace: interrupted\n")


def test_only_the_first_signal_raises_and_at_the_end_they_are_ignored() -> None:
    with pytest.raises(Stopped), stopped_by_signals():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            os.kill(os.getpid(), signal.SIGINT)
    assert [signal.getsignal(each) for each in SIGNALS] == [signal.SIG_IGN] * 3


def test_a_deferred_signal_interrupts_after_the_block() -> None:
    done = []
    with pytest.raises(Stopped), stopped_by_signals():
        with signals_deferred():
            os.kill(os.getpid(), signal.SIGTERM)
            done.append("block")
        done.append("after it")
    assert done == ["block"]


BOTH_CONTEXTS = pytest.mark.parametrize("context", [signals_deferred, Interrupts])


@BOTH_CONTEXTS
def test_a_handler_that_is_not_pythons_stays(
    context: Callable[[], AbstractContextManager[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program that embeds Python, or a preloaded library, has set it. Python can't put it back."""
    known = signal.getsignal
    heard: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    before = [known(each) for each in SIGNALS]
    monkeypatch.setattr(signal, "getsignal", lambda number: None if number == signal.SIGTERM else known(number))
    with context():
        os.kill(os.getpid(), signal.SIGTERM)
        assert heard == [signal.SIGTERM]
        assert known(signal.SIGINT) != before[0]
    assert [known(each) for each in SIGNALS] == before


@BOTH_CONTEXTS
def test_a_signal_that_interrupts_the_end_of_the_block_swallows_no_later_one(
    context: Callable[[], AbstractContextManager[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C raises as soon as its handler is back, before those of the others are."""
    heard: list[int] = []
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for each in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(each, lambda number, frame: heard.append(number))
    set_handler = signal.signal

    def interrupted(number: int, handler: Any) -> Any:
        found = set_handler(number, handler)
        if handler is signal.default_int_handler:
            os.kill(os.getpid(), signal.SIGINT)
        return found

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(signal, "signal", interrupted)
        with context():
            pass
    for each in (signal.SIGTERM, signal.SIGHUP, signal.SIGTERM):
        os.kill(os.getpid(), each)
    assert heard == [signal.SIGTERM, signal.SIGHUP, signal.SIGTERM]


def test_a_deferred_signal_arrives_although_another_interrupts_the_end_of_the_block(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    heard: list[int] = []
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))
    set_handler = signal.signal

    def interrupted(number: int, handler: Any) -> Any:
        if handler is signal.default_int_handler:
            raise KeyboardInterrupt
        return set_handler(number, handler)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(signal, "signal", interrupted)
        with signals_deferred():
            os.kill(os.getpid(), signal.SIGTERM)
    assert heard == [signal.SIGTERM]


def test_a_signal_while_the_address_is_bound_leaves_no_socket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise, the end of its context would wait for ever."""

    def interrupted(*arguments: Any) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        set_options(*arguments)

    monkeypatch.setattr("millrace.protocol.wire.learner_link.set_options", interrupted)
    with pytest.raises(Stopped), stopped_by_signals(), ExitStack() as resources:
        bind(f"ipc://{tmp_path}/learner", None, resources)


def test_a_run_notices_a_signal_before_it_whose_exception_was_swallowed() -> None:
    with stopped_by_signals():
        with Interrupts() as before:
            pass
        with pytest.raises(Stopped):
            os.kill(os.getpid(), signal.SIGTERM)
        with Interrupts() as after:
            pass
    assert (before.received, after.received) == (False, True)


def test_an_interrupted_benchmark_ends_with_its_processes(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    waits = f"import time; file = open({str(fifo)!r}, 'w'); print('x', file=file, flush=True); time.sleep(600)"
    starts = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {waits!r}])"
    signal.signal(signal.SIGINT, signal.default_int_handler)
    heard = []

    def interrupt() -> None:
        with fifo.open() as file:
            heard.append(file.readline())
            os.kill(os.getpid(), signal.SIGINT)
            heard.append(file.readline())

    listener = threading.Thread(target=interrupt, daemon=True)
    listener.start()
    with pytest.raises(KeyboardInterrupt):
        _run([sys.executable, "-c", starts], dict(os.environ))
    listener.join(10.0)
    assert heard == ["x\n", ""], "a process of the benchmark is left"
