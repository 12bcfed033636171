"""What PPO, A2C, IMPALA and REINFORCE are made of: network, optimiser, schedule, statistics, and a batch's rows as tensors.

Each algorithm holds one `Parts` and says itself what its advantages, targets and losses are. Rows that are not valid never
enter a minibatch. A number that is not finite stops an update before it reaches the weights. With one torch thread on a
CPU the same batches give the same bits, also after `load_state_dict`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from msgspec.structs import replace
from torch import Tensor

from learner.algorithms import losses
from learner.algorithms.kernels.fused import MOST_ROWS, FusedActorCritic, applies
from learner.algorithms.kernels.optimizer_step import spare_the_compiler, take_step
from learner.algorithms.normalization import ObservationNormaliser, RewardScaler
from learner.config.hyperparameters import ActorCriticHyperparameters, RecurrentHyperparameters
from protocol.arrays import Array, Bools, Floats
from protocol.errors import RunError
from protocol.policy.features import features, normalize
from protocol.policy.networks import ActorCriticNetwork, RecurrentInput
from protocol.policy.torch_distributions import log_prob_and_entropy
from protocol.rollout import Batch
from protocol.specs import ActionSpec, Leaf, PolicySpec

Pulse = Callable[[], None]
Rows = Tensor | slice
View = tuple[Tensor, list[Tensor], RecurrentInput | None]  # what the network takes

AT_ONCE = 1024  # observations that are looked at together where no gradient is wanted: bounds memory


class Minibatch(NamedTuple):
    """B rows of a batch: tensors, or numpy arrays where the update is fused (`fused.py`)."""

    x: Any  # [B, D] float32, normalised features
    images: tuple[Any, ...]  # [B, *leaf] uint8 each
    action: Any  # [B, *action] int64, or float32 unclipped
    log_prob: Any  # [B] float32, by the worker, as acted
    advantage: Any  # [B] float32
    target: Any  # [B] float32, the returns to fit values to
    recurrent: RecurrentInput | None = None  # with a core: x and images are [T · C, …], and B of them are wanted

    def in_numpy(self) -> Minibatch:
        """The same memory as numpy arrays."""
        x, _, action, log_prob, advantage, target, _ = self
        return Minibatch(x.numpy(), (), action.numpy(), log_prob.numpy(), advantage.numpy(), target.numpy())

    def rows(self, index: Any, seen: Tensor | None = None, recurrent: RecurrentInput | None = None) -> Minibatch:
        """Some of these rows, copied; `seen`: the observations to look at, if others are needed besides."""
        seen = index if seen is None else seen
        return Minibatch(
            self.x[seen],
            tuple(image[seen] for image in self.images),
            self.action[index],
            self.log_prob[index],
            self.advantage[index],
            self.target[index],
            recurrent,
        )

    def columns(self, chosen: Tensor, mask: Tensor) -> Minibatch:
        """The rows of whole columns, in time order, where `mask` [T, C] is True; the core sees the others too."""
        assert self.recurrent is not None
        state, carried, _ = self.recurrent
        seen = _rows_of(len(carried), carried.shape[1], chosen)
        inside = mask.flatten()[seen]
        recurrent = RecurrentInput(state[chosen], carried[:, chosen], torch.nonzero(inside)[:, 0])
        return self.rows(seen[inside], seen, recurrent)


class Seen(NamedTuple):
    """The T+1 observations of ΣN columns, as the policy sees them."""

    raw: Floats  # [T+1, ΣN, D] features, not yet normalised
    x: Tensor  # [(T+1) · ΣN, D] float32, normalised features
    images: tuple[Tensor, ...]  # [(T+1) · ΣN, *leaf] uint8 each
    recurrent: RecurrentInput  # of all T+1 steps

    def view(self, steps: int, columns: Rows, rows: Rows) -> View:
        """What the network looks at: these rows, with the memory of the first steps of these columns, if they have one."""
        state, carried, _ = self.recurrent
        recurrent = RecurrentInput(state[columns], carried[:steps, columns]) if state.shape[1] else None
        return self.x[rows], [image[rows] for image in self.images], recurrent


def policy_spec(config: ActorCriticHyperparameters, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
    """An actor and a critic, on any of the supported spaces."""
    spec = PolicySpec(
        observation,
        action,
        net=config.net,
        activation=config.activation,
        normalize_observations=config.normalize_observations,
        shared_net=config.shared_net,
    )
    if isinstance(config, RecurrentHyperparameters):
        spec = replace(spec, core=config.core, core_size=config.core_size)
    return spec


def make_optimizer(kind: Literal["adam", "rmsprop"], net: ActorCriticNetwork, learning_rate: float) -> torch.optim.Optimizer:
    """Over the flat parameters. 1e-5 stands outside the square root, as in Stable-Baselines3."""
    spare_the_compiler()
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
        self.net = ActorCriticNetwork(policy, device, seed=seed)
        if policy.action.kind == "box":
            self.net.parameters["actor.log_std"].detach().fill_(config.log_std_init)
        self.optimizer = make_optimizer(optimizer, self.net, config.learning_rate)
        self.generator = torch.Generator().manual_seed(seed)
        self._fused: FusedActorCritic | None = None
        if device == "cpu" and applies(policy):
            self._fused = FusedActorCritic(policy, self.net.flat.numpy(), self.net.flat_grad.numpy())
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
        x = normalize(raw, *np.split(self._buffers, 2)) if self.policy.normalize_observations else raw
        images = [array for leaf, array in zip(self.policy.observation, batch.obs, strict=True) if leaf.is_image]
        carried = np.concatenate([np.ones((1, raw.shape[1]), bool), batch.valid]).astype(np.float32)
        recurrent = RecurrentInput(self._to_device(batch.state), self._to_device(carried))
        return Seen(raw, self.tensor(x), tuple(map(self.tensor, images)), recurrent)

    def rewards(self, batch: Batch) -> Floats:
        """[T, ΣN] of a batch, scaled if they are to be; ask once for each batch."""
        return self._scaler.scale(batch) if self.config.normalize_rewards else batch.reward

    def values(self, seen: Seen, pulse: Pulse) -> Floats:
        """V(obs) [T+1, ΣN], a piece at a time."""
        fused = self._fused

        def look(view: View, _: Rows) -> Tensor:
            return self.net.value(*view) if fused is None else torch.from_numpy(fused.value(view[0].numpy()))

        return self._looked(seen, len(seen.raw), look, pulse)

    def log_probs(self, seen: Seen, batch: Batch, pulse: Pulse) -> Floats:
        """Log π(action) [T, ΣN] under the newest weights, a piece at a time."""
        action = self.tensor(batch.action)

        def look(view: View, rows: Rows) -> Tensor:
            return log_prob_and_entropy(self.policy.action, self.net.params(*view), action[rows])[0]

        return self._looked(seen, len(batch.valid), look, pulse)

    def _looked(self, seen: Seen, steps: int, look: Callable[[View, Rows], Tensor], pulse: Pulse) -> Floats:
        """One number of each observation of the first steps, [steps, ΣN], a piece at a time: no gradient is wanted."""
        found = torch.empty(steps * seen.raw.shape[1], device=self.net.flat.device)
        with torch.no_grad():
            for columns, rows in self._pieces(steps, seen.raw.shape[1]):
                found[rows] = look(seen.view(steps, columns, rows), rows)
                pulse()
        return np.asarray(found.cpu().numpy()).reshape(steps, -1)

    def _pieces(self, steps: int, columns: int) -> Iterator[tuple[Rows, Rows]]:
        """Columns and rows of pieces of about AT_ONCE rows: neighbouring rows, or with a core whole columns."""
        if self.policy.core is None:
            for at in range(0, steps * columns, AT_ONCE):
                yield slice(None), slice(at, min(at + AT_ONCE, steps * columns))
            return
        for some in torch.split(torch.arange(columns, device=self.net.flat.device), max(1, AT_ONCE // steps)):
            yield some, _rows_of(steps, columns, some)

    def rows(self, batch: Batch, seen: Seen, advantage: Floats, target: Floats) -> Minibatch:
        """All T · ΣN rows, those that are not valid too."""
        x, images, recurrent = seen.view(len(batch.valid), slice(None), slice(batch.valid.size))
        action, log_prob = self.tensor(batch.action), self.tensor(batch.log_prob)
        return Minibatch(x, tuple(images), action, log_prob, self.tensor(advantage), self.tensor(target), recurrent)

    def only(self, rows: Minibatch, mask: Bools) -> Minibatch:
        """Those of all rows where `mask` [T, ΣN] is True."""
        if rows.recurrent is None:
            index = np.flatnonzero(mask)
            return rows.in_numpy().rows(index) if self._small(len(index)) else rows.rows(self._to_device(index))
        return rows.columns(self._to_device(np.arange(mask.shape[1])), self._to_device(mask))

    def epochs(self, rows: Minibatch, mask: Bools, parts: int) -> Iterator[Iterable[Minibatch]]:
        """Epochs without end, each of so many minibatches; a single one is made once: the order of rows is nothing to it."""
        whole = (self.only(rows, mask),) if parts == 1 else ()
        while True:
            yield whole or self.minibatches(rows, mask, parts)

    def minibatches(self, rows: Minibatch, mask: Bools, parts: int) -> Iterator[Minibatch]:
        """Each of all rows where `mask` [T, ΣN] is True once, at random, in so many parts of nearly equal size.

        With a core, which learns what to remember from what came of it, whole columns go together: no more parts than they.
        """
        if rows.recurrent is None:
            valid = np.flatnonzero(mask)
            if self._small(math.ceil(len(valid) / parts)):
                rows = rows.in_numpy()
                for some in np.array_split(self._in_any_order(valid), parts):
                    yield rows.rows(some)
                return
            for index in self._shuffled(valid, parts):
                yield rows.rows(index)
            return
        told = mask.any(0)  # a column without a row would make an empty minibatch
        for chosen in self._shuffled(np.flatnonzero(told), min(parts, int(told.sum()))):
            yield rows.columns(chosen, self._to_device(mask))

    def tensor(self, array: Array) -> Tensor:
        """[T, N, …] as [T · N, …] on the device of the weights."""
        return self._to_device(array.reshape(array.shape[0] * array.shape[1], *array.shape[2:]))

    def _to_device(self, array: Array) -> Tensor:
        return torch.from_numpy(array).to(self.net.flat.device)

    def _small(self, rows: int) -> bool:
        """True for a minibatch that is learned from without a graph."""
        return self._fused is not None and rows <= MOST_ROWS

    def _in_any_order(self, index: Array) -> Array:
        shuffled: Array = index[torch.randperm(len(index), generator=self.generator).numpy()]
        return shuffled

    def _shuffled(self, index: Array, parts: int) -> tuple[Tensor, ...]:
        return self._to_device(self._in_any_order(index)).tensor_split(parts)

    # ---------------------------------------------------------------- a step

    def left(self) -> float:
        """What is left of the run: 1 in the first update, and above 0 in the last."""
        return max(0.0, 1 - self.env_steps / self._total_steps)

    def set_learning_rate(self) -> float:
        """That of this update."""
        found = self.config.learning_rate * (self.left() if self.config.learning_rate_schedule == "linear" else 1)
        self.optimizer.param_groups[0]["lr"] = found
        return found

    def forward(self, rows: Minibatch) -> tuple[Any, Any, Any]:
        """Log π(action), the entropy of π, and V: [B] each, of the kind that the rows are."""
        if isinstance(rows.x, np.ndarray):
            assert self._fused is not None
            return self._fused.forward(rows.x, rows.action)
        params, value = self.net.forward(rows.x, rows.images, rows.recurrent)
        return *log_prob_and_entropy(self.policy.action, params, rows.action), value

    def backward(self, outputs: Sequence[Any], gradients: Sequence[Any], numbers: Mapping[str, Any]) -> dict[str, float]:
        """The gradient by the weights, in place, shortened; and the numbers, read, with its norm before it was.

        Raises `RunError` when one of them is not finite.
        """
        gradient = self.net.flat_grad
        if isinstance(outputs[0], np.ndarray):
            assert self._fused is not None
            self._fused.backward(*gradients)
            flat = gradient.numpy()
            read = [*map(float, numbers.values()), math.sqrt(float(np.dot(flat, flat)))]
        else:
            gradient.zero_()
            torch.autograd.backward(outputs, gradients)
            read = torch.stack((*(number.detach() for number in numbers.values()), gradient.norm())).tolist()
        with torch.no_grad():
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

    @np.errstate(all="ignore")  # what is not finite is found and named
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
        take_step(self.optimizer)
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
        found = {f"train/{name}": sum(each[name] for each in measured) / len(measured) for name in (measured or [{}])[0]}
        found["train/learning_rate"] = self.optimizer.param_groups[0]["lr"]
        found["train/n_updates"] = float(self.version)
        log_std = self.net.parameters.get("actor.log_std")
        return found if log_std is None else found | {"train/std": log_std.detach().exp().mean().item()}

    # ---------------------------------------------------------------- what leaves, and comes back

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the acting parameters [P] and of the buffers, as `protocol.policy.layout` lays them out."""
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


def _rows_of(steps: int, columns: int, chosen: Tensor) -> Tensor:
    """The numbers of the rows of some columns, in time order, of `steps` by `columns` rows."""
    return (torch.arange(steps, device=chosen.device)[:, None] * columns + chosen).flatten()
