"""DQN (Mnih et al. 2015), with double, dueling, n-step and prioritized variants. Settings: `learner.config.hyperparameters`.

No sockets, no files, no clock; seeded. An update adds a batch to the replay buffer and makes a fixed number of gradient
steps, so how often a transition is used is a setting and does not depend on speed. The buffer holds raw observations. They
are normalized when they are drawn, with the current statistics. ε falls with the number of env steps used and is published
with the weights. With one torch thread on a CPU the same batches give the same bits, also after `load_state_dict`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
import torch

from learner.algorithms.algorithm import Algorithm
from learner.algorithms.kernels import loss_gradients
from learner.algorithms.kernels.action_values import action_values
from learner.algorithms.kernels.optimizer_step import avoid_compiler_import, state_of, take_step
from learner.algorithms.normalization import ObservationNormalizer
from learner.algorithms.replay.mixed_replay import MixedReplay
from learner.algorithms.replay.replay_buffer import Sample
from learner.algorithms.updates import check_finite, scheduled
from learner.config.hyperparameters import DQNConfig
from protocol.arrays import Array, Floats
from protocol.errors import UsageError
from protocol.policy.features import features, normalize
from protocol.policy.networks import QNetwork
from protocol.rollout import Batch
from protocol.specs import ActionSpec, Leaf, PolicySpec


class StepMetrics(NamedTuple):
    """The metrics of one gradient step, measured before it changed the weights."""

    loss: float
    q_mean: float  # mean over the actions that were taken
    grad_norm: float  # before clipping


ADVICE = "a lower learning_rate, or normalize_observations"
LOSSES = {"huber": loss_gradients.huber_loss, "squared": loss_gradients.squared_loss}


def exploration_rate(config: DQNConfig, env_steps: int) -> float:
    """ε after `env_steps` env steps, summed over all env copies."""
    start, end, done = config.epsilon_start, config.epsilon_end, env_steps / config.epsilon_steps
    return end + (start - end) * (max(0.0, 1 - done) if config.epsilon_schedule == "linear" else math.exp(-done))


class DQN(Algorithm):
    """The Q-network, the target network, their optimizer and the replay buffer."""

    Config = DQNConfig

    @staticmethod
    def policy_spec(config: DQNConfig, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """Action values for any supported observation. Raises `UsageError` unless the action space is Discrete."""
        if action.kind != "discrete":
            shape = list(action.shape)
            raise UsageError(f"dqn: expected an action space Discrete(n), got {action.kind}{shape}; take --algo ppo for it")
        return PolicySpec(
            observation,
            action,
            net=config.net,
            activation=config.activation,
            normalize_observations=config.normalize_observations,
            head="q",
            dueling=config.dueling,
        )

    def __init__(self, config: DQNConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu") -> None:
        self.config = config
        self.policy = policy
        self.replay = MixedReplay(
            policy.observation,
            size=config.replay_size,
            n_step=config.n_step,
            gamma=config.gamma,
            seed=seed,
            alpha=config.priority_alpha if config.replay == "prioritized" else None,
            prior_share=config.prior_share,
        )
        self.net = QNetwork(policy, device, seed=seed)
        self.target = QNetwork(policy, device, seed=seed)
        self._values, self._target_values = (action_values(net, config.batch_size) for net in (self.net, self.target))
        self.env_steps = 0  # valid rows used so far; schedules depend on it
        self.version = 0  # updates made
        self.gradient_steps = 0  # what Stable-Baselines3 calls n_updates
        self._total_steps = total_steps
        avoid_compiler_import()
        optimizer = torch.optim.Adam if config.optimizer == "adam" else torch.optim.AdamW
        self._optimizer = optimizer([self.net.flat], lr=config.learning_rate, amsgrad=config.amsgrad, fused=True)
        # The buffers of a Q policy also hold ε, which is not the normalizer's: so it gets the policy with the other head.
        self._normalizer = ObservationNormalizer(msgspec.structs.replace(policy, head="actor_critic"))
        self._statistics = self._normalizer.buffers()
        self._remembered: dict[str, Any] = {}

    def update(self, batch: Batch, pulse: Callable[[], None]) -> dict[str, float]:
        """Add a batch to the replay buffer and learn from it, calling `pulse` between gradient steps. Returns metrics.

        Raises `RunError` when a loss or a gradient is not finite, before it reaches the weights.
        """
        config = self.config
        done = min(
            1.0, self.env_steps / self._total_steps
        )  # fraction of the run: 0 in the first update, below 1 in the last
        learning_rate = scheduled(config.learning_rate, config.learning_rate_schedule, 1 - done)
        self._optimizer.param_groups[0]["lr"] = learning_rate
        beta = config.priority_beta + (1 - config.priority_beta) * done
        self.replay.add(batch)
        self._normalizer.update(features(self.policy, batch.obs)[:-1], batch.valid)
        self._statistics = self._normalizer.buffers()
        self.env_steps += batch.env_steps
        self.version += 1
        measured: list[StepMetrics] = []
        if self.env_steps >= config.learning_starts and len(self.replay):
            for _ in range(config.gradient_steps):
                measured.append(self.step(self.replay.sample(config.batch_size, beta)))
                pulse()
        metrics = {
            "rollout/exploration_rate": exploration_rate(config, self.env_steps),
            "train/learning_rate": learning_rate,
            "train/n_updates": float(self.gradient_steps),
            "replay/size": float(len(self.replay)),
            "replay/bytes": float(self.replay.bytes),
        }
        if measured:
            mean = StepMetrics(*np.mean(measured, 0).tolist())
            metrics |= {f"train/{name}": number for name, number in mean._asdict().items()}
            metrics["replay/env_steps_per_gradient_step"] = batch.env_steps / len(measured)
        return metrics

    def add_prior(self, batches: Iterable[Batch], observations: int) -> None:
        """Store the rows of a dataset beside the replay buffer. They count for the observation statistics."""

        def counted() -> Iterator[Batch]:
            for batch in batches:
                self._normalizer.update(features(self.policy, batch.obs)[:-1], batch.valid)
                yield batch

        self.replay.add_prior(counted(), observations)
        self._statistics = self._normalizer.buffers()

    def learn_from_prior(self, pulse: Callable[[], None]) -> None:
        """Make `prior_steps` gradient steps on prior data alone, less those that were made."""
        for _ in range(self.config.prior_steps - self.gradient_steps):
            self.step(self.replay.sample(self.config.batch_size))
            pulse()

    @np.errstate(all="ignore")  # `check_finite` finds and names what is not finite
    def step(self, sample: Sample) -> StepMetrics:
        """One gradient step on a minibatch; then the target network and the priorities are updated."""
        values, target = self._values, self.targets(sample)
        chosen = values.chosen(*self._inputs(sample.leaves), values.to_array(sample.action))
        error = chosen - target
        loss, by_chosen = LOSSES[self.config.loss](error, values.to_array(sample.weight))
        values.backward(by_chosen)
        measured = StepMetrics(*values.numbers_and_norm(loss, chosen.sum() / len(chosen)))
        check_finite(measured._asdict(), self.version, ADVICE)
        self._clip_gradient(measured.grad_norm)
        take_step(self._optimizer)
        self.gradient_steps += 1
        self._update_target()
        self.replay.update_priorities(sample.slots, error if isinstance(error, np.ndarray) else error.cpu().numpy())
        return measured

    def targets(self, sample: Sample) -> Any:
        """The targets [B] of the action values:  Σ γⁱ r + γᵏ Q′(s′, a′). γᵏ is 0 if the task has terminated.

        a′ = argmax Q′(s′, ·), or argmax Q(s′, ·) if double (van Hasselt et al. 2016). Q′ is the target network. With action
        masks, a′ is the best of the actions that are allowed in s′.
        """
        inputs, values, mask = self._inputs(sample.next_leaves), self._target_values, sample.next_mask
        if self.config.double:
            with torch.no_grad():
                value = values.chosen(*inputs, self._values.best_actions(*inputs, mask))
        else:
            value = values.best_values(*inputs, mask)
        return values.to_array(sample.reward) + values.to_array(sample.discount) * value

    def _inputs(self, leaves: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Features [B, D], normalized with the current statistics, and images [B, *leaf] uint8."""
        x = features(self.policy, leaves)
        if self.policy.normalize_observations:
            x = normalize(x, *np.split(self._statistics, 2))
        return x, [array for leaf, array in zip(self.policy.observation, leaves, strict=True) if leaf.is_image]

    def _clip_gradient(self, norm: float) -> None:
        config, gradient = self.config, self.net.flat_grad
        if config.max_grad_value is not None:
            gradient.clamp_(-config.max_grad_value, config.max_grad_value)
            norm = gradient.norm().item() if config.max_grad_norm is not None else norm
        if config.max_grad_norm is not None and norm > config.max_grad_norm:
            gradient.mul_(config.max_grad_norm / norm)

    def _update_target(self) -> None:
        """Update the target network after a gradient step."""
        if self.config.target == "polyak":
            self.target.flat.lerp_(self.net.flat, self.config.tau)
        elif self.gradient_steps % self.config.target_every == 0:
            self.target.flat.copy_(self.net.flat)

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the Q-network's parameters [P] and of the buffers: the observation statistics, then ε."""
        epsilon = np.float32(exploration_rate(self.config, self.env_steps))
        return self.net.flat.cpu().numpy().copy(), np.append(self._statistics, epsilon)

    def is_finite(self) -> bool:
        """Whether all weights are finite, also those that do not act, and the observation statistics."""
        return bool(torch.isfinite(self.net.flat).all() and np.isfinite(self._statistics).all())

    def state_dict(self) -> dict[str, Any]:
        """A copy of everything that the next update depends on: tensors and plain data (`torch.load(weights_only=True)`)."""
        return self._small_state() | {
            "replay": self.replay.state_dict(),
        }

    def _small_state(self) -> dict[str, Any]:
        """The state without the replay buffer."""
        return {
            "parameters": self.net.flat.clone(),
            "target": self.target.flat.clone(),
            "optimizer": state_of(self._optimizer),
            "observations": self._normalizer.state_dict(),
            "env_steps": self.env_steps,
            "version": self.version,
            "gradient_steps": self.gradient_steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`: the next update is the one that would have followed it, bit for bit."""
        self._load_small_state(state)
        self.replay.load_state_dict(state["replay"])

    def remember(self) -> None:
        """Remember this state, for `roll_back`. Of the replay buffer, only what changes from now on is copied."""
        self._remembered = self._small_state()
        self.replay.remember()

    def roll_back(self) -> None:
        """Return to the state that was remembered last."""
        self._load_small_state(self._remembered)
        self.replay.roll_back()

    def _load_small_state(self, state: dict[str, Any]) -> None:
        self.net.flat.copy_(state["parameters"])
        self.target.flat.copy_(state["target"])
        self._optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))
        self._normalizer.load_state_dict(state["observations"])
        self._statistics = self._normalizer.buffers()
        self.env_steps, self.version = state["env_steps"], state["version"]
        self.gradient_steps = state["gradient_steps"]
