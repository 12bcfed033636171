"""Checks that every reader of zip archives finds the same files in a checkpoint.

Rule: a checkpoint is checked with Python's `zipfile` and then read by torch, which reads archives with its own code. The zip
format lets two readers find different files in the same archive, because it states the directory's position twice, and an
extra field may override an entry's name. Therefore, an archive must have exactly the directory that torch.save writes: both
positions agree, and an extra field contains only numbers that need more than 32 bits.
"""

from __future__ import annotations

import os
import struct
from typing import BinaryIO

MAX16, MAX32 = (1 << 16) - 1, (1 << 32) - 1  # stands for a number that is stored elsewhere, because it needs more bits
ENTRY = struct.Struct("<4sHHHHHHIIIHHHHHII")
END = struct.Struct("<4sQHHIIQQQQ 4sIQI 4sHHHHIIH")
"""The zip64 end of central directory record, its locator, and the (32-bit) end of central directory record"""
END64_BYTES = 56  # size of the zip64 record
MOST_BYTES = 1 << 26  # limit on the size of a directory


class OddDirectory(Exception):
    """The archive's directory isn't as torch.save writes it."""


def check_directory(file: BinaryIO) -> None:
    """Raise `OddDirectory` unless the archive's directory is as torch.save writes it."""
    start, count, content = _directory(file)
    place = 0
    for _ in range(count):
        if len(content) - place < ENTRY.size:
            raise OddDirectory("its directory is cut off")
        signature, *_, packed, size, name, extra, comment, disk, _, _, offset = ENTRY.unpack_from(content, place)
        large = [number for number in (size, packed, offset) if number == MAX32]
        expected = struct.pack("<HH", 1, 8 * len(large)) if large else b""
        extra_at = place + ENTRY.size + name
        if (signature, comment, disk) != (b"PK\1\2", 0, 0) or extra != len(expected) + 8 * len(large):
            raise OddDirectory("its directory has entries of another form than torch's")
        if content[extra_at : extra_at + len(expected)] != expected:
            raise OddDirectory("its directory has an extra field that torch doesn't write")
        place = extra_at + extra
    if place != len(content):
        raise OddDirectory(f"its directory ends at {start + place:,}, not at {start + len(content):,}")


def _directory(file: BinaryIO) -> tuple[int, int, bytes]:
    """Where the directory begins, the number of its entries, and its content."""
    end = file.seek(0, os.SEEK_END) - END.size
    if end < 0:
        raise OddDirectory("it is cut off")
    file.seek(end)
    found = END.unpack(file.read(END.size))
    version, needed, count, size, start = *found[2:4], *found[7:10]
    expected = (
        *(b"PK\6\6", END64_BYTES - 12, version, needed, 0, 0, count, count, size, start),
        *(b"PK\6\7", 0, end, 1),
        *(b"PK\5\6", 0, 0, min(count, MAX16), min(count, MAX16), min(size, MAX32), min(start, MAX32), 0),
    )
    if found != expected or start + size != end or size > MOST_BYTES:
        raise OddDirectory("its last bytes are not as torch.save writes them")
    file.seek(start)
    return start, count, file.read(size)
