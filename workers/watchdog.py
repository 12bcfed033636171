"""The last resort against a hang: a process ends itself if its supervisor, which normally ends hung workers, does not.

Rule: if `feed` has not been called for longer than the run allows, the process writes the stack of each of its threads to
stderr and exits immediately with exit code 1. Its supervisor ends it before that (`end_if_hung` in
`supervise/worker_process.py`), unless the supervisor is dead or the worker hangs in millrace's own code. The timer is a C
thread of Python's faulthandler, which works even while C code holds the interpreter lock. Setting it takes about 50 µs, so
`feed` does so only now and then.
"""

from __future__ import annotations

import faulthandler
import math
import re
import sysconfig
from collections.abc import Callable
from pathlib import Path

FAULTHANDLER_HEADER = "Timeout ("  # the beginning of faulthandler's output
LONGEST_S = 1e9  # used instead of infinity, which faulthandler doesn't accept
STDERR = 2  # not `sys.stderr`, which an environment may have replaced by an object without a file descriptor
OURS = f"{Path(__file__).parents[1]}/"
LIBRARIES = ("<", f"{sysconfig.get_path('stdlib')}/", OURS)  # path prefixes of code that isn't the user's
INSTALLED = "-packages/"  # part of the paths of site-packages, and of Debian's dist-packages


class Watchdog:
    """A watchdog timer. A process can have only one, because faulthandler has only one timer."""

    def __init__(self, timeout_s: Callable[[], float]) -> None:
        """`timeout_s` returns how many seconds the run allows before the process is ended; infinity means never."""
        self._timeout_s = timeout_s
        self._set_to_s = math.inf
        self._due_s = -math.inf

    def feed(self, now: float) -> None:
        """Restart the timer. Call this regularly as long as the worker makes progress or has nothing to do."""
        timeout_s = self._timeout_s()
        if now < self._due_s and timeout_s == self._set_to_s:
            return
        interval_s = min(1.0, timeout_s / 4)
        self._set_to_s = timeout_s
        self._due_s = now + interval_s
        if timeout_s == math.inf:
            self.stop()
        else:
            faulthandler.dump_traceback_later(min(timeout_s, LONGEST_S) + interval_s, exit=True, file=STDERR)

    def stop(self) -> None:
        """Stop the timer."""
        faulthandler.cancel_dump_traceback_later()


def where_it_hung(log: str) -> str | None:
    """The line of code in which the watchdog ended a process, found in its output; None if the watchdog did not end it."""
    _, found, after = log.rpartition(FAULTHANDLER_HEADER)
    if not found:
        return None
    return deepest_frame(after) or "an unknown place"


def deepest_frame(stacks: str) -> str:
    """Where the main thread is, found in the stacks that faulthandler wrote; empty if it wrote none.

    That is the newest call in the user's own code, even if it is waiting for a library; if there is none, the newest call.
    """
    # In each stack, the newest call comes first. The last stack is that of the main thread.
    each = re.split(r"^(?:Current )?[Tt]hread .*$", stacks, flags=re.MULTILINE)
    frames = re.findall(r'File "(.*)", line (\d+) in (\S+)', each[-1])
    of_user = [each for each in frames if not _is_of_library(each[0])]
    for file, line, function in of_user or frames:
        return f"{file}:{line}, in {function}"
    return ""


def _is_of_library(file: str) -> bool:
    return file.startswith(LIBRARIES) or INSTALLED in file
