"""Defers SIGINT, SIGTERM and SIGHUP, for code that an exception between two lines would leave in a state that nothing could
clean up.

Rule: handlers are replaced instead of blocking the signals, because another thread could receive them, and Python would
still run the handler in the main thread. Python never interrupts other threads.

Rule: a handler is replaced only if it can be put back. If a signal arrives when its own handler should be back but isn't,
because an exception has ended the code that puts handlers back, the handler is put back then (`put_back_late`).
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""the signals that end a program"""

Handler = Callable[[int, FrameType | None], object] | int
"""a function, or the number of a default action"""


def heeded() -> list[signal.Signals]:
    """The signals that end this program. A program that was started to ignore SIGHUP (`nohup`) keeps ignoring it."""
    return [each for each in SIGNALS if each != signal.SIGHUP or signal.getsignal(each) != signal.SIG_IGN]


def known_handlers(signals: Iterable[int]) -> dict[int, Handler]:
    """The handlers of these signals that Python can put back.

    It can't put back the handler of a program that embeds Python, or of a library that was loaded before Python.
    """
    found = {number: signal.getsignal(number) for number in signals}
    return {number: handler for number, handler in found.items() if handler is not None}


def put_back_late(number: int, handler: Handler) -> None:
    """Put back the handler of a signal that has arrived, and let it handle the signal."""
    signal.signal(number, handler)
    signal.raise_signal(number)


@contextmanager
def signals_deferred() -> Iterator[None]:
    """Inside this context, which must be short, signals interrupt nothing. One that arrives is delivered at the end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    arrived: list[int] = []
    ended = False
    before = {number: handler for number, handler in known_handlers(SIGNALS).items() if handler != signal.SIG_IGN}

    def defer(number: int, frame: FrameType | None) -> None:
        if ended:
            put_back_late(number, before[number])
        else:
            arrived.append(number)

    try:
        for number in before:
            signal.signal(number, defer)
        yield
    finally:
        ended = True
        try:
            for number, handler in before.items():
                signal.signal(number, handler)  # if this is the handler of SIGINT, Ctrl-C may raise from now on
        finally:
            if arrived:
                signal.raise_signal(arrived[0])
