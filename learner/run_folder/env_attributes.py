"""The attributes that callbacks set on env copies: those of the next weights, and those that a resumed run must send. Pure.

Rule: an attribute takes effect with the next version of the weights, so each rollout is collected with the attributes of its
version, whatever the number of workers. A checkpoint of version v has the attributes of v and those for v + 1.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.bounds import MAX_NAME, one_line
from millrace.protocol.errors import UsageError, safe_repr
from millrace.protocol.wire.plain_values import pack, unpack

MOST_BYTES = 1 << 20  # limit on the total size of all attributes, because they are sent with every version of the weights


class AttributesState(msgspec.Struct, kw_only=True):
    """The attributes in a checkpoint."""

    sent: bytes = b""
    """packed attributes of the version of the checkpoint; empty if there are none"""
    waiting: bytes = b""
    """packed attributes of the next version"""


class EnvAttributes:
    """The attributes of one run, by name."""

    def __init__(self, state: AttributesState | None = None, refusal: str = "") -> None:
        """`state` is from the checkpoint of a resumed run.

        `refusal` says why this run's env copies can't have attributes; it is empty if they can.
        """
        state = state or AttributesState()
        self._refusal = refusal
        self._next = _unpacked(state.sent)  # attributes of the next weights
        self._after: dict[str, Any] | None = _unpacked(state.waiting)  # those of the version after that; None if unchanged
        self._sent = state.sent
        self._version = -1
        self.changes = 0
        """how many times an attribute was set in this process"""

    def now(self) -> dict[str, Any]:
        """The newest attributes, by name."""
        return dict(self._next if self._after is None else self._after)

    def set(self, name: str, value: Any) -> None:
        """Set an attribute from the next weights on. Raises `UsageError` if it cannot be sent."""
        if self._refusal:
            raise UsageError(f"set_env_attr {one_line(str(name), 80)}: {self._refusal}")
        if not (isinstance(name, str) and name.isidentifier() and len(name) <= MAX_NAME) or name.startswith("_"):
            raise UsageError(f"set_env_attr: expected the name of a public attribute, got {one_line(safe_repr(name), 80)}")
        try:
            value = unpack(pack(value))  # a copy that the caller can't change
            size = len(pack({**self.now(), name: value}))
        except TypeError as error:
            raise UsageError(f"set_env_attr {name}: {one_line(str(error))}") from None
        if size > MOST_BYTES:
            raise UsageError(f"set_env_attr {name}: expected at most {MOST_BYTES:,} bytes of attributes, got {size:,}")
        self._next = {**self._next, name: value}
        if self._after is not None:
            self._after = {**self._after, name: value}
        self.changes += 1

    def table(self, version: int) -> Array | None:
        """The packed attributes of this version's weights, the same on each call; None if there are no attributes."""
        if version != self._version:
            self._sent = pack(self._next) if self._next else b""
            self._version = version
            if self._after is not None:
                self._next = self._after
                self._after = None
        return np.frombuffer(self._sent, np.uint8) if self._sent else None

    def state(self, version: int) -> AttributesState:
        """The state for a checkpoint of this version."""
        waiting = pack(self.now()) if self.now() else b""
        first = self._version == -1  # no weights have been published in this process
        return AttributesState(sent=self._sent if first or version == self._version else waiting, waiting=waiting)


def _unpacked(packed: bytes) -> dict[str, Any]:
    """The attributes by name. Raises `BadMessage` or `ValueError` unless `table` packed them."""
    attributes = unpack(packed) if packed else {}
    if not isinstance(attributes, dict):
        raise ValueError(f"attributes: expected a dict, got {type(attributes).__name__}")
    return attributes
