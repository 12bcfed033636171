"""What PPO, A2C, IMPALA and REINFORCE are made of: network, optimiser, schedule, statistics, and a batch's rows as tensors.

Each algorithm holds one `Parts` and says itself what its advantages, targets and losses are. Rows that are not valid never
enter a minibatch. A number that is not finite stops an update before it reaches the weights. With one torch thread on a
CPU the same batches give the same bits, also after `load_state_dict`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from learner.algorithms import losses
from learner.algorithms.normalise import ObservationNormaliser, RewardScaler
from learner.hyperparameters import ActorCriticHyperparameters
from protocol.errors import RunError
from protocol.networks import ActorCritic, log_prob_and_entropy
from protocol.policy import features, normalized
from protocol.rollout import Batch
from protocol.specs import ActionSpec, Leaf, PolicySpec

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]
Pulse = Callable[[], None]

AT_ONCE = 1024  # observations that are looked at together where no gradient is wanted: bounds memory


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


class Seen(NamedTuple):
    """The T+1 observations of ΣN columns, as the policy sees them."""

    raw: Floats  # [T+1, ΣN, D] features, not yet normalised
    x: Tensor  # [(T+1) · ΣN, D] float32, normalised features
    images: tuple[Tensor, ...]  # [(T+1) · ΣN, *leaf] uint8 each


def policy_spec(config: ActorCriticHyperparameters, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
    """An actor and a critic, on any of the supported spaces."""
    return PolicySpec(
        observation,
        action,
        net=config.net,
        activation=config.activation,
        normalize_observations=config.normalize_observations,
        shared_net=config.shared_net,
    )


def make_optimizer(kind: Literal["adam", "rmsprop"], net: ActorCritic, learning_rate: float) -> torch.optim.Optimizer:
    """Over the flat parameters. 1e-5 stands outside the square root, as in Stable-Baselines3."""
    if kind == "adam":
        return torch.optim.Adam([net.flat], lr=learning_rate, eps=1e-5, fused=True)
    return torch.optim.RMSprop([net.flat], lr=learning_rate, alpha=0.99, eps=1e-5)


class Parts:
    """The policy, its optimiser and their schedules."""

    def __init__(
        self,
        config: ActorCriticHyperparameters,
        policy: PolicySpec,
        optimizer: Literal["adam", "rmsprop"],
        *,
        total_steps: int,
        seed: int,
        device: str,
    ) -> None:
        self.config = config
        self.policy = policy
        self.net = ActorCritic(policy, device, seed=seed)
        if policy.action.kind == "box":
            self.net.parameters["actor.log_std"].detach().fill_(config.log_std_init)
        self.optimizer = make_optimizer(optimizer, self.net, config.learning_rate)
        self.generator = torch.Generator().manual_seed(seed)
        self.env_steps = 0  # transitions used so far: where the schedules are
        self.version = 0  # updates made
        self._total_steps = total_steps
        self._normaliser = ObservationNormaliser(policy)
        self._scaler = RewardScaler(config.gamma)
        self._buffers = self._normaliser.buffers()  # as published: float32 means, standard deviations

    # ---------------------------------------------------------------- a batch, as tensors

    def see(self, batch: Batch) -> Seen:
        """Observations as the workers saw them."""
        raw = features(self.policy, batch.obs)
        x = normalized(raw, *np.split(self._buffers, 2)) if self.policy.normalize_observations else raw
        images = [array for leaf, array in zip(self.policy.observation, batch.obs, strict=True) if leaf.is_image]
        return Seen(raw, self.tensor(x), tuple(map(self.tensor, images)))

    def rewards(self, batch: Batch) -> Floats:
        """[T, ΣN] of a batch, scaled if they are to be; ask once for each batch."""
        return self._scaler.scale(batch) if self.config.normalize_rewards else batch.reward

    def values(self, seen: Seen, pulse: Pulse) -> Floats:
        """V(obs) [T+1, ΣN], a piece at a time."""
        found = []
        with torch.no_grad():
            for x, *images in _pieces(seen.x, *seen.images):
                found.append(self.net.value(x, images))
                pulse()
        return np.asarray(torch.cat(found).cpu().numpy()).reshape(seen.raw.shape[:2])

    def log_probs(self, seen: Seen, batch: Batch, pulse: Pulse) -> Floats:
        """Log π(action) [T, ΣN] under the newest weights, a piece at a time."""
        found, count = [], batch.valid.size
        with torch.no_grad():
            parts = (seen.x[:count], self.tensor(batch.action), *(image[:count] for image in seen.images))
            for x, action, *images in _pieces(*parts):
                params = self.net.params(x, images)
                found.append(log_prob_and_entropy(self.policy.action, params, action)[0])
                pulse()
        return np.asarray(torch.cat(found).cpu().numpy()).reshape(batch.valid.shape)

    def rows(self, batch: Batch, seen: Seen, advantage: Floats, target: Floats) -> Minibatch:
        """All T · ΣN rows, those that are not valid too."""
        count = batch.valid.size
        return Minibatch(
            seen.x[:count],
            tuple(image[:count] for image in seen.images),
            *(self.tensor(array) for array in (batch.action, batch.log_prob, advantage, target)),
        )

    def tensor(self, array: Array) -> Tensor:
        """[T, N, …] as [T · N, …] on the device of the weights."""
        return torch.from_numpy(array.reshape(array.shape[0] * array.shape[1], *array.shape[2:])).to(self.net.flat.device)

    def index(self, mask: npt.NDArray[np.bool_]) -> Tensor:
        """The numbers of the rows [T, ΣN] that are True."""
        return torch.from_numpy(np.flatnonzero(mask)).to(self.net.flat.device)

    def shuffled(self, index: Tensor, parts: int) -> tuple[Tensor, ...]:
        """The numbers of some rows in so many minibatches of nearly equal size, on the device of the weights."""
        return index[torch.randperm(len(index), generator=self.generator)].to(self.net.flat.device).tensor_split(parts)

    # ---------------------------------------------------------------- a step

    def left(self) -> float:
        """What is left of the run: 1 in the first update, and above 0 in the last."""
        return max(0.0, 1 - self.env_steps / self._total_steps)

    def set_learning_rate(self) -> float:
        """That of this update."""
        found = self.config.learning_rate * (self.left() if self.config.learning_rate_schedule == "linear" else 1)
        self.optimizer.param_groups[0]["lr"] = found
        return found

    def forward(self, rows: Minibatch) -> tuple[Tensor, Tensor, Tensor]:
        """Log π(action), the entropy of π, and V: [B] each."""
        params, value = self.net.forward(rows.x, rows.images)
        return *log_prob_and_entropy(self.policy.action, params, rows.action), value

    def backward(
        self, outputs: Sequence[Tensor], gradients: Sequence[Tensor], numbers: Mapping[str, Tensor]
    ) -> dict[str, float]:
        """The gradient by the weights, in place, shortened; and the numbers, read, with its norm before it was.

        Raises `RunError` when one of them is not finite.
        """
        gradient = self.net.flat_grad
        gradient.zero_()
        torch.autograd.backward(outputs, gradients)
        with torch.no_grad():
            read = torch.stack((*numbers.values(), gradient.norm())).tolist()
            measured = dict(zip((*numbers, "grad_norm"), read, strict=True))
            for name, number in measured.items():
                if not math.isfinite(number):
                    raise RunError(
                        f"learner: update {self.version}: {name} expected finite, got {number}; this step was not "
                        "taken; try a lower learning_rate, or normalize_observations and normalize_rewards"
                    )
            if measured["grad_norm"] > self.config.max_grad_norm:
                gradient.mul_(self.config.max_grad_norm / measured["grad_norm"])
        return measured

    def policy_gradient_step(self, rows: Minibatch, critic: bool = True) -> dict[str, float]:
        """One step of the optimiser on valid rows, by the plain policy gradient; `critic`: the values are fitted too.

        L = −E[A log π(a)] + vf_coef E[(V − target)²] − ent_coef E[H(π)]
        """
        log_prob, entropy, value = self.forward(rows)
        with torch.no_grad():
            policy_loss, by_log_prob = losses.policy_gradient(log_prob, rows.advantage)
            value_loss, by_value = losses.value_loss(value, rows.target)
            entropy_loss, by_entropy = losses.entropy_loss(entropy)
            by_entropy *= self.config.ent_coef
            by_value *= self.config.vf_coef if critic else 0.0
        numbers = {"policy_gradient_loss": policy_loss, "value_loss": value_loss, "entropy_loss": entropy_loss}
        measured = self.backward((log_prob, entropy, value), (by_log_prob, by_entropy, by_value), numbers)
        self.optimizer.step()
        return measured

    def used(self, batch: Batch, seen: Seen) -> None:
        """An update was made with this batch."""
        self.env_steps += batch.env_steps
        self.version += 1
        # The batch was acted on under the statistics published before it, and the losses must see the observations as
        # the worker did, else the ratio is not 1 where the policy has not moved. So the statistics change only now, to
        # be published together with the weights.
        self._normaliser.update(seen.raw[:-1], batch.valid)
        self._buffers = self._normaliser.buffers()

    def metrics(self, measured: Sequence[Mapping[str, float]]) -> dict[str, float]:
        """Means of what steps measured, by Stable-Baselines3's names, and what is true of any update."""
        found = {f"train/{name}": float(np.mean([each[name] for each in measured])) for name in (measured or [{}])[0]}
        found["train/learning_rate"] = self.optimizer.param_groups[0]["lr"]
        found["train/n_updates"] = float(self.version)
        log_std = self.net.parameters.get("actor.log_std")
        return found if log_std is None else found | {"train/std": log_std.detach().exp().mean().item()}

    # ---------------------------------------------------------------- what leaves, and comes back

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the acting parameters [P] and of the buffers, as `protocol.policy` lays them out."""
        return self.net.flat[: self.net.acting_size].cpu().numpy().copy(), self._buffers.copy()

    def state_dict(self) -> dict[str, Any]:
        """A copy of all that the next update depends on: tensors and plain data (`torch.load(weights_only=True)`)."""
        return {
            "parameters": self.net.flat.clone(),
            "optimizer": copy.deepcopy(self.optimizer.state_dict()),
            "generator": self.generator.get_state(),
            "observations": self._normaliser.state_dict(),
            "rewards": self._scaler.state_dict(),
            "env_steps": self.env_steps,
            "version": self.version,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there: the next update is the one that would have followed, bit for bit."""
        self.net.flat.copy_(state["parameters"])
        self.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))
        self.generator.set_state(state["generator"])
        self._normaliser.load_state_dict(state["observations"])
        self._scaler.load_state_dict(state["rewards"])
        self._buffers = self._normaliser.buffers()
        self.env_steps, self.version = state["env_steps"], state["version"]


def _pieces(*tensors: Tensor) -> zip[tuple[Tensor, ...]]:
    """Tensors of the same length, `AT_ONCE` rows at a time."""
    return zip(*(torch.split(tensor, AT_ONCE) for tensor in tensors), strict=True)
