"""PPO (Schulman et al. 2017); its settings stand in `learner.hyperparameters`. No sockets, no files, no clock; seeded.

One update uses a batch for `n_epochs` epochs of minibatches. Rows that are not valid never enter one. With one torch
thread on a CPU the same batches give the same bits, also after `load_state_dict`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from learner.algorithms import losses
from learner.algorithms.normalise import ObservationNormaliser, RewardScaler
from learner.algorithms.returns import gae
from learner.hyperparameters import PPOConfig
from protocol.errors import RunError
from protocol.networks import ActorCritic, log_prob_and_entropy
from protocol.policy import features, normalized
from protocol.rollout import Batch
from protocol.specs import ActionSpec, Leaf, PolicySpec

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]

VALUE_ROWS = 1024  # observations whose values are computed at once: bounds memory


class Minibatch(NamedTuple):
    """B rows of a batch."""

    x: Tensor  # [B, D] float32, normalised features
    images: tuple[Tensor, ...]  # [B, *leaf] uint8 each
    action: Tensor  # [B, *action] int64, or float32 unclipped
    log_prob: Tensor  # [B] float32, by the worker, as acted
    advantage: Tensor  # [B] float32
    target: Tensor  # [B] float32, the returns to fit values to

    def rows(self, index: Tensor) -> Minibatch:
        """Some of these rows, copied."""
        x, images, *rest = self
        return Minibatch(x[index], tuple(image[index] for image in images), *(part[index] for part in rest))


class Measured(NamedTuple):
    """What one minibatch measured, before it moved the weights."""

    policy_gradient_loss: float
    value_loss: float
    entropy_loss: float
    approx_kl: float
    clip_fraction: float
    grad_norm: float  # before it was clipped


class PPO:
    """The policy, its optimiser and their schedules."""

    @staticmethod
    def policy_spec(config: PPOConfig, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """An actor and a critic, on any of the supported spaces."""
        return PolicySpec(
            observation,
            action,
            net=config.net,
            activation=config.activation,
            normalize_observations=config.normalize_observations,
        )

    def __init__(self, config: PPOConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu") -> None:
        self.config = config
        self.policy = policy
        self.net = ActorCritic(policy, device, seed=seed)
        self.env_steps = 0  # transitions used so far: where the schedules are
        self.version = 0  # updates made
        self.epochs = 0  # epochs made: what Stable-Baselines3 calls n_updates
        self._total_steps = total_steps
        self._kl_limit = math.inf if config.target_kl is None else 1.5 * config.target_kl
        self._optimizer = torch.optim.Adam([self.net.flat], lr=config.learning_rate, eps=1e-5, fused=True)
        self._generator = torch.Generator().manual_seed(seed)
        self._normaliser = ObservationNormaliser(policy)
        self._scaler = RewardScaler(config.gamma)
        self._buffers = self._normaliser.buffers()  # as published: float32 means, standard deviations

    def update(self, batch: Batch, pulse: Callable[[], None]) -> dict[str, float]:
        """Learn from a batch, calling `pulse` between minibatches; gives the metrics, by Stable-Baselines3's names.

        Raises `RunError` when a loss or a gradient is not finite, before it reaches the weights.
        """
        if not batch.valid.any():
            return {}
        config = self.config
        left = max(0.0, 1 - self.env_steps / self._total_steps)  # 1 in the first update, and above 0 in the last
        learning_rate = config.learning_rate * (left if config.learning_rate_schedule == "linear" else 1)
        clip_range = config.clip_range * (left if config.clip_range_schedule == "linear" else 1)
        self._optimizer.param_groups[0]["lr"] = learning_rate
        raw = features(self.policy, batch.obs)  # [T+1, ΣN, D]
        rows, explained = self._rows(batch, raw, pulse)
        valid = torch.from_numpy(np.flatnonzero(batch.valid))
        epochs: list[list[Measured]] = []
        while len(epochs) < config.n_epochs and not self._too_far(epochs):
            epochs.append(self._epoch(rows, valid, clip_range, pulse))
        self.env_steps += batch.env_steps
        self.version += 1
        self.epochs += len(epochs)
        # The batch was acted on under the statistics published before it, and the losses must see the observations as
        # the worker did, else the ratio is not 1 where the policy has not moved. So the statistics change only now, to
        # be published together with the weights.
        self._normaliser.update(raw[:-1], batch.valid)
        self._buffers = self._normaliser.buffers()
        return self._metrics(epochs) | {
            "train/explained_variance": explained,
            "train/learning_rate": learning_rate,
            "train/clip_range": clip_range,
        }

    def _rows(self, batch: Batch, raw: Floats, pulse: Callable[[], None]) -> tuple[Minibatch, float]:
        """All T · ΣN rows of a batch, those that are not valid too, and how much of the returns the values explain."""
        x = normalized(raw, *np.split(self._buffers, 2)) if self.policy.normalize_observations else raw
        images = [array for leaf, array in zip(self.policy.observation, batch.obs, strict=True) if leaf.is_image]
        values = self._values(x, images, pulse)
        reward = self._scaler.scale(batch) if self.config.normalize_rewards else batch.reward
        gamma, gae_lambda = self.config.gamma, self.config.gae_lambda
        advantage = gae(reward, values, batch.terminated, batch.truncated, batch.valid, gamma, gae_lambda)
        target = advantage + values[:-1]
        rows = Minibatch(
            self._tensor(x[:-1]),
            tuple(self._tensor(image[:-1]) for image in images),
            *(self._tensor(array) for array in (batch.action, batch.log_prob, advantage, target)),
        )
        return rows, losses.explained_variance(values[:-1][batch.valid], target[batch.valid])

    def _values(self, x: Floats, images: list[Array], pulse: Callable[[], None]) -> Floats:
        """V(obs) [T+1, ΣN] of features [T+1, ΣN, D] and images [T+1, ΣN, *leaf], a piece at a time."""
        tensors = [torch.split(self._tensor(array), VALUE_ROWS) for array in (x, *images)]
        found = []
        with torch.no_grad():
            for piece, *image_pieces in zip(*tensors, strict=True):
                found.append(self.net.value(piece, image_pieces))
                pulse()
        return np.asarray(torch.cat(found).cpu().numpy()).reshape(x.shape[:2])

    def _tensor(self, array: Array) -> Tensor:
        """[T, N, …] as [T · N, …] on the device of the weights."""
        return torch.from_numpy(array.reshape(array.shape[0] * array.shape[1], *array.shape[2:])).to(self.net.flat.device)

    def _epoch(self, rows: Minibatch, valid: Tensor, clip_range: float, pulse: Callable[[], None]) -> list[Measured]:
        """Use each valid row once, in minibatches of nearly equal size."""
        found: list[Measured] = []
        shuffled = valid[torch.randperm(len(valid), generator=self._generator)].to(self.net.flat.device)
        for index in shuffled.tensor_split(math.ceil(len(valid) / self.config.batch_size)):
            found.append(self.step(rows.rows(index), clip_range))
            pulse()
            if self._too_far([found]):
                break
        return found

    def _too_far(self, epochs: list[list[Measured]]) -> bool:
        return bool(epochs) and epochs[-1][-1].approx_kl > self._kl_limit

    def step(self, rows: Minibatch, clip_range: float) -> Measured:
        """One step of Adam on a minibatch of valid rows; none if the policy moved too far already."""
        config, net = self.config, self.net
        params, value = net.forward(rows.x, rows.images)
        log_prob, entropy = log_prob_and_entropy(self.policy.action, params, rows.action)
        with torch.no_grad():
            advantage = losses.standardized(rows.advantage) if config.normalize_advantage else rows.advantage
            log_ratio = log_prob - rows.log_prob
            ratio = log_ratio.exp()
            policy_loss, by_log_prob = losses.clipped_surrogate(ratio, advantage, clip_range)
            value_loss, by_value = losses.value_loss(value, rows.target)
            entropy_loss, by_entropy = losses.entropy_loss(entropy)
            by_entropy *= config.ent_coef
            by_value *= config.vf_coef
        net.flat_grad.zero_()
        torch.autograd.backward((log_prob, entropy, value), (by_log_prob, by_entropy, by_value))
        with torch.no_grad():
            kl, clipped = losses.approx_kl(log_ratio, ratio), losses.clip_fraction(ratio, clip_range)
            numbers = (policy_loss, value_loss, entropy_loss, kl, clipped, net.flat_grad.norm())
            measured = Measured(*torch.stack(numbers).tolist())
            self._check(measured)
            if measured.grad_norm > config.max_grad_norm:
                net.flat_grad.mul_(config.max_grad_norm / measured.grad_norm)
        if measured.approx_kl <= self._kl_limit:
            self._optimizer.step()
        return measured

    def _check(self, measured: Measured) -> None:
        for name, number in measured._asdict().items():
            if not math.isfinite(number):
                raise RunError(
                    f"learner: update {self.version}: {name} expected finite, got {number}; this step was not "
                    "taken; try a lower learning_rate, or normalize_observations and normalize_rewards"
                )

    def _metrics(self, epochs: list[list[Measured]]) -> dict[str, float]:
        mean = Measured(*np.mean([measured for epoch in epochs for measured in epoch], 0).tolist())
        metrics = {f"train/{name}": number for name, number in mean._asdict().items()}
        last = epochs[-1][-1]
        weighted = self.config.ent_coef * last.entropy_loss + self.config.vf_coef * last.value_loss
        metrics["train/loss"] = last.policy_gradient_loss + weighted
        metrics["train/approx_kl"] = float(np.mean([measured.approx_kl for measured in epochs[-1]]))
        metrics["train/n_updates"] = float(self.epochs)
        log_std = self.net.parameters.get("actor.log_std")
        return metrics if log_std is None else metrics | {"train/std": log_std.detach().exp().mean().item()}

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the acting parameters [P] and of the buffers, as `protocol.policy` lays them out."""
        return self.net.flat[: self.net.acting_size].cpu().numpy().copy(), self._buffers.copy()

    def state_dict(self) -> dict[str, Any]:
        """A copy of all that the next update depends on: tensors and plain data (`torch.load(weights_only=True)`)."""
        return {
            "parameters": self.net.flat.clone(),
            "optimizer": copy.deepcopy(self._optimizer.state_dict()),
            "generator": self._generator.get_state(),
            "observations": self._normaliser.state_dict(),
            "rewards": self._scaler.state_dict(),
            "env_steps": self.env_steps,
            "version": self.version,
            "epochs": self.epochs,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there: the next update is the one that would have followed, bit for bit."""
        self.net.flat.copy_(state["parameters"])
        self._optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))
        self._generator.set_state(state["generator"])
        self._normaliser.load_state_dict(state["observations"])
        self._scaler.load_state_dict(state["rewards"])
        self._buffers = self._normaliser.buffers()
        self.env_steps, self.version, self.epochs = state["env_steps"], state["version"], state["epochs"]
