"""The base of all messages except `Rollout`. It imports little, so that a small program can use just a few messages."""

from __future__ import annotations

import msgspec


class Message(msgspec.Struct, frozen=True, tag=True, array_like=True, forbid_unknown_fields=True):
    """Base of all messages except `Rollout`, which has its own file. Fields travel by position, without their names."""
