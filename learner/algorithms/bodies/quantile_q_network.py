"""Action values as means of return quantiles (QR-DQN, Dabney et al. 2018), with or without dueling and batch normalization.

Rule: workers act with an ordinary Q-network. The value of an action is the mean of its quantiles, so it is linear in the
last hidden layer, as the quantiles are. The last layer of the acting network is therefore the mean, over the quantiles, of
this network's last layer. Batch normalization is folded into the layers (`stacked_mlps.py`).

With dueling, N quantiles and n actions need N (n + 1) outputs: for each quantile, the value of the state, then n advantages.
Without dueling, there are N n outputs: the quantiles themselves.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from millrace.learner.algorithms.bodies.autograd_leaves import named_leaves, trainable
from millrace.learner.algorithms.bodies.networks import QNetwork, initial_fields
from millrace.learner.algorithms.bodies.stacked_mlps import MLPShape, Normalized, StackedMLPs, initial, initial_statistics
from millrace.protocol.arrays import Floats
from millrace.protocol.policy.encoder import Encoder
from millrace.protocol.policy.layout import encoder_layout, named_views
from millrace.protocol.policy.malloc import keep_freed_memory
from millrace.protocol.random_streams import Purpose, torch_seed
from millrace.protocol.specs import PolicySpec


class QuantileQNetwork:
    """A network that computes N quantiles of the return for each of n actions."""

    def __init__(self, policy: PolicySpec, quantiles: int, normalized: Normalized, device: str, seed: int) -> None:
        """`policy` is the policy that workers act with. The initial parameters depend on `seed`."""
        keep_freed_memory()  # each loss allocates and frees arrays of half a megabyte
        actions = policy.action.sizes[0]
        self._quantiles = quantiles
        self._sizes = [1, actions] if policy.dueling else [actions]
        self._outputs = sum(self._sizes)
        encoder, width = encoder_layout(policy)
        shape = MLPShape(1, (width, *policy.net, quantiles * self._outputs), policy.activation == "relu", normalized)
        generator = torch.Generator().manual_seed(torch_seed(seed, Purpose.WEIGHTS))
        parts = [initial_fields(encoder, generator), initial(shape, generator)]
        sizes = [len(part) for part in parts]
        self.flat = torch.cat(parts).to(device)
        """[P] float32: all parameters, the encoder's first"""
        self.flat_grad = torch.zeros_like(self.flat)
        self.flat.grad = self.flat_grad
        self._encoder, layers = torch.split(self.flat, sizes)
        of_encoder, of_layers = torch.split(self.flat_grad, sizes)
        self.encode = Encoder(policy, named_leaves(self._encoder, of_encoder, encoder), device, seed=seed)
        self.statistics = initial_statistics(shape).to(device)
        """[S] the running statistics; empty without normalization"""
        self.body = StackedMLPs(shape, trainable(layers, of_layers), self.statistics)

    def trained(self, x: Tensor, images: Sequence[Tensor]) -> Tensor:
        """The quantiles [B, N, n] of features [B, D] and images [B, *leaf] uint8, for training the network."""
        return self._by_action(self.body.trained(self.encode(x, images)))

    def of_minibatch(self, x: Tensor, images: Sequence[Tensor]) -> Tensor:
        """Like `trained`, but for targets: without a gradient, and without moving the running statistics."""
        return self._by_action(self.body.of_minibatch(self.encode(x, images)))

    def params(self, x: Tensor, images: Sequence[Tensor] = ()) -> Tensor:
        """The action values [B, n] of features [B, D] and images [B, *leaf] uint8, as workers compute them."""
        return self.head(self.encode(x, images))

    def head(self, h: Tensor) -> Tensor:
        """Action values [B, n], the means of quantiles, for the encoder's outputs h [B, H]. Uses the running statistics."""
        return self._by_action(self.body.evaluated(h)).mean(1)

    def _by_action(self, outputs: Tensor) -> Tensor:
        """Turn outputs [1, B, N (n + 1)], or [1, B, N n] without dueling, into quantiles [B, N, n]."""
        *value, advantage = torch.split(outputs.reshape(-1, self._quantiles, self._outputs), self._sizes, -1)
        return QNetwork.action_values(advantage, *value)

    def acting_parameters(self) -> Floats:
        """A copy of the parameters [P′] that workers act with: those of a `QNetwork` with the same action values."""
        layers = self.body.folded()
        *hidden, weight, bias = named_views(layers, self.body.shape.folded().fields()).values()
        last = [of_outputs.reshape(self._quantiles, self._outputs, -1).mean(0) for of_outputs in (weight, bias)]
        means = [torch.split(of_outputs, self._sizes) for of_outputs in last]
        heads = [part for head in zip(*means, strict=True) for part in head]
        return torch.cat([part.flatten() for part in (self._encoder, *hidden, *heads)]).cpu().numpy()
