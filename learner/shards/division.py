"""How a batch is divided into shards, and the shards among learner processes. Pure.

Law: shard s of S has the lanes whose number modulo S is s. Each shard passes through the network on its own, so the shapes
of the passes don't depend on the number R of processes. Sums over shards are computed in a fixed order, as a tree of pairs.
Therefore, every R that divides S gives bit-identical results.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, Self, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from millrace.protocol.arrays import Array
from millrace.protocol.rollout import Batch

Columns = npt.NDArray[np.int64]
"""[columns] an integer for each column, such as the column's number or its lane's number"""


class Addend(Protocol):
    """A value that can be added, such as a number, an array or a tensor."""

    def __add__(self, other: Self, /) -> Self: ...


Term = TypeVar("Term", bound=Addend)


class Division(NamedTuple):
    """The division of S shards among R learner processes."""

    shards: int
    """S, the number of shards, a multiple of R"""
    processes: int
    """R, the number of processes"""
    rank: int
    """the number of this process, from 0"""

    def of_process(self, rank: int) -> range:
        """The shards of a process: S / R consecutive shards."""
        count = self.shards // self.processes
        return range(rank * count, (rank + 1) * count)

    @property
    def own(self) -> range:
        """The shards of this process."""
        return self.of_process(self.rank)

    def columns(self, lane: Columns) -> list[Columns]:
        """The columns of each shard. `lane` [ΣN] is the lane of each column."""
        return [np.flatnonzero(lane % self.shards == shard) for shard in range(self.shards)]

    def columns_of_process(self, lane: Columns, rank: int) -> Columns:
        """The columns of all shards of a process, shard by shard."""
        columns = self.columns(lane)
        return np.concatenate([columns[shard] for shard in self.of_process(rank)])


def part_of(batch: Batch, columns: Columns) -> Batch:
    """Some columns of a batch, without the list of its episodes. With seats, `columns` must cover whole env copies."""
    of_copy = batch.columns_per_copy
    return msgspec.structs.replace(
        batch,
        obs=tuple(leaf.take(columns, axis=1) for leaf in batch.obs),  # contiguous, so torch needs no further copy
        action=batch.action[:, columns],
        log_prob=batch.log_prob[:, columns],
        reward=batch.reward[:, columns],
        terminated=batch.terminated[:, columns],
        truncated=batch.truncated[:, columns],
        valid=batch.valid[:, columns],
        state=batch.state[columns],
        lane=batch.lane[columns],
        fresh=batch.fresh[columns],
        episodes=(),
        extras=tuple(array[:, columns] for array in batch.extras),
        mask=None if batch.mask is None else batch.mask[:, columns],
        resets=None if batch.resets is None else batch.resets[:, columns[::of_copy] // of_copy],
    )


def narrowed(batch: Batch, columns: Columns) -> Batch:
    """The batch with the observations of some columns only, and without the list of its episodes."""
    return msgspec.structs.replace(batch, obs=tuple(leaf.take(columns, axis=1) for leaf in batch.obs), episodes=())


def widened(batch: Batch, columns: Columns) -> Batch:
    """The reverse of `narrowed`. Other columns get zeros, for which the operating system allocates no memory."""

    def wide(leaf: Array) -> Array:
        every = np.zeros((leaf.shape[0], len(batch.lane), *leaf.shape[2:]), leaf.dtype)
        every[:, columns] = leaf
        return every

    return msgspec.structs.replace(batch, obs=tuple(map(wide, batch.obs)))


def pairwise_sum(terms: Sequence[Term]) -> Term:
    """The sum of one or more terms. Adds neighbors, then neighboring sums, until only one sum is left."""
    while len(terms) > 1:
        pairs = [one + other for one, other in zip(terms[::2], terms[1::2], strict=False)]
        terms = [*pairs, *terms[2 * len(pairs) :]]
    return terms[0]
