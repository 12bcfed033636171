"""Ends a process whose environment hangs, even one that hangs in C and never gives the interpreter back.

The law: whoever is fed lives. Left unfed for `timeout_s`, the process says on stderr where each of its threads is, and ends
with exit code 1, at once; its host then starts another. The clock that judges is a C thread of Python's faulthandler: it
needs neither the interpreter's lock nor anybody's goodwill. Arming it costs some 50 µs, so it is fed now and then only.
"""

from __future__ import annotations

import faulthandler
import re

SAYS = "Timeout ("  # how faulthandler begins


class Watchdog:
    """One for each process, as faulthandler has only one clock."""

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._often_s = min(1.0, timeout_s / 4)
        self._due_s = -self._often_s

    def feed(self, now: float) -> None:
        """Something happened: an env step was over, a message was read, or there was nothing to do."""
        if now >= self._due_s:
            self._due_s = now + self._often_s
            faulthandler.dump_traceback_later(self._timeout_s + self._often_s, exit=True)

    def stop(self) -> None:
        """Watch no more."""
        faulthandler.cancel_dump_traceback_later()


def where_it_hung(log: str) -> str | None:
    """Of what a process said last on stderr: in which line it was when the watchdog ended it; None if that was not so."""
    _, found, after = log.rpartition(SAYS)
    if not found:
        return None
    # The newest call comes first; the thread that is named last is the main one.
    stacks = re.split(r"^(?:Current )?[Tt]hread .*$", after, flags=re.MULTILINE)
    frame = re.search(r'File "(.*)", line (\d+) in (\S+)', stacks[-1])
    return f"{frame[1]}:{frame[2]}, in {frame[3]}" if frame else "an unknown place"
