"""How a batch is divided into shards, and shards among learner processes. Pure.

Law: shard s of S has the lanes whose number leaves the remainder s when it is divided by S. Each shard passes the network
alone, so the shapes of its passes don't depend on the number R of processes. Sums over shards are made in a fixed order, as
a tree of pairs. Therefore every R that divides S gives the same bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, Self, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from millrace.protocol.rollout import Batch

Columns = npt.NDArray[np.int64]
"""[columns] a number for each, such as its own or that of its lane"""


class Addend(Protocol):
    """What can be added: a number, an array, a tensor."""

    def __add__(self, other: Self, /) -> Self: ...


Term = TypeVar("Term", bound=Addend)


class Division(NamedTuple):
    """S shards of R learner processes."""

    shards: int
    """S, a multiple of R"""
    processes: int
    """R"""
    rank: int
    """the number of this process, from 0"""

    def of_process(self, rank: int) -> range:
        """The shards of a process: S / R that follow each other."""
        count = self.shards // self.processes
        return range(rank * count, (rank + 1) * count)

    @property
    def own(self) -> range:
        """The shards of this process."""
        return self.of_process(self.rank)

    def columns(self, lane: Columns) -> list[Columns]:
        """The columns of each shard. `lane` [ΣN]: the lane of each column."""
        return [np.flatnonzero(lane % self.shards == shard) for shard in range(self.shards)]

    def columns_of_process(self, lane: Columns, rank: int) -> Columns:
        """The columns of all shards of a process, shard by shard."""
        columns = self.columns(lane)
        return np.concatenate([columns[shard] for shard in self.of_process(rank)])


def part_of(batch: Batch, columns: Columns) -> Batch:
    """Some columns of a batch, without the list of its episodes. With seats, the columns are those of whole env copies."""
    resets = batch.resets
    if resets is not None:
        seats = batch.valid.shape[1] // resets.shape[1]
        resets = resets[:, columns[::seats] // seats]
    return msgspec.structs.replace(
        batch,
        obs=tuple(leaf.take(columns, axis=1) for leaf in batch.obs),  # contiguous, so that torch needs no other copy
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
        resets=resets,
    )


def pairwise_sum(terms: Sequence[Term]) -> Term:
    """The sum of one or more terms: neighbours are added, then neighbouring sums, until one is left."""
    while len(terms) > 1:
        pairs = [one + other for one, other in zip(terms[::2], terms[1::2], strict=False)]
        terms = [*pairs, *terms[2 * len(pairs) :]]
    return terms[0]
