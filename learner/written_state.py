"""Writes a state with torch.save, unless it couldn't be read back. Says which part of it is wrong.

Rule: whatever is written can be read. Therefore, the checks that a stranger's checkpoint must pass are also made for each
file that was just written, before it replaces anything, and for the states of an algorithm that is being checked.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, BinaryIO

from millrace.learner.rehearsed_pickle import Unfit, rehearse
from millrace.protocol.errors import UsageError, first_line

if TYPE_CHECKING:
    from torch import Tensor

PICKLE = "data.pkl"  # suffix of the pickle's name in the archive; torch accepts capital letters, too
CONTENTS = "data"  # name of the folder with the storages' contents in the archive, in small or capital letters, too
MOST_STEPS = 20  # limit on the steps of the path to a part; in a nest that is too deep to be pickled, each part is wrong
MOST_VIEWS = 16  # limit on views of the same numbers; an algorithm may save parts of a tensor in addition to the whole


def write_state(file: BinaryIO, record: object, state: object, where: str) -> None:
    """Write a record, which contains the state, into an empty file that can also be read.

    Raises `UsageError` if the state contains something that couldn't be read back. The error names the first such part,
    as a path that begins with `where`. Raises `OSError` if the file system refuses the file.
    """
    if not (why := _why_unreadable(file, record)):
        return
    part = state
    tried = set[int]()
    for _ in range(MOST_STEPS):
        for step, inner in _parts(part):
            if id(inner) not in tried:
                tried.add(id(inner))
                if why_inner := _why_unreadable(file, inner):
                    where, part, why = f"{where}{step}", inner, why_inner
                    break
        else:
            break
    kind = type(part)
    raise UsageError(f"{where} ({kind.__module__}.{kind.__qualname__}): {why}; fix state_dict")


def check_pickles(archive: zipfile.ZipFile) -> None:
    """Raise `Unfit` if the pickle of an archive contains something that isn't allowed."""
    storage_bytes: dict[str, int] = {}
    for entry in archive.infolist():
        if not entry.filename.isascii():  # Python and torch would decode it differently
            raise Unfit("expected names of ASCII characters in the archive")
        folder, _, key = entry.filename.lower().partition("/")[2].partition("/")
        if folder == CONTENTS and storage_bytes.setdefault(key, entry.file_size) != entry.file_size:
            raise Unfit("expected one content of each storage, got two for a storage")
    for entry in archive.infolist():
        if entry.filename.lower().endswith(PICKLE):
            rehearse(archive.read(entry), storage_bytes)


def check_memory(record: object, size: int) -> None:
    """Raise `Unfit` if the tensors are larger than a file of `size` bytes can hold."""
    tensors = list(_tensors(record))
    if any(each.device.type == "meta" or not _is_whole(each) for each in tensors):
        raise Unfit("expected tensors whose elements are all in the file, got one that is expanded: clone() it")
    if sum(each.nbytes for each in tensors) > MOST_VIEWS * size:
        raise Unfit("its tensors are larger than the file")


def _why_unreadable(file: BinaryIO, record: object) -> str:
    """Write a record. Returns why it couldn't be read back, or an empty string if it could."""
    import torch

    file.seek(0)
    file.truncate()
    try:
        torch.save(record, file)
        with zipfile.ZipFile(file) as archive:
            check_pickles(archive)
        check_memory(record, file.seek(0, 2))
    except (OSError, MemoryError):  # not the state's fault
        raise
    except Unfit as unfit:
        return str(unfit)
    except Exception as error:  # objects of any class raise anything when they are pickled
        refused = error.__context__  # torch raises its own RuntimeError while it handles the file's error
        if isinstance(error, RuntimeError) and isinstance(refused, OSError):
            raise refused from error
        return f"expected tensors and plain data, got {type(error).__name__}: {first_line(error)}"
    return ""


def _parts(value: object) -> Iterator[tuple[str, Any]]:
    """The items of a container, each after its index in brackets."""
    match value:
        case dict():
            yield from ((f"[{key!r:.100}]", inner) for key, inner in value.items())
        case list() | tuple():
            yield from ((f"[{index}]", inner) for index, inner in enumerate(value))


def _tensors(record: object) -> Iterator[Tensor]:
    """Yield each tensor once. Lists in a stranger's file may contain themselves, or one entry many times."""
    import torch

    seen: set[int] = set()
    left = [record]
    while left:
        each = left.pop()
        if id(each) in seen:
            continue
        seen.add(id(each))
        match each:
            case torch.Tensor():
                yield each
            case dict():
                left += [*each.keys(), *each.values(), getattr(each, "__dict__", None)]
            case list() | tuple() | set():
                left += each


def _is_whole(tensor: Tensor) -> bool:
    """Whether each element of a tensor has memory of its own."""
    import torch

    return tensor.layout == torch.strided and tensor.nbytes <= tensor.untyped_storage().nbytes()
