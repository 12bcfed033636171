"""The lease behind a run's lock, and the content of the lock file. The lease lapses unless the owner renews it. Pure.

Rule: a living owner rewrites the lock file every few seconds, with a new count. An observer doesn't compare the clocks of
two machines; it measures with its own clock how long the content stays the same.
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

WIDTH = 1024  # size of the lock file in bytes, which is fixed so that each rewrite replaces the whole content
HIGHEST_COUNT = 10**12


class Unreachable(Enum):
    """Why `millrace status` can't ask a run's learner."""

    INPROC = "inproc"
    """Its workers are threads, so it listens in its own process only."""
    KEYS_OF_THE_RUN = "keys"
    """Its keys were made for this run only, and are not in any file."""


class Listens(NamedTuple):
    """Where the learner of a run listens for `millrace status`."""

    address: str
    """Its address for other machines."""
    here: str
    """Its address for processes on its own machine."""
    keys: str = ""
    """Its key folder; empty if no key is needed."""


class Owner(msgspec.Struct, frozen=True, kw_only=True):
    """The owner of a lock: the content of the lock file."""

    host: Line
    pid: Annotated[int, Meta(ge=1, le=2**31 - 1)]
    boot_id: Line
    """The boot id of the kernel on `host`. Processes with the same boot id are on the same machine."""
    token: Line
    """A random string, which no two locks share."""
    network_namespace: Line = ""
    """The network namespace of the process; empty if unknown. A container may have its own."""
    pid_namespace: Line = ""
    """The namespace of `pid`; empty if unknown. A container may have its own."""
    folder: Line = ""
    """The inode number of the run folder; empty if unknown. A renamed folder keeps it, and a copy has another."""
    address: Line = ""
    """The learner's address for other machines; empty if nobody can ask the learner, or if it does not listen yet."""
    here: Line = ""
    """The learner's address for processes on its machine and in its network."""
    keys: Line = ""
    """The learner's key folder; empty if no key is needed."""
    unreachable: Unreachable | None = None
    """Why nobody can ask the learner; None if it can be asked, or if the reason is not known."""
    count: Natural = 0
    """How many times the owner has rewritten the file."""

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}"

    def listening(self, where: Listens | Unreachable) -> Owner:
        """The owner with the addresses of its learner, or without them if they are too long for the file."""
        if isinstance(where, Unreachable):
            return replace(self, address="", here="", keys="", unreachable=where)
        found = replace(self, address=where.address, here=where.here, keys=where.keys, unreachable=None)
        fits = len(replace(found, count=HIGHEST_COUNT).encoded()) == WIDTH  # content that is too long isn't cut
        return found if fits else replace(self, address="", here="", keys="", unreachable=None)

    def encoded(self) -> bytes:
        """The content of the lock file."""
        return msgspec.json.encode(self).ljust(WIDTH - 1) + b"\n"


def decoded(content: bytes) -> Owner | None:
    """The owner that this content describes; None if the content is cut off, or is being written at this moment.

    Its addresses are kept only if they are valid, because commands connect to them, and pages show them for people to type.
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
    """What an observer knows about the owner so far."""

    UNKNOWN = "the content has not changed yet"
    ALIVE = "the content has changed"
    DEAD = "the content has stayed the same for too long"


class LeaseWatch:
    """Watches one lock file to decide whether its owner is alive. The owner is alive if the content changes."""

    def __init__(self, content: bytes, now: float, dead_after_s: float) -> None:
        self._content = content
        self._since_s = now
        self._dead_after_s = dead_after_s

    def judge(self, content: bytes, now: float) -> Verdict:
        """The verdict after reading this content. `now` is in seconds by the observer's monotonic clock."""
        if content != self._content:
            return Verdict.ALIVE
        return Verdict.DEAD if now - self._since_s >= self._dead_after_s else Verdict.UNKNOWN
