"""Keeps freed memory in the process, for networks that need the same megabytes in every pass.

Without it, glibc returns the end of its heap to the system after each pass, and the system hands it out again page by page,
each page zeroed. That costs a third of the time in which a network acts on batches of 64 images.
"""

from __future__ import annotations

import ctypes

KEEP = 256 << 20  # bytes at the heap's end that are not given back
LARGEST = 32 << 20  # bytes of an allocation that comes from the heap at all: the most that glibc takes
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h


def keep_freed_memory() -> bool:
    """Set this for the whole process, from now on. False if the C library cannot (only glibc can)."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another library, another system
        return False
    return bool(mallopt(_M_TRIM_THRESHOLD, KEEP) and mallopt(_M_MMAP_THRESHOLD, LARGEST))
