"""The address where local workers join: a socket file, a TCP port on loopback, or an address within this process.

Rule: a socket file is in its own folder, which only this user can enter (0700). The folder is removed with it.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from contextlib import ExitStack

from millrace.protocol.errors import UsageError, safe_repr

# Largest length of the temporary folder's path, in bytes. If the path is longer, /tmp is used, because the path of a socket
# file can have at most 107 bytes.
LONGEST_FOLDER = 80


def private_address(transport: str, stack: ExitStack) -> str:
    """An address that no other process uses; `stack` removes its files. Raises `UsageError` for an unknown transport."""
    match transport:
        case "inproc":
            return f"inproc://millrace-{os.getpid()}-{time.monotonic_ns()}"
        case "tcp":
            return "tcp://127.0.0.1:*"
        case "ipc":
            room = len(os.fsencode(tempfile.gettempdir())) <= LONGEST_FOLDER
            # mkdtemp makes the folder with mode 0700, so only this user can connect
            folder = tempfile.mkdtemp(prefix="millrace-", dir=None if room else "/tmp")
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            return f"ipc://{folder}/learner"
        case _:
            raise UsageError(f"transport: expected ipc, tcp or inproc, got {safe_repr(transport)}")
