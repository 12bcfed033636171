"""How many files and connections this process may have open at the same time.

Rule: a learner that other machines can reach raises its own limit, because anybody who can reach its port can open
connections, and without file descriptors it couldn't write a checkpoint. The usual limit of 1,024 exists only for programs
that call `select`.
"""

from __future__ import annotations

import resource
from contextlib import suppress

MOST = 1 << 16  # some programs close every file that they may have open, which takes minutes if there is no limit


def raise_limit() -> None:
    """Raise the limit as far as the system allows, up to `MOST`."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST if hard == resource.RLIM_INFINITY else min(hard, MOST)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(OSError, ValueError):  # macOS refuses a limit above one of its own
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
