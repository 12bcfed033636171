"""Signs of life from a second thread while the environment's code has the first: a step may take minutes, and is no silence.

The law: link and session have one user at a time. The first thread has them, but for the time that it is away, in the code
of the environment; then the second has them for a moment, now and then.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

EVERY_S = 0.25  # a Heartbeat that is due is said so much later at most


class Breath:
    """The second thread, and the lock between the two."""

    def __init__(self, breathe: Callable[[], None]) -> None:
        """`breathe` says what is due; it is called by the second thread, after `start`."""
        self._breathe = breathe
        self._ours = threading.Lock()  # whoever has it may use link and session
        self._ours.acquire()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="breath", daemon=True)

    def start(self) -> None:
        """From now on, whenever the first thread is away; harmless when said again."""
        if self._thread.ident is None:
            self._thread.start()

    @contextmanager
    def away(self) -> Iterator[None]:
        """The first thread runs the environment's code."""
        self._ours.release()
        try:
            yield
        finally:
            self._ours.acquire()

    @contextmanager
    def back(self) -> Iterator[None]:
        """It is back for a moment, out of that code."""
        self._ours.acquire()
        try:
            yield
        finally:
            self._ours.release()

    def stop(self) -> None:
        """No more of it; the first thread keeps link and session."""
        self._ended.set()
        if self._thread.ident is not None:
            with self.away():
                self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(EVERY_S):
            with self._ours:
                if not self._ended.is_set():
                    self._breathe()
