"""The rows that a loss takes from a replay buffer, and how a network encodes their observations.

Rule: losses see what an encoder makes of observations, so they need not know of images or memory. Where one network's
encoder stands for that of another, as in SAC, `encoded` is called once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from millrace.protocol.policy.encoder import Encoder, RecurrentInput


class Sequences(NamedTuple):
    """How B rows lie in C sequences of T rows, with T rows before each: `SequenceSample` as a recurrent core takes it."""

    before: RecurrentInput
    """of the T rows before"""
    keep_state: Tensor
    """[T + 1, C] of the sequence: 0 where an episode begins, else 1"""
    advances: Tensor
    """[T + 1, C] bool: False where the row leaves the state as it is"""
    rows: Tensor
    """[B] where they are among the T · C of the sequences"""
    next_rows: Tensor
    """[B] where the observations that followed are among the (T + 1) · C"""

    def outputs(self, encode: Encoder, x: Tensor, images: Sequence[Tensor]) -> Tensor:
        """The core's outputs [(T + 1) · C, H] for x and images of [(2 T + 1) · C, …]. No gradient passes the rows before."""
        warm_up = self.before.keep_state.numel()
        with torch.no_grad():
            _, state = encode.advance(x[:warm_up], [image[:warm_up] for image in images], self.before)
        own = RecurrentInput(state, self.keep_state, advances=self.advances)
        h, _ = encode.advance(x[warm_up:], [image[warm_up:] for image in images], own)
        return h


class Transitions(NamedTuple):
    """B transitions of n steps, or of fewer where an episode ends, as a loss takes them.

    With a recurrent core, x and images are those of all rows in `sequences`, until they are encoded.
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
    """[B] γᵏ, or 0 if the task has terminated"""
    next_x: Tensor
    """[B, D] features of the observations k steps later"""
    next_images: tuple[Tensor, ...]
    """[B, *leaf] uint8 each"""
    next_mask: Tensor | None
    """[B, choices] the actions that are allowed then; None without action masks"""
    weight: Tensor
    """[B] of each row in the loss; 1 unless replay is prioritized"""
    target_x: Tensor
    """[B, D] next_x for the target network; encoded, by that network's encoder"""
    sequences: Sequences | None = None
    """with a recurrent core, how the rows lie in sequences"""

    def encoded(self, encode: Encoder) -> Transitions:
        """With the outputs of an encoder [B, H] in the place of features and images. Those of next_x have no gradient."""
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
        """The outputs [B, H] of an encoder for the observations k steps later, without a gradient."""
        if self.sequences is not None:
            return self.sequences.outputs(encode, self.x, self.images)[self.sequences.next_rows]
        return encode(self.next_x, self.next_images)
