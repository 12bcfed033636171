"""Defers SIGINT, SIGTERM and SIGHUP, for code that an exception between two lines would leave in a state that nothing could
clean up.

Rule: handlers are replaced instead of blocking the signals, because another thread could receive them, and Python would
still run the handler in the main thread. Python never interrupts other threads.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""the signals that end a program"""


@contextmanager
def signals_deferred() -> Iterator[None]:
    """Inside this context, which must be short, signals interrupt nothing. One that arrives is delivered at the end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    arrived: list[int] = []
    before = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        for number, handler in before.items():
            if handler != signal.SIG_IGN:
                signal.signal(number, lambda number, frame: arrived.append(number))
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if arrived:
            signal.raise_signal(arrived[0])
