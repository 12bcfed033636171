"""The time for which a thread could go on and had no core, as Linux counts it."""

from __future__ import annotations

import os


class CoreDelay:
    """Reads it for the thread that makes this object, and that alone may use it."""

    def __init__(self) -> None:
        try:
            self._file: int | None = os.open("/proc/thread-self/schedstat", os.O_RDONLY)
        except OSError:  # this system does not count it
            self._file = None

    def seconds(self) -> float:
        """Seconds so far; 0 where the system does not say."""
        return 0.0 if self._file is None else int(os.pread(self._file, 100, 0).split()[1]) / 1e9

    def close(self) -> None:
        """Close the descriptor. Then it has no seconds."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
