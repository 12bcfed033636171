"""The lock of a run is a lease: it lapses unless its owner renews it. The file's content, and whether its owner lives. Pure.

Rule: a living owner rewrites the lock file every few seconds with another count. An observer doesn't compare the clocks of
two machines: it measures with its own clock how long the content stays the same.
"""

from __future__ import annotations

from enum import Enum
from typing import Annotated, NamedTuple

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from millrace.protocol.address import check_address
from millrace.protocol.bounds import INVALID, Line, Natural
from millrace.protocol.errors import UsageError

WIDTH = 1024  # bytes: every rewrite has the same length, so that one of them replaces the whole
HIGHEST_COUNT = 10**12


class Unreachable(Enum):
    """Why nobody can ask the learner of a run."""

    INPROC = "inproc"
    """Its workers are threads: it listens in its own process only."""
    KEYS_OF_THE_RUN = "keys"
    """Its keys are made for this run, and are not in any file."""


class Listens(NamedTuple):
    """Where the learner of a run listens for `millrace status`."""

    address: str
    """Its address for other machines."""
    here: str
    """Its address for processes on its own machine."""
    keys: str = ""
    """Its key folder; empty if it needs no key."""


class Owner(msgspec.Struct, frozen=True, kw_only=True):
    """The content of the lock file."""

    host: Line
    pid: Annotated[int, Meta(ge=1, le=2**31 - 1)]
    boot_id: Line
    """Boot id of the kernel there: processes with the same one are on one machine."""
    token: Line
    """Random: no two locks have the same."""
    network_namespace: Line = ""
    """Empty if unknown. A container on the same machine may have its own."""
    pid_namespace: Line = ""
    """The namespace of `pid`; empty if unknown. A container may have its own."""
    address: Line = ""
    """Where its learner listens, for other machines; empty if nobody can ask it, or it does not listen yet."""
    here: Line = ""
    """The same for processes on its machine and in its network."""
    keys: Line = ""
    """The key folder of its learner; empty if it needs no key."""
    unreachable: Unreachable | None = None
    """Why nobody can ask it, if that is known."""
    count: Natural = 0
    """How often the owner has rewritten the file."""

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}"

    def listening(self, where: Listens | Unreachable) -> Owner:
        """The owner with the address where its learner listens; without the address if it is too long for the file."""
        if isinstance(where, Unreachable):
            return replace(self, address="", here="", keys="", unreachable=where)
        found = replace(self, address=where.address, here=where.here, keys=where.keys, unreachable=None)
        fits = len(replace(found, count=HIGHEST_COUNT).encoded()) == WIDTH  # a longer text would not be cut
        return found if fits else replace(self, address="", here="", keys="", unreachable=None)

    def encoded(self) -> bytes:
        """The content of the lock file."""
        return msgspec.json.encode(self).ljust(WIDTH - 1) + b"\n"


def decoded(content: bytes) -> Owner | None:
    """The owner that this content names; None if the content was cut or is being written.

    Its address is kept only if valid: a command connects to it, and a page shows it as a word to type.
    """
    try:
        owner = msgspec.json.decode(content.strip(), type=Owner)
    except INVALID:
        return None
    try:
        for address in filter(None, (owner.address, owner.here)):
            check_address(address)
    except UsageError:
        return replace(owner, address="", here="", keys="")
    return owner


class Verdict(Enum):
    """What an observer knows about the owner."""

    UNKNOWN = "the content has not changed yet"
    ALIVE = "the content has changed"
    DEAD = "the content has stayed the same for too long"


class LeaseWatch:
    """One observer of one lock file, for one decision: once the content has changed, the owner lives."""

    def __init__(self, content: bytes, now: float, dead_after_s: float) -> None:
        self._content = content
        self._since_s = now
        self._dead_after_s = dead_after_s

    def judge(self, content: bytes, now: float) -> Verdict:
        """The verdict after reading this content. `now`: seconds by the observer's monotonic clock."""
        if content != self._content:
            return Verdict.ALIVE
        return Verdict.DEAD if now - self._since_s >= self._dead_after_s else Verdict.UNKNOWN
