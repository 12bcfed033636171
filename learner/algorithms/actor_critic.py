"""The base class of PPO, A2C, IMPALA, REINFORCE and your own actor-critics: everything about an update except the loss.

Before each gradient step, an update checks the loss, the logged numbers and the gradient, and raises if one of them is not
finite. The training loop checks the weights after the update, and undoes the whole update if they are not finite. With one
torch thread on a CPU, the same batches give the same bits, even after `load_state_dict`. This module uses no sockets, no
files and no clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from msgspec.structs import replace
from torch import Tensor

from millrace.learner.algorithms import losses
from millrace.learner.algorithms.algorithm import Algorithm
from millrace.learner.algorithms.bodies.networks import ActorCriticNetwork
from millrace.learner.algorithms.gradient_descent import GradientDescent, UpdateMetrics, clip_norm, scheduled
from millrace.learner.algorithms.kernels.optimizer_step import make_optimizer, take_step
from millrace.learner.algorithms.kernels.trained_networks import actor_critic_network
from millrace.learner.algorithms.minibatches import (
    ColumnObservations,
    LossInput,
    Minibatch,
    Observations,
    UpdateRows,
    WholeBatch,
    flat_tensor,
)
from millrace.learner.algorithms.returns import EpisodeEnds, gae
from millrace.learner.config.hyperparameters import ActorCriticConfig, AlgorithmConfig, PolicyGradientConfig, RecurrentConfig
from millrace.protocol.arrays import Array, Bools, Floats
from millrace.protocol.errors import RunError, UsageError
from millrace.protocol.policy.encoder import RecurrentInput
from millrace.protocol.random_streams import Purpose, torch_seed
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec

Pulse = Callable[[], None]

MAX_LOG_STD = 80.0  # numpy's normal samples stay below 14, and 14 · e⁸⁰ is still finite in float32


class Estimates(NamedTuple):
    """Targets and advantages of a batch, computed before the losses. Arrays are [T, ΣN] unless noted."""

    advantage: Floats
    target: Floats  # the critic is trained to predict these
    values: Floats  # [T+1, ΣN] the values from which advantages and targets were computed
    used: Bools  # True for the rows to learn from, which must all be valid
    metrics: UpdateMetrics  # metrics about the estimate, named without the prefix "train/"


class ActorCritic(GradientDescent):
    """An actor and a critic, and the update that trains them: epochs of gradient steps on minibatches of a batch.

    A subclass defines `loss`, with ordinary torch operations, unless its loss is the policy gradient with a squared value
    loss. Advantages are generalized advantage estimates (GAE); a subclass that needs other advantages defines `estimate`. If
    your subclass has state of its own that an update changes, save this state in `other_state` and load it in
    `load_other_state`.

    `Config` is the class of the settings, and `self.config` holds their values. The class must have the settings of
    `ActorCriticConfig`, unless the subclass overrides the methods that use them (`n_epochs`, `minibatch_count`,
    `standardizes_advantages`, `estimate`).
    """

    Config: ClassVar[type[AlgorithmConfig]] = ActorCriticConfig  # see `Algorithm`
    net: ActorCriticNetwork
    estimates_each_epoch: ClassVar[bool] = False  # True: `estimate` is called before each epoch, with the newest weights

    @staticmethod
    def policy_spec(config: PolicyGradientConfig, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """An actor and a critic, for every space that millrace supports."""
        spec = replace(Algorithm.policy_spec(config, observation, action), shared_net=config.shared_net)
        if isinstance(config, RecurrentConfig):
            spec = replace(spec, core=config.core, core_size=config.core_size)
        return spec

    def __init__(
        self, config: PolicyGradientConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu"
    ) -> None:
        super().__init__(config, policy, total_steps=total_steps)
        self.net = actor_critic_network(policy, device, seed)
        self.seed = seed
        self.ent_coef: float = config.ent_coef  # the value in this update, which follows the schedule
        if policy.action.numbers:
            self.net.parameters["actor.log_std"].detach().fill_(config.log_std_init)
        self.generator = torch.Generator().manual_seed(torch_seed(seed, Purpose.SHUFFLES))
        self.tensors = {"parameters": self.net.flat}
        optimizer = make_optimizer(config.optimizer, self.net.flat, eps=1e-5)  # the ε that Stable-Baselines3 uses
        self.optimizers = {"optimizer": optimizer}

    # ---------------------------------------------------------------- what an algorithm defines

    def estimate(self, batch: Batch, observations: Observations, reward: Floats, pulse: Pulse) -> Estimates:
        """Generalized advantage estimates A, and the targets A + V. `reward` [T, ΣN] is scaled if the settings say so."""
        values = self.values(observations, pulse)
        advantage = gae(reward, values, EpisodeEnds.of(batch), self.config.gamma, self.config.gae_lambda)
        return Estimates(advantage, advantage + values[:-1], values, batch.valid, {})

    def loss(self, rows: LossInput) -> tuple[Tensor, Mapping[str, Tensor | float]]:
        """The loss of a minibatch, as a 0-dimensional tensor, and the numbers to log, by name. All rows are valid.

        L = −E[A log π(a)] + vf_coef E[(V − target)²] − ent_coef E[H(π)]
        """
        policy_loss = losses.policy_gradient(rows.log_prob_now, rows.advantage)
        value_loss = losses.value_loss(rows.value, rows.target)
        entropy_loss = losses.entropy_loss(rows.entropy)
        return policy_loss + self.vf_coef * value_loss + self.ent_coef * entropy_loss, {
            "policy_gradient_loss": policy_loss,
            "value_loss": value_loss,
            "entropy_loss": entropy_loss,
        }

    def set_schedules(self) -> None:
        """Set the learning rate and the entropy coefficient of this update."""
        super().set_schedules()
        self.ent_coef = scheduled(self.config.ent_coef, self.config.ent_coef_schedule, self.remaining())

    @property
    def vf_coef(self) -> float:
        """The weight of the value loss."""
        coefficient: float = self.config.vf_coef
        return coefficient

    @property
    def n_epochs(self) -> int:
        """How many times an update uses each row."""
        count: int = self.config.n_epochs
        return count

    def minibatch_count(self, rows: int) -> int:
        """Number of minibatches, of nearly equal size, in an epoch of `rows` rows."""
        batch_size: int = self.config.batch_size
        return math.ceil(rows / batch_size)

    def standardizes_advantages(self) -> bool:
        """Whether to scale the advantages of each minibatch to mean 0 and standard deviation 1. Never True after cloning.

        A cloned policy acts well from the start, so its advantages are little more than the critic's small errors. Scaled to
        a standard deviation of 1, these errors would change the policy as much as advantages that distinguish good actions
        from bad ones.
        """
        normalize: bool = self.config.normalize_advantage
        return normalize and not self.pretraining_steps

    def stops(self, metrics: UpdateMetrics) -> bool:
        """Whether a minibatch with these metrics ends the update, before its gradient step is taken."""
        return False

    # ---------------------------------------------------------------- an update

    def update(self, batch: Batch, pulse: Pulse) -> UpdateMetrics:
        """Learn from a batch, calling `pulse` between minibatches. Returns metrics, named as in Stable-Baselines3.

        Raises `RunError` before a step whose loss, logged numbers or gradient norm are not finite. Also raises it after the
        last step if the new weights could give actions that are not finite.
        """
        if not batch.valid.any():  # with several agents, all seats may be waiting, so there is nothing to learn
            self.env_steps += batch.env_steps
            return {}
        self.set_schedules()
        rows = self.rows(batch)
        self.count(batch)
        reward = self.scaled(batch.reward)
        estimates: list[Estimates] = []
        epochs: list[list[UpdateMetrics]] = []
        ended = False
        while len(epochs) < self.n_epochs and not ended:
            if not estimates or self.estimates_each_epoch:
                estimates.append(estimate := self.estimate(batch, rows.observations, reward, pulse))
                count = self.minibatch_count(int(np.count_nonzero(estimate.used)))
                minibatches = rows.epochs(estimate.advantage, estimate.target, estimate.used, count, self.generator)
            epochs.append([])
            for minibatch in next(minibatches):
                measured, ended = self.step(*minibatch)
                epochs[-1].append(measured)
                pulse()
                if ended:
                    break
        _check_spread_of_actions(self.net, self.version)
        self.count_update(batch, len(epochs))
        return self.metrics(epochs, estimates)

    def step(self, *minibatch: Minibatch) -> tuple[UpdateMetrics, bool]:
        """Take one gradient step on a minibatch, unless its metrics end the update. Returns them and whether they do.

        `minibatch` holds the parts that this process learns from: all rows in one part, unless the run has shards.

        Scales the gradient by min(1, max_grad_norm / norm), and steps torch's optimizer. Raises `RunError` before the step
        if the loss, the logged numbers or the gradient's norm are not finite.
        """
        metrics = self.gradient(minibatch)
        clip_norm(self.net.flat, metrics["grad_norm"], self.config.max_grad_norm)
        ends = self.stops(metrics)
        if not ends:
            take_step(self.optimizers["optimizer"])
        return metrics, ends

    def gradient(self, minibatch: Sequence[Minibatch]) -> UpdateMetrics:
        """Write a minibatch's gradient to `net.flat.grad`. Returns the loss, logged numbers and the gradient's norm."""
        (rows,) = minibatch
        loss, numbers = self.checked_loss(rows)
        return self.differentiate(loss, self.optimizers["optimizer"], {**numbers, "loss": loss})

    def checked_loss(self, rows: Minibatch) -> tuple[Tensor, Mapping[str, Tensor | float]]:
        """The loss of these rows, and the numbers to log. Raises `UsageError` if `loss` returns anything else."""
        return _checked(self.loss(self.evaluate(rows)), type(self).__name__)

    def evaluate(self, minibatch: Minibatch) -> LossInput:
        """Run the network on a minibatch. Returns the minibatch's rows together with the network's outputs for them.

        The logits of actions that are not allowed become -1e30. Box actions have a normal distribution that is not clipped.
        For a small network on the CPU, numpy computes the same outputs (`kernels/trained_networks.py`).
        """
        action = minibatch.action
        outputs = self.net.evaluate(minibatch.features, minibatch.images, minibatch.recurrent, action, minibatch.mask)
        advantage = raw = minibatch.advantage
        if self.standardizes_advantages():
            advantage = losses.standardized(raw) if minibatch.standardized is None else minibatch.standardized
        return LossInput(action, minibatch.log_prob, advantage, raw, minibatch.target, *outputs)

    def count_update(self, batch: Batch, epochs: int) -> None:
        """Count an update of `epochs` epochs and its env steps. The new observation statistics take effect now."""
        self.env_steps += batch.env_steps
        self.version += 1
        # Workers acted with the statistics that were published before this batch. The losses must normalize observations
        # with the same statistics, because otherwise the probability ratio would not be 1 for an unchanged policy. The new
        # statistics therefore take effect only after the update. They are published together with the weights.
        self.statistics = self.normalizer.buffers()

    def metrics(self, epochs: Sequence[Sequence[UpdateMetrics]], estimates: Sequence[Estimates]) -> UpdateMetrics:
        """The metrics of an update: means over its gradient steps and over its estimates, and scheduled values."""
        metrics = self.means(step for epoch in epochs for step in epoch)
        metrics["train/learning_rate"] = self.learning_rate
        metrics["train/n_updates"] = float(self.version)
        if self.config.ent_coef_schedule != "constant":
            metrics["train/ent_coef"] = self.ent_coef
        log_std = self.net.parameters.get("actor.log_std")
        if log_std is not None:
            metrics["train/std"] = log_std.detach().exp().mean().item()
        return metrics | self.means({"explained_variance": _explained_variance(each), **each.metrics} for each in estimates)

    # ---------------------------------------------------------------- the network's outputs for a batch

    def rows(self, batch: Batch) -> UpdateRows:
        """The rows of a batch, in the form in which the update uses them."""
        return WholeBatch(batch, self.observations(batch))

    def observations(self, batch: Batch) -> ColumnObservations:
        """The observations of a batch, normalized exactly as they were on the workers."""
        x, images = self.normalizer.inputs(batch.obs, self.statistics)
        recurrent = None
        if self.policy.core is not None:
            recurrent = _recurrent_input(batch, self.tensor)
        features, *pixels = (flat_tensor(array, self.net.flat.device) for array in (x, *images))
        return ColumnObservations(x.shape[:2], features, tuple(pixels), recurrent)

    def values(self, observations: Observations, pulse: Pulse) -> Floats:
        """V(obs) [T+1, ΣN] with the current weights."""
        return observations.evaluate(observations.shape[0], lambda inputs, _: self.net.value(*inputs), pulse)

    # ---------------------------------------------------------------- weights and checkpoints

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the acting parameters [P] and of the buffers, as `millrace.protocol.policy.layout` lays them out."""
        return self.net.flat[: self.net.acting_size].cpu().numpy().copy(), self.normalizer.published(self.statistics).copy()

    def other_state(self) -> dict[str, Any]:
        """See `GradientDescent`."""
        return super().other_state() | {"generator": self.generator.get_state()}

    def load_other_state(self, state: dict[str, Any]) -> None:
        """See `GradientDescent`."""
        super().load_other_state(state)
        self.generator.set_state(state["generator"])


