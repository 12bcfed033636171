"""The attributes that were set on env copies of a vector environment, for the copies that replace lost ones.

Rule: before new copies are reset or stepped, each attribute that was set on a lost copy is set again, on all the copies on
which it was set together. It is not set again on any other copies, because their environments may have changed it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol

from millrace.protocol.errors import EnvironmentFailed
from millrace.protocol.wire.plain_values import unpack
from millrace.workers.copies.env_errors import CopyFailed

METHODS = ("close", "render", "reset", "step")  # every environment has these methods
SetKey = tuple[int, str]
"""The first copy on which an attribute was set, and its name."""


class CallsCopies(Protocol):
    """A vector environment that calls some of its copies, and replaces copies that are lost."""

    calls: Any

    def incarnations(self) -> Sequence[int]:
        """For each copy, a number that rises when the copy is lost and a new one replaces it."""


class SetAttributes:
    """The attributes that were set, and which of them the replacements of lost copies lack."""

    def __init__(self, env: CallsCopies) -> None:
        self._env = env
        self._values: dict[SetKey, tuple[slice, bytes]] = {}  # the copies, and the packed value
        self._missing: set[SetKey] = set()  # attributes that copies lack
        self._incarnations: Sequence[int] = ()  # of each copy, at the last look for replacements

    def record(self, copies: slice, name: str, packed: bytes) -> None:
        """Record an attribute that these copies lack until `set` is called."""
        if not self._values:
            self._incarnations = self._env.incarnations()
        key = copies.start, name
        self._values[key] = copies, packed
        self._missing.add(key)

    def lacking(self, chosen: Sequence[int]) -> list[SetKey]:
        """The attributes that some of these copies lack, because they were not set yet, or because the copies are new."""
        if not self._values:
            return []
        before = self._incarnations
        self._incarnations = self._env.incarnations()
        new = {n for n, (old, now) in enumerate(zip(before, self._incarnations, strict=True)) if old != now}
        self._missing.update(key for key, (copies, _) in self._values.items() if _overlap(new, copies))
        return [key for key in sorted(self._missing) if _overlap(chosen, self._values[key][0])]

    def set(self, key: SetKey) -> None:
        """Set this attribute on its copies. Raises `CopyFailed` if they don't have it, and `WorkerLost` if one is lost."""
        copies, packed = self._values[key]
        _, name = key
        chosen = range(copies.start, copies.stop)
        try:
            there = self._have(chosen, name)
            if not there or name in METHODS:
                what = "a method" if there else "none"
                raise CopyFailed(None, line=f"expected an attribute of the environment that is called {name}, got {what}")
            self._env.calls.assign(chosen, name, [unpack(packed)] * len(chosen))
        except EnvironmentFailed as error:
            raise CopyFailed(None, f"set_env_attr {name}") from error
        self._missing.discard(key)

    def _have(self, copies: Sequence[int], name: str) -> bool:
        """Whether these copies have the attribute. Copies of a client in another language have no attributes."""
        try:
            return all(self._env.calls.call(copies, "has_wrapper_attr", (name,), {}))
        except AttributeError:
            return False


def _overlap(chosen: Iterable[int], copies: slice) -> bool:
    return any(copies.start <= n < copies.stop for n in chosen)
