"""Keeps freed memory in the process, for networks that need the same megabytes in every pass.

By default, glibc returns the end of its heap to the system after each pass. In the next pass, the system provides the memory
again page by page, and fills each page with zeros. This takes up a third of the time of a forward pass on a batch of 64
images.
"""

from __future__ import annotations

import ctypes

KEEP = 256 << 20  # up to this many free bytes at the end of the heap are not returned to the system
LARGEST = 32 << 20  # allocations of up to this many bytes are made in the heap; glibc accepts no larger value
# The numbers that malloc.h gives to these parameters of mallopt.
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3


def keep_freed_memory() -> bool:
    """From now on, keep freed memory in this process. Returns False if the C library cannot do this (only glibc can)."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # not glibc, or not Linux
        return False
    return bool(mallopt(_M_TRIM_THRESHOLD, KEEP) and mallopt(_M_MMAP_THRESHOLD, LARGEST))
