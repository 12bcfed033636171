"""The base class of algorithms that train flat tensors by gradient descent: what updates need, and the saved state.

Rule: torch differentiates exactly the loss that an algorithm defines. A step is taken only if its loss and its gradient are
finite. If an update raises, `roll_back` undoes the changes that it has made so far.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.optim import Optimizer

from millrace.learner.algorithms.algorithm import Algorithm, Start
from millrace.learner.algorithms.kernels.optimizer_step import load_state, state_of
from millrace.learner.algorithms.prior_data import PriorData
from millrace.learner.algorithms.running_statistics import ObservationNormalizer, RewardScaler
from millrace.protocol.arrays import Array, Floats
from millrace.protocol.errors import RunError, UsageError
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec

UpdateMetrics = dict[str, float]

ADVICE = "a lower learning_rate, or normalize_observations and normalize_rewards"


class Network(Protocol):
    """The attribute that every network has."""

    flat: Tensor
    """[P] all parameters"""


class GradientDescent(Algorithm):
    """Flat tensors, an optimizer for each trained tensor, schedules, and statistics of observations and returns.

    A subclass puts everything that a step changes into `tensors` and `optimizers`, and everything else that the next update
    depends on into `other_state`.
    """

    tensors: dict[str, Tensor]
    """The tensors that steps change in place, by their names in the saved state."""
    net: Network
    optimizers: dict[str, Optimizer]
    """The optimizers, by their names in the saved state. Each steps one flat tensor that has a gradient."""

    def __init__(self, config: Any, policy: PolicySpec, *, total_steps: int) -> None:
        self.config = config
        self.policy = policy
        self.env_steps = 0  # env steps of all batches so far, on which schedules depend
        self.version = 0  # updates made so far
        self._total_steps = total_steps
        self.normalizer = ObservationNormalizer(policy)
        self.statistics: Floats = self.normalizer.buffers()  # float32 means and standard deviations, as published
        self.rewards = RewardScaler(config.gamma)
        self.pretraining_steps = 0  # gradient steps taken before the first update by other code, such as cloning
        self._remembered: dict[str, Any] = {}

    # ---------------------------------------------------------------- an update

    def remaining(self) -> float:
        """The fraction of the run that remained before this batch: 1 − env_steps / total_steps, but at least 0."""
        return max(0.0, 1 - self.env_steps / self._total_steps)

    def set_schedules(self) -> None:
        """Set the values that follow a schedule, such as the learning rate. Called at the start of each update."""
        learning_rate = scheduled(self.config.learning_rate, self.config.learning_rate_schedule, self.remaining())
        for optimizer in self.optimizers.values():
            optimizer.param_groups[0]["lr"] = learning_rate

    @property
    def learning_rate(self) -> float:
        """The learning rate of all optimizers in this update."""
        rate: float = next(iter(self.optimizers.values())).param_groups[0]["lr"]
        return rate

    def inputs(self, leaves: Sequence[Array]) -> tuple[Tensor, tuple[Tensor, ...]]:
        """The networks' input for leaves [B, *leaf]: features [B, D], normalized, and images [B, *leaf] uint8."""
        x, images = self.normalizer.inputs(leaves, self.statistics)
        return self.tensor(x).to(self.net.flat.dtype), tuple(map(self.tensor, images))

    def tensor(self, array: Array) -> Tensor:
        """The array as a tensor, on the device of the weights."""
        return torch.from_numpy(array).to(self.net.flat.device)

    def count(self, batch: Batch) -> None:
        """Add a batch to the running statistics. New observation statistics take effect only when `statistics` is set."""
        if self.config.normalize_rewards:
            self.rewards.count(batch)
        if self.policy.normalize_observations:
            self.normalizer.update(self.normalizer.raw(batch.obs)[:-1], batch.valid)

    def scaled(self, reward: Floats) -> Floats:
        """The rewards that the critic learns from: scaled if the settings say so."""
        return self.rewards.scaled(reward) if self.config.normalize_rewards else reward

    def add_prior(self, prior: PriorData) -> None:
        """Add the rows of a dataset to all running statistics."""
        for batch in prior.batches():
            self.count(batch)
        self.statistics = self.normalizer.buffers()

    def differentiate(self, loss: Tensor, optimizer: Optimizer, numbers: Mapping[str, Tensor | float]) -> UpdateMetrics:
        """Compute the gradient of a loss, and store it in `grad` of the optimizer's flat tensor.

        Sets `grad` to zero, and then calls `loss.backward()`. Returns `numbers` as floats, and the norm of the gradient as
        `grad_norm`. Raises `RunError` if one of these is not finite, and `UsageError` if one isn't a number.
        """
        (flat,) = optimizer.param_groups[0]["params"]
        gradient = flat.grad
        assert gradient is not None
        gradient.zero_()
        loss.backward()  # type: ignore[no-untyped-call]
        read = [self._logged(name, number, loss) for name, number in numbers.items()]
        values = torch.stack((*read, gradient.norm())).tolist()  # stacked, so that a GPU transfers them all at once
        metrics = dict(zip((*numbers, "grad_norm"), values, strict=True))
        check_finite(metrics, self.version, ADVICE)
        return metrics

    def _logged(self, name: str, number: Any, like: Tensor) -> Tensor:
        """A number that a loss logs, as a 0-dimensional tensor. Raises `UsageError` for anything else."""
        if isinstance(number, Tensor) and not number.dim():
            return number.detach()
        got = type(number).__name__
        try:
            tensor = torch.as_tensor(number, dtype=like.dtype, device=like.device)
            if tensor.numel() == 1:
                return tensor.detach().reshape(())
            got = f"{got} {list(tensor.shape)}; log its mean"
        except (TypeError, ValueError, RuntimeError):
            pass
        raise UsageError(f"{type(self).__name__}.loss: {name}: expected one number to log, got {got}")

    @staticmethod
    def means(measured: Iterable[Mapping[str, float]]) -> UpdateMetrics:
        """The mean of each metric over the measurements that include it. Names get the prefix "train/"."""
        by_name: dict[str, list[float]] = {}
        for each in measured:
            for name, number in each.items():
                by_name.setdefault(name, []).append(number)
        return {f"train/{name}": sum(values) / len(values) for name, values in by_name.items()}

    # ---------------------------------------------------------------- the state

    def is_finite(self) -> bool:
        """Whether all weights, including those that don't compute actions, and the observation statistics are finite."""
        return bool(all(tensor.isfinite().all() for tensor in self.tensors.values()) and np.isfinite(self.statistics).all())

    def other_state(self) -> dict[str, Any]:
        """A copy, as plain data, of all other state that updates depend on: all but tensors, optimizers and statistics."""
        return {"env_steps": self.env_steps, "version": self.version, "pretraining_steps": self.pretraining_steps}

    def load_other_state(self, state: dict[str, Any]) -> None:
        """Restore what `other_state` returned."""
        self.env_steps = int(state["env_steps"])
        self.version = int(state["version"])
        self.pretraining_steps = int(state["pretraining_steps"])

    def state_dict(self) -> dict[str, Any]:
        """A copy of all that the next update depends on. `torch.load(weights_only=True)` can load it from a file."""
        return (
            {name: tensor.clone() for name, tensor in self.tensors.items()}
            | {name: state_of(optimizer) for name, optimizer in self.optimizers.items()}
            | {"observations": self.normalizer.state_dict(), "rewards": self.rewards.state_dict()}
            | self.other_state()
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`: the next update gives the same bits as if the saved algorithm had continued."""
        for name, tensor in self.tensors.items():
            tensor.copy_(state[name])
        for name, optimizer in self.optimizers.items():
            load_state(optimizer, state[name])
        self.normalizer.load_state_dict(state["observations"])
        self.statistics = self.normalizer.buffers()
        self.rewards.load_state_dict(state["rewards"])
        self.load_other_state(state)

    def start_from(self, start: Start) -> None:
        """See `Algorithm.start_from`. A replay buffer starts empty.

        Target networks start as copies of the networks. If the earlier run's critic is loaded, so are its target networks.
        """
        own = GradientDescent.state_dict(self)
        GradientDescent.load_state_dict(self, start.into(own, self.tensors, self.optimizers))

    def remember(self) -> None:
        """Remember the current state, for `roll_back`."""
        self._remembered = self.state_dict()

    def roll_back(self) -> None:
        """Return to the state of the last `remember`."""
        self.load_state_dict(self._remembered)


def check_finite(metrics: Mapping[str, float], update: int, advice: str) -> None:
    """Raise `RunError` if a metric is not finite, and name the first such metric. Call this before each gradient step."""
    for name, number in metrics.items():
        if not math.isfinite(number):
            raise RunError(
                f"learner: update {update}: {name}: expected finite, got {number}; this step was not taken; try {advice}"
            )


def scheduled(first: float, schedule: str, remaining: float) -> float:
    """A setting's value if this fraction of the run remains: first · remaining for `linear`, first for `constant`."""
    return first * (remaining if schedule == "linear" else 1)


def clip_norm(flat: Tensor, norm: float, largest: float) -> None:
    """Scale down the gradient of a flat tensor to a norm of at most `largest`. Its current norm is `norm`."""
    if norm > largest:
        assert flat.grad is not None
        flat.grad.mul_(largest / norm)
