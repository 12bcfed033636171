"""Memory that is freed stays with the process, for networks that need the same megabytes again and again.

Without it the C library gives what lies at its heap's end back to the system after each pass, and the system hands it out
again page by page, each one zeroed: a third of the time in which a network acts on batches of 64 images.
"""

from __future__ import annotations

import ctypes

KEEP = 256 << 20  # bytes at the heap's end that are not given back
LARGEST = 32 << 20  # bytes of an allocation that comes from the heap at all: the most that glibc takes
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h


def keep_freed_memory() -> bool:
    """Of the whole process, from now on; whether the C library is one that can (glibc)."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another library, another system
        return False
    return bool(mallopt(_M_TRIM_THRESHOLD, KEEP) and mallopt(_M_MMAP_THRESHOLD, LARGEST))
