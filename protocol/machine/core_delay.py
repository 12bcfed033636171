"""The time for which a thread was ready to run but had to wait for a core, as Linux counts it."""

from __future__ import annotations

import os


class CoreDelay:
    """Reads the delay of the thread that creates this object. No other thread may use it."""

    def __init__(self) -> None:
        try:
            self._file: int | None = os.open("/proc/thread-self/schedstat", os.O_RDONLY)
        except OSError:  # this system does not count the delay
            self._file = None

    def seconds(self) -> float:
        """Seconds for which the thread has waited for a core so far; 0 if the system does not count them."""
        return 0.0 if self._file is None else int(os.pread(self._file, 100, 0).split()[1]) / 1e9

    def close(self) -> None:
        """Close the file. After that, `seconds` returns 0."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
