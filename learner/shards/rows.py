"""The rows of a batch whose shards are divided among learner processes. Each process has only its shards' observations.

Law: every minibatch consists of one part per shard. All processes know the small arrays of the whole batch, so they draw the
same parts for all shards, and standardize advantages over the whole minibatch. A shard without rows in a minibatch has an
empty part.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from millrace.learner.algorithms.losses import standardized
from millrace.learner.algorithms.minibatches import (
    Index,
    Minibatch,
    NetworkInput,
    WholeBatch,
    endless_epochs,
    rows_of_columns,
    units_in_order,
)
from millrace.learner.shards.division import Columns
from millrace.protocol.arrays import Bools, Floats
from millrace.protocol.rollout import Batch

Gather = Callable[[Tensor], Tensor]
"""Gathers the tensors [own shards, ...] of all processes into one tensor [S, ...] of all shards, in order."""


class ShardObservations(NamedTuple):
    """The observations of a process's own shards."""

    batch: Batch
    """the batch: small arrays have all columns, and observations at least the columns of this process's shards"""
    columns: Sequence[Columns]
    """the columns of each of the S shards"""
    own: range
    """the shards of this process"""
    parts: Sequence[WholeBatch]
    """this process's shards, with their observations"""
    gather: Gather

    @property
    def shape(self) -> tuple[int, ...]:
        """(T+1, ΣN)."""
        T, N = self.batch.valid.shape
        return T + 1, N

    def evaluate(self, steps: int, function: Callable[[NetworkInput, Index], Tensor], pulse: Callable[[], None]) -> Floats:
        """See `Observations`. Each process computes the results of its own shards, and gets the results of all shards."""
        total = self.batch.valid.shape[1]
        widest = max(map(len, self.columns))
        values = torch.zeros(len(self.own), steps, widest)
        for values_of_shard, shard, (_, part) in zip(values, self.own, self.parts, strict=True):
            columns = torch.from_numpy(self.columns[shard])
            in_batch = rows_of_columns(steps, total, columns).to(part.features.device)

            def of_batch(inputs: NetworkInput, rows: Index, in_batch: Tensor = in_batch) -> Tensor:
                return function(inputs, in_batch[rows])

            values_of_shard[:, : len(columns)] = torch.from_numpy(part.evaluate(steps, of_batch, pulse))
        every = np.empty((steps, total), np.float32)
        for columns_of_shard, values_of_shard in zip(self.columns, self.gather(values).numpy(), strict=True):
            every[:, columns_of_shard] = values_of_shard[:, : len(columns_of_shard)]
        return every


class ShardRows(NamedTuple):
    """The rows of a batch. This process learns from those of its own shards."""

    observations: ShardObservations
    standardizes: bool

    def epochs(
        self, advantage: Floats, target: Floats, used: Bools, count: int, generator: torch.Generator
    ) -> Iterator[Iterable[Sequence[Minibatch]]]:
        """See `UpdateRows`. A minibatch has one part for each of this process's shards."""
        _, columns, own, parts, _ = self.observations
        rows_of_shards = [
            Minibatch.of(*part, advantage[:, columns[shard]], target[:, columns[shard]])
            for shard, part in zip(own, parts, strict=True)
        ]
        device = parts[0].observations.features.device
        used_in_shards = [torch.from_numpy(used[:, each]) for each in columns]
        used_here = {shard: used_in_shards[shard].to(device) for shard in own}
        advantages = [torch.from_numpy(advantage[:, each]).flatten() for each in columns]
        has_core = parts[0].observations.recurrent is not None

        def minibatches(generator: torch.Generator | None) -> Iterator[Sequence[Minibatch]]:
            order = [units_in_order(each.numpy(), generator, whole_columns=has_core) for each in used_in_shards]
            number = min(count, max(map(len, order)))
            for pieces in zip(*(each.tensor_split(number) for each in order), strict=True) if number else ():
                scaled = self._standardized(
                    [
                        all_of_shard[_rows(piece, used_in_shard, has_core=has_core)]
                        for all_of_shard, piece, used_in_shard in zip(advantages, pieces, used_in_shards, strict=True)
                    ]
                )
                yield tuple(
                    rows.chosen(pieces[shard].to(device), used_here[shard])._replace(standardized=scaled[shard].to(device))
                    for shard, rows in zip(own, rows_of_shards, strict=True)
                )

        return endless_epochs(minibatches, count, generator)

    def _standardized(self, advantages: Sequence[Tensor]) -> Sequence[Tensor]:
        """The advantages of all parts, standardized over the whole minibatch if the settings say so."""
        if not self.standardizes:
            return advantages
        return torch.split(standardized(torch.cat(list(advantages))), [len(each) for each in advantages])


def _rows(units: Tensor, used: Tensor, *, has_core: bool) -> Tensor:
    """The rows of some units of `units_in_order`. With a core, units are columns: returns their used rows in time order."""
    if not has_core:
        return units
    steps, columns = used.shape
    rows = rows_of_columns(steps, columns, units)
    return rows[used.flatten()[rows]]
