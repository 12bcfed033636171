"""Keeps freed memory in the process, for networks that need the same megabytes in every pass.

By default, glibc returns the end of its heap to the system after each pass. In the next pass, the system gives the memory
back page by page and fills each page with zeros. This takes a third of the time in which a network acts on batches of 64
images.
"""

from __future__ import annotations

import ctypes

KEEP = 256 << 20  # bytes at the heap's end that are not given back
LARGEST = 32 << 20  # bytes of an allocation that comes from the heap at all: the most that glibc takes
# The numbers that malloc.h gives these parameters.
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3


def keep_freed_memory() -> bool:
    """Keep freed memory in the whole process from now on. Returns False if the C library cannot do this (only glibc can)."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another library, another system
        return False
    return bool(mallopt(_M_TRIM_THRESHOLD, KEEP) and mallopt(_M_MMAP_THRESHOLD, LARGEST))
