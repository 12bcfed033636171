"""What rank 0, which leads the run, tells the other learner processes. Pure: messages are plain records.

    Begin → (Learn | StillThere)* → End

Each message may carry arrays, which follow it as bytes. Nothing is unpickled.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec

SMALL = ("action", "log_prob", "reward", "terminated", "truncated", "valid", "state", "lane", "fresh")
"""The arrays of a `Batch` that every process gets whole"""


class Begin(msgspec.Struct, frozen=True, tag=True):
    """The run that is trained: its settings are those of rank 0, whatever the other processes were given."""

    config: str
    """as TOML"""
    policy: PolicySpec
    run: str
    """the path of its folder"""
    device: str
    """cpu or cuda"""
    versions: dict[str, str]
    """of the packages that decide results"""


class Learn(msgspec.Struct, frozen=True, tag=True):
    """Learn from a batch. Its arrays: the statistics, those of the batch, and the state if it is sent."""

    columns_per_rollout: int
    leaves: int
    """number of the arrays of an observation; they have the columns of the receiver's shards only"""
    extras: int
    masked: bool
    seats: bool
    state: bool
    """whether the whole state of rank 0's algorithm follows, because the receiver does not have it"""
    digest: str
    """of the weights of rank 0, for the receiver to compare; empty if it need not"""


class StillThere(msgspec.Struct, frozen=True, tag=True):
    """The next batch is being collected."""


class End(msgspec.Struct, frozen=True, tag=True):
    """The run has ended."""

    reason: str
    failed: bool
    """whether by an error: then a launcher should start all processes again, not only rank 0"""


FromRankZero = Begin | Learn | StillThere | End


def arrays_of(batch: Batch, columns: Array) -> list[Array]:
    """The arrays of a batch as a process gets them: whole, but of observations only these columns."""
    optional = [array for array in (batch.mask, batch.resets) if array is not None]
    return [
        *(getattr(batch, name) for name in SMALL),
        *batch.extras,
        *optional,
        *(leaf.take(columns, axis=1) for leaf in batch.obs),
    ]


def batch_of(learn: Learn, arrays: Sequence[Array], columns: Array) -> Batch:
    """The batch of `arrays_of`, without episodes. Observations of other columns are zeros, which take no memory."""
    rest = iter(arrays)
    small = {name: next(rest) for name in SMALL}
    extras = tuple(next(rest) for _ in range(learn.extras))
    mask = next(rest) if learn.masked else None
    resets = next(rest) if learn.seats else None
    obs = tuple(_widened(next(rest), columns, len(small["lane"])) for _ in range(learn.leaves))
    return Batch(
        **small,
        obs=obs,
        columns_per_rollout=learn.columns_per_rollout,
        episodes=(),
        extras=extras,
        mask=mask,
        resets=resets,
    )


def _widened(leaf: Array, columns: Array, total: int) -> Array:
    wide = np.zeros((leaf.shape[0], total, *leaf.shape[2:]), leaf.dtype)
    wide[:, columns] = leaf
    return wide
