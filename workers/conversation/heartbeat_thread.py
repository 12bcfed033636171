"""Heartbeats from a second thread while the first thread runs the environment's code, where a step may take minutes.

Rule: only one thread at a time uses the link and the session. The first thread holds their lock, and releases it only while
it runs the environment's code; during that time, the second thread acquires it now and then.

This file determines only how often the second thread checks whether a Heartbeat is due. `Session.heartbeat_if_due`
(session.py) determines when one is due. The interval between two Heartbeats is `SessionTerms.heartbeat_s`
(protocol/specs.py).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

CHECK_EVERY_S = 0.25  # how often the second thread checks; a Heartbeat is late by at most this


class HeartbeatThread:
    """The second thread, and the lock between the two threads."""

    def __init__(self, heartbeat: Callable[[], None]) -> None:
        """`heartbeat` sends a Heartbeat if one is due. The second thread calls it after `start`."""
        self._heartbeat = heartbeat
        self._lock = threading.Lock()  # the thread that holds it may use the link and the session
        self._lock.acquire()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def start(self) -> None:
        """Start the second thread, if it has not started yet."""
        if self._thread.ident is None:
            self._thread.start()

    @contextmanager
    def lock_released(self) -> Iterator[None]:
        """A context in which the first thread runs the environment's code, and doesn't use the link or the session."""
        self._lock.release()
        try:
            yield
        finally:
            self._lock.acquire()

    @contextmanager
    def lock_reacquired(self) -> Iterator[None]:
        """A context within `lock_released` in which the first thread may use the link and the session again."""
        self._lock.acquire()
        try:
            yield
        finally:
            self._lock.release()

    def stop(self) -> None:
        """End the second thread. The first thread keeps the lock."""
        self._stopped.set()
        if self._thread.ident is not None:
            with self.lock_released():
                self._thread.join()

    def _run(self) -> None:
        while not self._stopped.wait(CHECK_EVERY_S):
            with self._lock:
                if not self._stopped.is_set():
                    self._heartbeat()
