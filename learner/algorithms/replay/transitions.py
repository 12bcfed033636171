"""The rows that a replay buffer gives to a loss, and how a network encodes their observations.

Rule: losses see the encoder's outputs instead of observations, so they needn't know about images or memory. If networks
share an encoder, as in SAC, `encoded` is called once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from millrace.protocol.policy.encoder import Encoder, RecurrentInput


class Sequences(NamedTuple):
    """How the B rows of a `SequenceSample` lie in C sequences of T rows, each preceded by T rows of burn-in."""

    before: RecurrentInput
    """the recurrent core's input for the T rows of burn-in"""
    keep_state: Tensor
    """[T + 1, C] for the sequences: 0 where an episode begins, otherwise 1"""
    advances: Tensor
    """[T + 1, C] bool: False where a row leaves the core's state unchanged"""
    rows: Tensor
    """[B] the indices of the rows among the T · C rows of the sequences"""
    next_rows: Tensor
    """[B] the indices, among the (T + 1) · C observations of the sequences, of the observations k steps later"""

    def outputs(self, encode: Encoder, x: Tensor, images: Sequence[Tensor]) -> Tensor:
        """The core's outputs [(T + 1) · C, H] for x and images [(2 T + 1) · C, …]. The burn-in gets no gradient."""
        warm_up = self.before.keep_state.numel()
        with torch.no_grad():
            _, state = encode.advance(x[:warm_up], [image[:warm_up] for image in images], self.before)
        own = RecurrentInput(state, self.keep_state, advances=self.advances)
        h, _ = encode.advance(x[warm_up:], [image[warm_up:] for image in images], own)
        return h


class Transitions(NamedTuple):
    """The input of a loss: B transitions of k steps, where k is `n_step`, or less where an episode ends.

    With a recurrent core, x and images hold all rows of the `sequences` until they are encoded.
    """

    x: Tensor
    """[B, D] features of the observations, normalized"""
    images: tuple[Tensor, ...]
    """[B, *leaf] uint8 each"""
    action: Tensor
    """[B] int64, or [B, D′] in [-1, 1]"""
    reward: Tensor
    """[B] Σ γⁱ r; with `normalize_rewards`, divided by the standard deviation of returns and clipped to ±10"""
    discount: Tensor
    """[B] γᵏ, or 0 if the episode terminated"""
    next_x: Tensor
    """[B, D] features of the observations k steps later"""
    next_images: tuple[Tensor, ...]
    """[B, *leaf] uint8 each"""
    next_mask: Tensor | None
    """[B, choices] bool, True for the actions allowed k steps later; None without action masks"""
    weight: Tensor
    """[B] the weight of each row in the loss; 1 unless replay is prioritized"""
    target_x: Tensor
    """[B, D] `next_x` for the target network, which encodes it with its own encoder"""
    sequences: Sequences | None = None
    """how the rows lie in sequences; None without a recurrent core, and after the rows were encoded"""

    def encoded(self, encode: Encoder) -> Transitions:
        """A copy with an encoder's outputs [B, H] in place of features and images. Outputs for `next_x` have no gradient."""
        if self.sequences is not None:
            h = self.sequences.outputs(encode, self.x, self.images)
            x = h[self.sequences.rows]
            next_x = h.detach()[self.sequences.next_rows]
        else:
            x = encode(self.x, self.images)
            next_x = self.encoded_next(encode)
        return self._replace(x=x, images=(), next_x=next_x, next_images=(), target_x=next_x, sequences=None)

    @torch.no_grad()
    def encoded_next(self, encode: Encoder) -> Tensor:
        """An encoder's outputs [B, H] for the observations k steps later, without a gradient."""
        if self.sequences is not None:
            return self.sequences.outputs(encode, self.x, self.images)[self.sequences.next_rows]
        return encode(self.next_x, self.next_images)
