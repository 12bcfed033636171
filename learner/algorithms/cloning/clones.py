"""Cloning: before its first rollouts, a policy learns to act as demonstrations do, and its critic to predict their returns.

    L = −E[log π(a|o)] + vf_coef · E[(V(o) − G)²]     (SAC and TD3: without the critic)
    G = Σ γⁱ r over the rest of the episode, + γᵏ V(its last observation) if it was truncated

Rule: a gradient step depends on the demonstrations and on the algorithm's saved state alone, which counts the steps made. So
cloning that was interrupted goes on with the same bits. Hence the order of each epoch is drawn from the seed and its number.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from millrace.learner.algorithms.cloning.demonstrations import Demonstrations
from millrace.learner.algorithms.gradient_descent import GradientDescent
from millrace.learner.algorithms.kernels.optimizer_step import take_step
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.random_streams import Purpose, generator
from millrace.protocol.rollout import Batch

BATCH_SIZE = 64  # rows of a minibatch, if the settings have no batch_size
LEARNING_RATE = 1e-3  # that of updates is often lower, so that they change little; here it would take more epochs


class Clones(GradientDescent):
    """An algorithm with a policy that can be cloned."""

    seed: int
    cloned_by: ClassVar[str] = "optimizer"
    """The optimizer of the flat tensor of parameters to which `cloning_loss` gives a gradient."""
    clone_steps = 0
    """Gradient steps of cloning so far."""

    @abstractmethod
    def cloning_loss(self, rows: Demonstrations) -> tuple[Tensor, Tensor]:
        """The loss, a tensor of no dimension, and the params [B, P] of the action distribution."""

    def clone(self, episodes: Iterable[Batch], pulse: Callable[[], None]) -> dict[str, float]:
        """See `Algorithm`: the loss over all steps, and how near the most probable actions are."""
        rows = Demonstrations.of(episodes, self.scaled, self.config.gamma)
        size = len(rows.at)
        count = math.ceil(size / getattr(self.config, "batch_size", BATCH_SIZE))
        optimizer = self.optimizers[self.cloned_by]
        for epoch in range(self.clone_steps // count, self.config.clone_epochs):
            order = generator(self.seed, Purpose.CLONING, epoch).permutation(size)
            for some in np.array_split(order, count)[self.clone_steps % count :]:
                loss, _ = self.cloning_loss(rows.select(some))
                self.differentiate(loss, optimizer, {"clone/loss": loss})
                optimizer.param_groups[0]["lr"] = LEARNING_RATE
                take_step(optimizer)
                self.clone_steps += 1
                pulse()
        with torch.no_grad():
            parts = [self._measured(rows.select(some)) for some in np.array_split(np.arange(size), count)]
        mean_loss, error = (float(total) / size for total in np.sum(parts, 0))
        box = self.policy.action.kind == "box"
        return {"clone/loss": mean_loss} | ({"clone/mean_absolute_error": error} if box else {"clone/accuracy": 1 - error})

    def _measured(self, rows: Demonstrations) -> tuple[float, float]:
        """Sums over these steps: of the loss, and of the error of the most probable action. A wrong choice counts as 1."""
        loss, params = self.cloning_loss(rows)
        error = abs(distribution(self.policy).mode(params.cpu().numpy()) - rows.action).reshape(len(rows.at), -1)
        wrong = error.mean(1) if self.policy.action.kind == "box" else error.any(1)
        return loss.item() * len(rows.at), float(wrong.sum())

    def other_state(self) -> dict[str, Any]:
        """See `GradientDescent`."""
        return super().other_state() | {"clone_steps": self.clone_steps}

    def load_other_state(self, state: dict[str, Any]) -> None:
        """See `GradientDescent`."""
        super().load_other_state(state)
        self.clone_steps = state["clone_steps"]