def _recurrent_input(batch: Batch, tensor: Callable[[Array], Tensor]) -> RecurrentInput:
    """The recurrent states with which the rollouts began, and the steps at which a state is reset or left unchanged.

    The state is reset after a step that resets the env copy. A row in which a seat waits leaves that seat's state unchanged.
    """
    first = np.zeros_like(batch.valid[:1])
    advances = None if batch.resets is None else tensor(np.concatenate([batch.valid, first]))
    keep_state = ~np.concatenate([first, batch.begins])
    return RecurrentInput(tensor(batch.state), tensor(keep_state.astype(np.float32)), advances=advances)


def _checked(returned: Any, algorithm: str) -> tuple[Tensor, Mapping[str, Tensor | float]]:
    """The value that `loss` returned. Raises `UsageError` unless it is a pair of a loss and numbers to log."""
    match returned:
        case (Tensor() as loss, Mapping() as numbers) if loss.dim() == 0 and loss.requires_grad:
            return loss, numbers
    raise UsageError(
        f"{algorithm}.loss: expected a 0-dimensional tensor that depends on log_prob_now, entropy or value of its "
        "rows, and a dict of numbers to log"
    )


def _check_spread_of_actions(net: ActorCriticNetwork, version: int) -> None:
    """Raise `RunError` if Box actions could overflow.

    Without this check, workers would send actions that are not finite, and the learner would refuse one worker after
    another.
    """
    log_std = net.parameters.get("actor.log_std")
    if log_std is not None and (largest := log_std.detach().max().item()) > MAX_LOG_STD:
        raise RunError(
            f"learner: update {version}: logarithm of the standard deviation of actions: expected at most "
            f"{MAX_LOG_STD:g}, got {largest:.3g}; try a lower ent_coef, or a lower learning_rate"
        )


def _explained_variance(estimates: Estimates) -> float:
    used = estimates.used
    return losses.explained_variance(estimates.values[:-1][used], estimates.target[used])
