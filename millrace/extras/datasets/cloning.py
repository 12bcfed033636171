"""Cloning: before its first rollouts, a policy learns to imitate demonstrations, and its critic to predict their returns.

    L = −E[log π(a|o)] + vf_coef · E[(V(o) − G)²]     (SAC and TD3: without the critic)
    G = Σ γⁱ r over the rest of the episode, + γᵏ V(its last observation) if it was truncated

Rule: a gradient step depends only on the demonstrations and on the algorithm's saved state, which counts the steps taken so
    far. Interrupted cloning therefore continues bit for bit. For the same reason, an epoch's order of rows is sampled from
    the seed and the epoch's number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

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

BATCH_SIZE = 64  # rows in a minibatch; with a larger size, which updates often use, cloning would need more epochs
LEARNING_RATE = 1e-3  # updates often use a lower rate, to change little; with that rate, cloning would need more epochs


def clone(algorithm: Algorithm, episodes: Iterable[Batch], pulse: Callable[[], None]) -> dict[str, float]:
    """Clone these episodes for `clone_epochs`. A resumed run doesn't repeat the gradient steps that were already taken.

    `episodes`: each one is a batch of one column. `pulse`, which may save the state, is called after each gradient step.
    Returns metrics over all steps of the episodes: `clone/loss`, and how close the policy's most probable actions are to the
    demonstrated ones, as `clone/accuracy` (choices and bits), `clone/mean_absolute_error` (numbers), or both. In a resumed
    run whose `prior_steps` have already changed the cloned policy, this does nothing and returns no metrics.

    Raises `UsageError` if the algorithm derives from neither `ActorCritic` nor `Continuous`, and `RunError`, before the
    gradient step, if a loss or a gradient isn't finite.
    """
    if not isinstance(algorithm, ActorCritic | Continuous):
        raise UsageError(f"clone_epochs: expected an ActorCritic or a Continuous to clone, got {type(algorithm).__name__}")
    if isinstance(algorithm, Continuous) and algorithm.policy.needs_torch:
        name = type(algorithm).__name__.lower()
        raise UsageError(f"clone_epochs: {name} clones no encoder of images, which its critics train; take --algo ppo")
    if isinstance(algorithm, Continuous) and algorithm.prior_gradient_steps:
        return {}
    config = algorithm.config
    rows = Demonstrations.of(episodes, algorithm.scaled, config.gamma)
    size = len(rows.at)
    count = math.ceil(size / BATCH_SIZE)
    if isinstance(algorithm, ActorCritic) and not algorithm.pretraining_steps:
        center_critic(algorithm, _parts(rows, count))
    optimizer = algorithm.optimizers["optimizer" if isinstance(algorithm, ActorCritic) else "actor_optimizer"]
    for epoch in range(algorithm.pretraining_steps // count, config.clone_epochs):
        order = generator(algorithm.seed, Purpose.CLONING, epoch).permutation(size)
        for some in np.array_split(order, count)[algorithm.pretraining_steps % count :]:
            loss, _ = cloning_loss(algorithm, rows.select(some))
            algorithm.differentiate(loss, optimizer, {"clone/loss": loss})
            optimizer.param_groups[0]["lr"] = LEARNING_RATE
            take_step(optimizer)
            if isinstance(algorithm, Continuous):
                algorithm.after_step("actor")
            algorithm.pretraining_steps += 1
            pulse()
    if isinstance(algorithm, Continuous):
        algorithm.begin_with_actor()
    return _measured(algorithm, _parts(rows, count))


def center_critic(algorithm: ActorCritic, parts: Sequence[Demonstrations]) -> None:
    """Add a number δ to all values of the critic, so that its mean error over these steps is 0: E[V(o) + δ] = E[G + γᵏ δ].

    Otherwise the critic would need many gradient steps to reach the level of the returns. These would saturate its units,
    which would then learn little in later updates. If γ is 1 and no episode was terminated, there is no such δ, and nothing
    changes.
    """
    error = weight = 0.0
    for rows in parts:
        with torch.no_grad():
            value = algorithm.net.value(*_inputs(algorithm, rows))
        error += float((_returns(algorithm, rows) - value).sum())
        weight += float((1 - rows.discount).sum())
    if weight:
        algorithm.net.parameters["critic.out.bias"].detach().add_(error / weight)


def cloning_loss(algorithm: ActorCritic | Continuous, rows: Demonstrations) -> tuple[Tensor, Tensor]:
    """The loss, a 0-dimensional tensor, and the parameters [B, P] of the action distribution."""
    inputs = _inputs(algorithm, rows)
    action = algorithm.tensor(rows.action)
    if isinstance(algorithm, Continuous):
        params = algorithm.net.params(*inputs)
        return -policy_log_prob(algorithm.policy, params, action).mean(), params
    params, value = algorithm.net.forward(*inputs)
    log_prob = policy_log_prob(algorithm.policy, params, action)
    return algorithm.vf_coef * losses.value_loss(value, _returns(algorithm, rows)) - log_prob.mean(), params


def _inputs(algorithm: ActorCritic | Continuous, rows: Demonstrations) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Features [B, D] and images [B, *leaf] of the observations of these steps."""
    return algorithm.inputs(rows.obs(rows.at))


def _returns(algorithm: ActorCritic, rows: Demonstrations) -> Tensor:
    """G [B] with the current critic, without a gradient."""
    with torch.no_grad():
        last_value = algorithm.net.value(*algorithm.inputs(rows.obs(rows.last)))
    return algorithm.tensor(rows.returns) + algorithm.tensor(rows.discount) * last_value


def _parts(rows: Demonstrations, count: int) -> list[Demonstrations]:
    """The steps in `count` parts of nearly equal size, which share the arrays of observations."""
    return [rows.select(some) for some in np.array_split(np.arange(len(rows.at)), count)]


def _measured(algorithm: ActorCritic | Continuous, parts: Sequence[Demonstrations]) -> dict[str, float]:
    """The metrics of cloning, over all steps of these parts."""
    size = sum(len(rows.at) for rows in parts)
    with torch.no_grad():
        sums = [_sums(algorithm, rows) for rows in parts]
    loss, wrong, error = (float(total) / size for total in np.sum(sums, 0))
    action = algorithm.policy.action
    metrics = {"clone/loss": loss}
    if action.choices or action.bits:
        metrics["clone/accuracy"] = 1 - wrong
    if action.numbers:
        metrics["clone/mean_absolute_error"] = error
    return metrics


def _sums(algorithm: ActorCritic | Continuous, rows: Demonstrations) -> tuple[float, float, float]:
    """Three sums over these steps: the loss; how often the most probable action has a wrong choice or bit; and the mean
    absolute error of the numbers in the most probable action.
    """
    policy = algorithm.policy
    loss, params = cloning_loss(algorithm, rows)
    error = abs(distribution(policy).mode(params.cpu().numpy()) - rows.action).reshape(len(rows.at), -1)
    numbers = error[:, error.shape[1] - policy.action.numbers :]
    wrong = error[:, : error.shape[1] - policy.action.numbers].any(1)
    return loss.item() * len(rows.at), float(wrong.sum()), float(numbers.mean(1).sum()) if numbers.size else 0.0
