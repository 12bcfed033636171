"""Records that a benchmark keeps in the repository: a JSON file with one record a line, in the order of their keys."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol, TypeVar

import msgspec


class Keyed(Protocol):
    """A record that takes the place of an older one with the same key."""

    @property
    def key(self) -> tuple[Any, ...]:
        """What a newer record has in common with the one whose place it takes."""
        ...


RecordT = TypeVar("RecordT", bound=Keyed)


def read(path: Path, kind: type[RecordT]) -> list[RecordT]:
    """The records that are kept."""
    return msgspec.json.decode(path.read_bytes(), type=list[kind])  # type: ignore[valid-type]


def write(path: Path, records: Iterable[Keyed]) -> None:
    """Keep these records, one a line."""
    ordered = sorted(records, key=lambda record: record.key)
    path.write_bytes(b"[\n" + b",\n".join(map(msgspec.json.encode, ordered)) + b"\n]\n")


def merged(old: Iterable[RecordT], new: Iterable[RecordT]) -> list[RecordT]:
    """The new records, and the old ones with other keys."""
    return list({record.key: record for record in (*old, *new)}.values())
