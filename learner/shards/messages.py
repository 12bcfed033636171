"""The messages that rank 0, which leads the run, sends to the other learner processes. Pure: messages are plain records.

    Begin → (Learn | StillThere)* → End

A message is sent as its head, which is msgpack, followed by the bytes of its arrays. In place of an array, the head has the
array's shape and dtype. Nothing is unpickled.
"""

from __future__ import annotations

import msgspec
import numpy as np

from millrace.protocol.arrays import Array, Bytes
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec


class Begin(msgspec.Struct, frozen=True, tag=True):
    """Begin this run. It has the settings of rank 0, whatever settings the other processes were given."""

    config: str
    """the settings, as TOML"""
    policy: PolicySpec
    run: str
    """the path of the run folder"""
    device: str
    """cpu or cuda"""
    versions: dict[str, str]
    """the versions, on rank 0, of the packages on which results depend"""


class Learn(msgspec.Struct, frozen=True, tag=True):
    """Learn from a batch."""

    batch: Batch
    """the batch, `narrowed` to the columns of the receiver's shards"""
    statistics: Array
    """rank 0's statistics of observations"""
    state: Bytes | None
    """the whole state of rank 0's algorithm, if the receiver does not have it"""
    digest: str
    """the digest of rank 0's state, for the receiver to compare with its own; empty if it need not compare"""


class StillThere(msgspec.Struct, frozen=True, tag=True):
    """Rank 0 is alive, and the next batch is still being collected."""


class End(msgspec.Struct, frozen=True, tag=True):
    """The run has ended."""

    reason: str
    failed: bool
    """whether it ended with an error; in that case a launcher should restart all processes, not only rank 0"""


FromRankZero = Begin | Learn | StillThere | End


HEAD = msgspec.msgpack.Decoder(FromRankZero, dec_hook=lambda kind, described: np.empty(*described))
"""Decodes the head of a message. The values in the message's arrays are undefined until the receiver writes them."""


def encode(message: FromRankZero) -> tuple[bytes, list[Array]]:
    """The head of a message, and the message's arrays in the order in which the head describes them."""
    arrays: list[Array] = []

    def described(array: Array) -> tuple[tuple[int, ...], str]:
        arrays.append(array)
        return array.shape, array.dtype.str

    return msgspec.msgpack.encode(message, enc_hook=described), arrays
