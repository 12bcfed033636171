"""The messages that rank 0, which leads the run, sends to the other learner processes. Pure: messages are plain records.

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
"""The arrays of a `Batch` that every process gets with all their columns."""


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
    """Learn from a batch. The statistics, the arrays of the batch, and perhaps a state follow as arrays."""

    columns_per_rollout: int
    leaves: int
    """the number of arrays of an observation; they have only the columns of the receiver's shards"""
    extras: int
    masked: bool
    seats: bool
    state: bool
    """whether the whole state of rank 0's algorithm follows, because the receiver does not have it"""
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


def arrays_of(batch: Batch, columns: Array) -> list[Array]:
    """The arrays of a batch that are sent to a process. Observations have only `columns`; other arrays have all columns."""
    optional = [array for array in (batch.mask, batch.resets) if array is not None]
    return [
        *(getattr(batch, name) for name in SMALL),
        *batch.extras,
        *optional,
        *(leaf.take(columns, axis=1) for leaf in batch.obs),
    ]


def batch_of(learn: Learn, arrays: Sequence[Array], columns: Array) -> Batch:
    """Make the batch, without episodes, from the result of `arrays_of`. The observations of other columns are zeros.

    The operating system allocates no memory for these zeros.
    """
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
