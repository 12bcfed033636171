"""One gradient step of an actor-critic, and how far its gradient may be from that of another computation.

The tolerance follows from the roundings of the pass, the loss and its derivative, and the errors of advantages and targets.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from millrace.learner.algorithms.actor_critic import ActorCritic
from millrace.learner.algorithms.minibatches import LossInput, Minibatch
from millrace.protocol.arrays import Array
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec
from tests.support.numbers.batches import no_pulse
from tests.support.numbers.rounding import SAMPLES, assert_within, flat_gradient, in_double, in_float64, sampled


class Errors(NamedTuple):
    """The largest errors of the advantages, not standardized, and of the targets of a step."""

    advantage: float = 0.0
    target: float = 0.0


NO_ERRORS = Errors()


class Step(NamedTuple):
    """The gradient of a step by all parameters, and its tolerance, [P] each; and the metrics of its update."""

    gradient: Array
    tolerance: Array
    metrics: dict[str, float]

    def assert_is(self, gradient: Array, parameters: slice = slice(None)) -> None:
        """Assert that this is the gradient of the step, except for rounding, and that it is not 0."""
        assert np.linalg.norm(gradient[parameters]) > 0.01
        assert_within(self.gradient[parameters], gradient[parameters], self.tolerance[parameters])


def only_step(algorithm: ActorCritic, batch: Batch, errors: Errors = NO_ERRORS) -> Step:
    """Make an update of one gradient step, which must not be clipped."""
    tolerances: list[Array] = []
    evaluate = algorithm.evaluate

    def recorded_evaluate(minibatch: Minibatch) -> LossInput:
        algorithm.evaluate = evaluate  # type: ignore[method-assign]
        tolerances.append(gradient_tolerance(algorithm, minibatch, errors))
        return evaluate(minibatch)

    algorithm.evaluate = recorded_evaluate  # type: ignore[method-assign]
    metrics = algorithm.update(batch, no_pulse)
    (tolerance,) = tolerances
    assert metrics["train/n_updates"] == 1
    assert metrics["train/grad_norm"] < algorithm.config.max_grad_norm
    return Step(algorithm.net.flat_grad.numpy().copy(), tolerance, metrics)


def watched(algorithm: ActorCritic) -> list[Minibatch]:
    """The minibatches of each step that the algorithm makes from now on."""
    minibatches: list[Minibatch] = []
    step = algorithm.step

    def recorded_step(*minibatch: Minibatch) -> tuple[dict[str, float], bool]:
        minibatches.extend(minibatch)
        return step(*minibatch)

    algorithm.step = recorded_step  # type: ignore[method-assign]
    return minibatches


def gradient_tolerance(algorithm: ActorCritic, minibatch: Minibatch, errors: Errors = NO_ERRORS) -> Array:
    """How far two float32 gradients [P] of the loss of a minibatch of B rows may differ.

    The errors of advantages and targets may be alike in all rows, for instance those of a rounded discount: then the square
    of their sum is up to B times the sum of their squares.
    """
    exact, rows = in_float64(algorithm.net), Minibatch(*map(in_double, minibatch))
    generator, deviations = torch.Generator().manual_seed(0), iter([0.0, *[math.sqrt(len(rows.action))] * SAMPLES])

    def gradient() -> list[Tensor]:
        deviation = next(deviations)  # the first call is exact
        advantage, target = (
            each + deviation * error * torch.randn(len(each), dtype=torch.float64, generator=generator)
            for each, error in ((rows.advantage, errors.advantage), (rows.target, errors.target))
        )
        with patch.object(algorithm, "net", exact):
            loss, _ = algorithm.loss(algorithm.evaluate(rows._replace(advantage=advantage, target=target)))
        return [flat_gradient(loss, exact)]

    (found,) = sampled(gradient)
    return found.tolerance


class UsualRows(NamedTuple):
    """Rows of noise, and the outputs of a network for them with torch's own distributions."""

    x: Tensor  # [B, 4]
    action: Tensor  # [B, *action]
    advantage: Tensor  # [B]
    target: Tensor  # [B]
    distribution: Any
    value: Tensor  # [B]


def usual_rows(algorithm: ActorCritic, count: int = 30) -> UsualRows:
    """B = `count` rows of a policy without images and without a core."""
    generator = torch.Generator().manual_seed(0)
    x, advantage, target = (torch.randn(s, generator=generator) for s in [(count, 4), (count,), (count,)])
    params, value = algorithm.net.forward(x)
    distribution = usual_distribution(algorithm.policy, params)
    if algorithm.policy.action.kind == "discrete":
        action = torch.randint(4, (count,), generator=generator)
    else:
        action = torch.randn((count, 2), generator=generator)
    return UsualRows(x, action, advantage, target, distribution, value)


def usual_distribution(spec: PolicySpec, params: Tensor) -> Any:
    """Torch's own distribution of discrete actions, or of two numbers."""
    if spec.action.kind == "discrete":
        return torch.distributions.Categorical(logits=params)
    return torch.distributions.Independent(torch.distributions.Normal(params[:, :2], params[:, 2:].exp()), 1)
