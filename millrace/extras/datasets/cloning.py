"""Cloning: before its first rollouts, a policy learns to act as demonstrations do, and its critic to predict their returns.

    L = −E[log π(a|o)] + vf_coef · E[(V(o) − G)²]     (SAC and TD3: without the critic)
    G = Σ γⁱ r over the rest of the episode, + γᵏ V(its last observation) if it was truncated

Rule: a gradient step depends on the demonstrations and on the algorithm's saved state alone, which counts the steps made. So
cloning that was interrupted goes on with the same bits. Hence the order of each epoch is drawn from the seed and its number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
import torch
from torch import Tensor

from millrace.extras.datasets.demonstrations import Demonstrations
from millrace.learner.algorithms import losses
from millrace.learner.algorithms.actor_critic import ActorCritic
from millrace.learner.algorithms.algorithm import Algorithm
from millrace.learner.algorithms.kernels.optimizer_step import take_step
from millrace.learner.algorithms.replay.continuous import Continuous
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.torch_distributions import policy_log_prob
from millrace.protocol.random_streams import Purpose, generator
from millrace.protocol.rollout import Batch

BATCH_SIZE = 64  # rows of a minibatch, if the settings have no batch_size
LEARNING_RATE = 1e-3  # that of updates is often lower, so that they change little; here it would take more epochs


def clone(algorithm: Algorithm, episodes: Iterable[Batch], pulse: Callable[[], None]) -> dict[str, float]:
    """Make those gradient steps of cloning these episodes (`clone_epochs`) that are not made yet.

    `episodes`: each a batch of one column. Calls `pulse`, which may save the state, between gradient steps. Returns the loss
    over all steps, and how near the most probable actions are: `clone/loss`, and `clone/accuracy` or
    `clone/mean_absolute_error`.

    Raises `UsageError` if the algorithm derives from neither `ActorCritic` nor `Continuous`, and `RunError` if a loss or a
    gradient is not finite, before the step.
    """
    if not isinstance(algorithm, ActorCritic | Continuous):
        raise UsageError(f"clone_epochs: expected an ActorCritic or a Continuous to clone, got {type(algorithm).__name__}")
    config = algorithm.config
    rows = Demonstrations.of(episodes, algorithm.scaled, config.gamma)
    size = len(rows.at)
    count = math.ceil(size / getattr(config, "batch_size", BATCH_SIZE))
    optimizer = algorithm.optimizers["optimizer" if isinstance(algorithm, ActorCritic) else "actor_optimizer"]
    for epoch in range(algorithm.pretraining_steps // count, config.clone_epochs):
        order = generator(algorithm.seed, Purpose.CLONING, epoch).permutation(size)
        for some in np.array_split(order, count)[algorithm.pretraining_steps % count :]:
            loss, _ = cloning_loss(algorithm, rows.select(some))
            algorithm.differentiate(loss, optimizer, {"clone/loss": loss})
            optimizer.param_groups[0]["lr"] = LEARNING_RATE
            take_step(optimizer)
            algorithm.pretraining_steps += 1
            pulse()
    if isinstance(algorithm, Continuous):
        algorithm.begin_with_actor()
    return _measured(algorithm, rows, count)


def cloning_loss(algorithm: ActorCritic | Continuous, rows: Demonstrations) -> tuple[Tensor, Tensor]:
    """The loss, a tensor of no dimension, and the params [B, P] of the action distribution."""
    inputs = algorithm.inputs(rows.obs(rows.at))
    action = algorithm.tensor(rows.action)
    if isinstance(algorithm, Continuous):
        params = algorithm.net.params(*inputs)
        return -policy_log_prob(algorithm.policy, params, action).mean(), params
    params, value = algorithm.net.forward(*inputs)
    with torch.no_grad():
        last_value = algorithm.net.value(*algorithm.inputs(rows.obs(rows.last)))
    returns = algorithm.tensor(rows.returns) + algorithm.tensor(rows.discount) * last_value
    log_prob = policy_log_prob(algorithm.policy, params, action)
    return algorithm.vf_coef * losses.value_loss(value, returns) - log_prob.mean(), params


def _measured(algorithm: ActorCritic | Continuous, rows: Demonstrations, count: int) -> dict[str, float]:
    """The metrics over all steps, computed in `count` parts."""
    size = len(rows.at)
    with torch.no_grad():
        parts = [_sums(algorithm, rows.select(some)) for some in np.array_split(np.arange(size), count)]
    loss, error = (float(total) / size for total in np.sum(parts, 0))
    if algorithm.policy.action.kind == "box":
        return {"clone/loss": loss, "clone/mean_absolute_error": error}
    return {"clone/loss": loss, "clone/accuracy": 1 - error}


def _sums(algorithm: ActorCritic | Continuous, rows: Demonstrations) -> tuple[float, float]:
    """Sums over these steps: of the loss, and of the error of the most probable action. A wrong choice counts as 1."""
    policy = algorithm.policy
    loss, params = cloning_loss(algorithm, rows)
    error = abs(distribution(policy).mode(params.cpu().numpy()) - rows.action).reshape(len(rows.at), -1)
    wrong = error.mean(1) if policy.action.kind == "box" else error.any(1)
    return loss.item() * len(rows.at), float(wrong.sum())
