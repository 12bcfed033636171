"""Warns, once, if updates spend their time waiting for CPU cores.

PyTorch's threads wait for one another at the end of each operation. If other processes keep the cores busy, an update with
several threads may take many times as long as with one thread, and nothing else shows why.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager

log = logging.getLogger("millrace.learner")

LONG_S = 10.0
SHARE = 0.5  # an update counts as waiting if its CPU time is at most this share of its duration


class CrowdedCores:
    """Watches the updates of one run."""

    def __init__(self, threads: int) -> None:
        """`threads` is the number of PyTorch's threads if they compute the updates; 0 if a GPU does."""
        self._threads = threads
        self._said = False

    @contextmanager
    def watching(self) -> Iterator[None]:
        """A context in which to make an update. Warns at the end if the update waited for cores."""
        began_s = time.monotonic()
        cpu_began_s = time.process_time()
        yield
        if line := self.updated(time.monotonic() - began_s, time.process_time() - cpu_began_s):
            log.warning("%s", line)

    def updated(self, took_s: float, computed_s: float) -> str:
        """Check an update that took `took_s` seconds, in which all threads together used `computed_s` seconds of CPU time.

        Returns a line for the log; empty if there is nothing to warn about.
        """
        if self._said or self._threads < 2 or took_s < LONG_S or computed_s > SHARE * took_s:
            return ""
        self._said = True
        return (
            f"an update took {took_s:.0f} s and computed for {computed_s:.0f} s of them: PyTorch's {self._threads} threads "
            "wait for cores that other processes keep busy, or for one another; compare --torch-threads 1"
        )
