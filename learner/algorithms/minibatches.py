"""Rows of a batch in the form of the network's input, and the selection of minibatches from them.

Rule: rows that are not valid never enter a loss, and each valid row enters exactly one loss per epoch. A recurrent core
still runs over the rows that are not valid, because it processes whole columns.

A batch has T rows for each of ΣN env copies (columns). Row indices refer to all T · ΣN rows as one flat sequence in time
order. B is the number of rows in a minibatch, and C the number of its columns if the policy has a recurrent core.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from millrace.learner.algorithms.bodies.networks import ActorCriticNetwork
from millrace.protocol.arrays import Array, Bools, Floats
from millrace.protocol.policy.encoder import RecurrentInput
from millrace.protocol.rollout import Batch

Index = Tensor | slice

CHUNK_ROWS = 1024  # number of observations evaluated together if no gradient is needed; limits the memory used


class NetworkInput(NamedTuple):
    """The arguments of an actor-critic network's forward pass."""

    features: Tensor  # [B, D] float32, normalized
    images: tuple[Tensor, ...]  # [B, *leaf] uint8 each
    recurrent: RecurrentInput | None  # None without a core


class Observations(Protocol):
    """The T+1 observations of a batch. An algorithm computes values or log-probabilities for them."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(T+1, ΣN)."""
        ...

    def evaluate(self, steps: int, function: Callable[[NetworkInput, Index], Tensor], pulse: Callable[[], None]) -> Floats:
        """Apply `function` to the observations of the first `steps` steps, in chunks and without gradients.

        `function` gets a chunk's network input and the indices of its rows in the batch, and returns one number for each
        row. All results are returned as one array [steps, ΣN]. Calls `pulse` after each chunk.
        """
        ...


