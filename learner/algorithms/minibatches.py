"""Rows of a batch in the form of the network's input, and the selection of minibatches from them.

A batch has T rows for each of ΣN env copies (columns). Row numbers count the rows as one flat sequence of T · ΣN rows in
time order. B is the number of rows of a minibatch, and C the number of its columns if the policy has a recurrent core.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from protocol.arrays import Array
from protocol.policy.networks import RecurrentInput

Index = Tensor | slice


class NetworkInput(NamedTuple):
    """The arguments of an actor-critic network's forward pass."""

    features: Tensor  # [B, D] float32, normalized
    images: tuple[Tensor, ...]  # [B, *leaf] uint8 each
    recurrent: RecurrentInput | None  # None without a core


class Observations(NamedTuple):
    """The T+1 observations of ΣN env copies, normalized by the statistics that the workers acted under."""

    raw_features: Array  # [T+1, ΣN, D] float32 or float64, not normalized
    features: Tensor  # [(T+1) · ΣN, D] float32, normalized
    images: tuple[Tensor, ...]  # [(T+1) · ΣN, *leaf] uint8 each
    recurrent: RecurrentInput | None  # for all T+1 steps; None without a core

    def network_input(self, steps: int, columns: Index, rows: Index) -> NetworkInput:
        """The input for `rows`, which must be the first `steps` steps of `columns` if the policy has a core."""
        recurrent = self.recurrent
        if recurrent is not None:
            recurrent = RecurrentInput(recurrent.initial_state[columns], recurrent.keep_state[:steps, columns])
        return NetworkInput(self.features[rows], tuple(image[rows] for image in self.images), recurrent)


class Minibatch(NamedTuple):
    """B rows of a batch: tensors, or numpy arrays if the network is evaluated in numpy (`kernels.fused`)."""

    features: Any  # [B, D] float32, normalized
    images: tuple[Any, ...]  # [B, *leaf] uint8 each
    action: Any  # [B, *action] int64, or float32 not clipped
    log_prob: Any  # [B] float32, of the action under the policy that acted
    advantage: Any  # [B] float32, not standardized
    target: Any  # [B] float32, what the value is fitted to
    recurrent: RecurrentInput | None = None  # with a core, features and images are [T · C, …], and it selects B of them
    mask: Any = None  # [B, choices] bool, which actions are allowed; None unless the run uses action masks

    def in_numpy(self) -> Minibatch:
        """The same memory as numpy arrays. Only for policies without images and without a core."""
        features, _, action, log_prob, advantage, target, _, mask = self
        arrays = (features.numpy(), (), action.numpy(), log_prob.numpy(), advantage.numpy(), target.numpy())
        return Minibatch(*arrays, mask=None if mask is None else mask.numpy())

    def select(self, rows: Any, input_rows: Tensor | None = None, recurrent: RecurrentInput | None = None) -> Minibatch:
        """A copy of some rows. `input_rows`: the rows of the network's input, if a core needs more rows than these."""
        input_rows = rows if input_rows is None else input_rows
        return Minibatch(
            self.features[input_rows],
            tuple(image[input_rows] for image in self.images),
            self.action[rows],
            self.log_prob[rows],
            self.advantage[rows],
            self.target[rows],
            recurrent,
            None if self.mask is None else self.mask[rows],
        )

    def select_columns(self, columns: Tensor, mask: Tensor) -> Minibatch:
        """A minibatch of those rows of the given columns where `mask` [T, ΣN] is True, in time order.

        The recurrent core still runs over all rows of the columns.
        """
        assert self.recurrent is not None
        state, keep_state, _ = self.recurrent
        rows = rows_of_columns(len(keep_state), keep_state.shape[1], columns)
        selected = mask.flatten()[rows]
        recurrent = RecurrentInput(state[columns], keep_state[:, columns], torch.nonzero(selected)[:, 0])
        return self.select(rows[selected], rows, recurrent)


class LossInput(NamedTuple):
    """Input of a loss: B rows of a minibatch, and the network's present outputs for them. Every row is valid.

    Tensors for `ActorCritic.loss`; for `ActorCritic.loss_gradients` tensors or numpy arrays. All are float32, except actions
    that are choices. Gradients flow through the last three.
    """

    action: Any
    """[B, *action] what was done: int64 counted from 0, or float32 that is not clipped to the action space (Box)"""
    log_prob: Any
    """[B] log-probability of the action under the policy that acted"""
    advantage: Any
    """[B] how much better the action was than expected; mean 0 and standard deviation 1 if `normalize_advantage` is set"""
    raw_advantage: Any
    """[B] the advantage as it was estimated"""
    target: Any
    """[B] what the value is fitted to"""
    log_prob_now: Any
    """[B] log-probability of the action under the present policy"""
    entropy: Any
    """[B] entropy of the present policy"""
    value: Any
    """[B] the critic's present value of the observation"""


def rows_of_columns(steps: int, columns: int, chosen: Tensor) -> Tensor:
    """The numbers of all rows of the chosen columns, in time order, where there are `steps` times `columns` rows."""
    return (torch.arange(steps, device=chosen.device)[:, None] * columns + chosen).flatten()
