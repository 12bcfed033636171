"""Records that a benchmark keeps in the repository: a JSON file with one record on each line, sorted by key."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol, TypeVar

import msgspec


class Keyed(Protocol):
    """A record that replaces an older one with the same key."""

    @property
    def key(self) -> tuple[Any, ...]:
        """The fields that identify the record: a newer record with the same key replaces it."""
        ...


RecordT = TypeVar("RecordT", bound=Keyed)


def read(path: Path, kind: type[RecordT]) -> list[RecordT]:
    """Read the records in this file."""
    return msgspec.json.decode(path.read_bytes(), type=list[kind])  # type: ignore[valid-type]


def write(path: Path, records: Iterable[Keyed]) -> None:
    """Write these records, one on each line."""
    ordered = sorted(records, key=lambda record: record.key)
    path.write_bytes(b"[\n" + b",\n".join(map(msgspec.json.encode, ordered)) + b"\n]\n")


def merged(old: Iterable[RecordT], new: Iterable[RecordT]) -> list[RecordT]:
    """The new records, and the old records whose keys no new record has."""
    return list({record.key: record for record in (*old, *new)}.values())
