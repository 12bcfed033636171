"""The rollout state that a resumed run needs: round numbers, each lane's past, and the weights of open rounds.

Rule: with this state, a new learner deals the same tickets that the previous one would have dealt: for the same rounds, with
the same versions, on lanes that continue where their last rollout ended.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import msgspec
import numpy as np

from millrace.learner.rollouts.ledger import Ledger, Past
from millrace.protocol.arrays import Array, Bytes
from millrace.protocol.messages import LanePast, Weights
from millrace.protocol.wire.codec import DTYPES

T = TypeVar("T", bound=msgspec.Struct)


class RoundsState(msgspec.Struct, frozen=True):
    """Which rounds are open (`lag_rule.py`)."""

    next: Past = 0
    """the round of the next update"""
    versions: dict[Past, Past] = {}
    """the version that acts in each open round"""


class PastRollouts(msgspec.Struct, frozen=True):
    """The state after the rollouts so far. The defaults are a new run's values."""

    ledger: Ledger = msgspec.field(default_factory=Ledger)
    incarnations: list[Past] = []
    """the next incarnation of each lane"""
    rounds: RoundsState = RoundsState()
    lanes: Sequence[LanePast] = ()
    """the past of each lane from which rollouts were taken"""
    acting: Sequence[Weights] = ()
    """the weights that act in open rounds, except those that the new learner publishes first"""


def packed(record: msgspec.Struct) -> Bytes:
    """Encode a record as bytes, for a file. Its arrays are copied."""
    return np.frombuffer(msgspec.msgpack.encode(record, enc_hook=_described), np.uint8)


def unpacked(kind: type[T], data: Bytes) -> T:
    """Decode a record of this type. Raises `ValueError` or `msgspec.ValidationError` for anything else."""
    return msgspec.msgpack.decode(data.tobytes(), type=kind, dec_hook=_array)


def _described(value: object) -> object:
    if isinstance(value, np.ndarray):
        return [value.dtype.str, list(value.shape), value.tobytes()]
    raise TypeError(f"cannot write a {type(value).__name__}")


def _array(wanted: type, value: Any) -> Array:
    name, shape, data = value
    if name not in DTYPES:
        raise ValueError(f"expected an array of numbers, got {name!r}")
    return np.frombuffer(data, DTYPES[name]).reshape(shape)