class ColumnObservations(NamedTuple):
    """The T+1 observations of ΣN env copies, normalized by the statistics that the workers acted with."""

    shape: tuple[int, ...]  # (T+1, ΣN)
    features: Tensor  # [(T+1) · ΣN, D] float32, normalized
    images: tuple[Tensor, ...]  # [(T+1) · ΣN, *leaf] uint8 each
    recurrent: RecurrentInput | None  # for all T+1 steps; None without a core

    def network_input(self, steps: int, columns: Index, rows: Index) -> NetworkInput:
        """The network input for `rows`. If the policy has a core, these must be the first `steps` steps of `columns`."""
        recurrent = None if self.recurrent is None else self.recurrent.part(steps, columns)
        return NetworkInput(self.features[rows], tuple(image[rows] for image in self.images), recurrent)

    @torch.no_grad()
    def evaluate(self, steps: int, function: Callable[[NetworkInput, Index], Tensor], pulse: Callable[[], None]) -> Floats:
        """See `Observations`."""
        values = torch.empty(steps * self.shape[1], device=self.features.device)
        for columns, rows in self._chunks(steps):
            values[rows] = function(self.network_input(steps, columns, rows), rows)
            pulse()
        return np.asarray(values.cpu().numpy()).reshape(steps, -1)

    def _chunks(self, steps: int) -> Iterator[tuple[Index, Index]]:
        """Yield the columns and the rows of each chunk of about CHUNK_ROWS rows.

        A chunk holds consecutive rows or, with a recurrent core, whole columns.
        """
        columns = self.shape[1]
        if self.recurrent is None:
            for at in range(0, steps * columns, CHUNK_ROWS):
                yield slice(None), slice(at, min(at + CHUNK_ROWS, steps * columns))
            return
        for some in torch.split(torch.arange(columns, device=self.features.device), max(1, CHUNK_ROWS // steps)):
            yield some, rows_of_columns(steps, columns, some)


class Minibatch(NamedTuple):
    """B rows of a batch."""

    features: Tensor  # [B, D] float32, normalized
    images: tuple[Tensor, ...]  # [B, *leaf] uint8 each
    action: Tensor  # [B, *action] int64, or float32 that is not clipped to the bounds
    log_prob: Tensor  # [B] float32 log-probability of the action under the policy that acted
    advantage: Tensor  # [B] float32, not standardized
    target: Tensor  # [B] float32 target of the value function
    recurrent: RecurrentInput | None = None  # with a core, features and images have T · C rows, of which this selects B
    mask: Tensor | None = None  # [B, choices] bool, True for allowed actions; None unless the run uses action masks
    standardized: Tensor | None = None  # [B] advantages standardized over all parts; None if this is the only part

    @staticmethod
    def of(batch: Batch, observations: ColumnObservations, advantage: Floats, target: Floats) -> Minibatch:
        """All T · ΣN rows of a batch, including rows that are not valid. `advantage` and `target` are [T, ΣN]."""
        inputs = observations.network_input(len(batch.valid), slice(None), slice(batch.valid.size))
        device = inputs.features.device
        return Minibatch(
            inputs.features,
            inputs.images,
            flat_tensor(batch.action, device),
            flat_tensor(batch.log_prob, device),
            flat_tensor(advantage, device),
            flat_tensor(target, device),
            inputs.recurrent,
            None if batch.mask is None else flat_tensor(batch.mask[:-1], device),
        )

    def select(self, rows: Tensor, input_rows: Tensor | None = None, recurrent: RecurrentInput | None = None) -> Minibatch:
        """A copy of some rows. `input_rows` are the rows that enter the network, if a core needs more than `rows`."""
        input_rows = rows if input_rows is None else input_rows
        return Minibatch(
            self.features.index_select(0, input_rows),
            tuple(image[input_rows] for image in self.images),
            self.action.index_select(0, rows),
            self.log_prob.index_select(0, rows),
            self.advantage.index_select(0, rows),
            self.target.index_select(0, rows),
            recurrent,
            None if self.mask is None else self.mask[rows],
        )

    def select_columns(self, columns: Tensor, used: Tensor) -> Minibatch:
        """A minibatch of the rows of these columns where `used` [T, ΣN] is True, in time order.

        The recurrent core still runs over all rows of the columns.
        """
        assert self.recurrent is not None
        steps, count = self.recurrent.keep_state.shape
        rows = rows_of_columns(steps, count, columns)
        selected = used.flatten()[rows]
        recurrent = self.recurrent.part(steps, columns, torch.nonzero(selected)[:, 0])
        return self.select(rows[selected], rows, recurrent)

    def shuffled(self, used: Bools, count: int, generator: torch.Generator | None) -> Iterator[Minibatch]:
        """Yield `count` minibatches of nearly equal size. Each row where `used` [T, ΣN] is True is in exactly one of them.

        Rows are shuffled; without a generator, they stay in order. With a core, whole columns stay together, because the
        core learns from consecutive rows, so there are at most as many minibatches as columns.
        """
        index = units_in_order(used, generator, whole_columns=self.recurrent is not None)
        if not len(index):
            return
        of_rows = torch.from_numpy(used)
        if self.recurrent is not None:  # only `select_columns` needs this mask on the device of the rows
            of_rows = of_rows.to(self.features.device)
        for chosen in index.to(self.features.device).tensor_split(min(count, len(index))):
            yield self.chosen(chosen, of_rows)

    def chosen(self, units: Tensor, used: Tensor) -> Minibatch:
        """A copy of some of the rows or columns from `units_in_order`. `used` [T, ΣN] is True for the rows to use."""
        return self.select(units) if self.recurrent is None else self.select_columns(units, used)


class UpdateRows(Protocol):
    """The rows of a batch, in the form in which an update uses them."""

    @property
    def observations(self) -> Observations:
        """The observations that `estimate` computes values for."""
        ...

    def epochs(
        self, advantage: Floats, target: Floats, used: Bools, count: int, generator: torch.Generator
    ) -> Iterator[Iterable[Sequence[Minibatch]]]:
        """Yield epochs without end. Each minibatch in an epoch is a sequence of the parts that this process learns from.

        If an epoch has a single minibatch, the minibatch is created once, with its rows in order, and yielded every time.
        The arrays are [T, ΣN].
        """
        ...


class WholeBatch(NamedTuple):
    """All rows of a batch. A minibatch has a single part."""

    batch: Batch
    observations: ColumnObservations

    def epochs(
        self, advantage: Floats, target: Floats, used: Bools, count: int, generator: torch.Generator
    ) -> Iterator[Iterable[Sequence[Minibatch]]]:
        """See `UpdateRows`."""
        rows = Minibatch.of(self.batch, self.observations, advantage, target)
        return endless_epochs(lambda order: ((part,) for part in rows.shuffled(used, count, order)), count, generator)


def endless_epochs(
    minibatches: Callable[[torch.Generator | None], Iterable[Sequence[Minibatch]]], count: int, generator: torch.Generator
) -> Iterator[Iterable[Sequence[Minibatch]]]:
    """Yield epochs without end. `minibatches` creates one epoch's minibatches, with rows in order if its argument is None.

    If an epoch has a single minibatch, the minibatch is created once, with its rows in order, and yielded every time.
    """
    single = tuple(minibatches(None)) if count == 1 else ()
    while True:
        yield single or minibatches(generator)


class LossInput(NamedTuple):
    """The input of a loss: the B rows of a minibatch, and the network's current outputs for them. Every row is valid.

    All tensors are float32, except discrete actions. Gradients flow through the last three.
    """

    action: Tensor
    """[B, *action] the actions taken: int64 counted from 0, or for a Box, float32 that is not clipped to its bounds"""
    log_prob: Tensor
    """[B] log-probability of the action under the policy that acted"""
    advantage: Tensor
    """[B] how much better the action was than expected; standardized if `standardizes_advantages()`"""
    raw_advantage: Tensor
    """[B] the advantage as estimated, never standardized"""
    target: Tensor
    """[B] target of the value function"""
    log_prob_now: Tensor
    """[B] log-probability of the action under the current policy"""
    entropy: Tensor
    """[B] entropy of the current policy"""
    value: Tensor
    """[B] the critic's current value of the observation"""


def flat_tensor(array: Array, device: torch.device | str) -> Tensor:
    """An array [T, N, …] as a tensor [T · N, …] on a device."""
    return torch.from_numpy(array.reshape(array.shape[0] * array.shape[1], *array.shape[2:])).to(device)


def units_in_order(used: Bools, generator: torch.Generator | None, *, whole_columns: bool) -> Tensor:
    """The indices of the rows where `used` [T, N] is True, shuffled, or in order if there is no generator.

    If `whole_columns`, returns the indices of the columns that have such a row. Other columns are left out, because they
    could make a minibatch empty.
    """
    units = torch.from_numpy(np.flatnonzero(used.any(0) if whole_columns else used))
    return units if generator is None else units[torch.randperm(len(units), generator=generator)]


def rows_of_columns(steps: int, columns: int, chosen: Tensor) -> Tensor:
    """The indices of all rows of the chosen columns, in time order, in a batch of `steps` × `columns` rows."""
    return (torch.arange(steps, device=chosen.device)[:, None] * columns + chosen).flatten()


def log_probs(net: ActorCriticNetwork, observations: Observations, batch: Batch, pulse: Callable[[], None]) -> Floats:
    """Log-probabilities [T, ΣN] of a batch's actions, with the current weights of `net`."""
    device = net.flat.device
    action = flat_tensor(batch.action, device)
    mask = None if batch.mask is None else flat_tensor(batch.mask[:-1], device)

    def log_prob(inputs: NetworkInput, at: Index) -> Tensor:
        return net.evaluate(*inputs, action[at], None if mask is None else mask[at])[0]

    return observations.evaluate(len(batch.valid), log_prob, pulse)
