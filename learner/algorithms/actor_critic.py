"""The base of PPO, A2C, IMPALA and REINFORCE, and of a user's own actor-critic: everything about an update except the loss.

Rows that are not valid never enter a minibatch. An update raises before a number that is not finite reaches the weights, or
when a step makes one; `roll_back` then takes back what it did.
With one torch thread on a CPU the same batches give the same bits, also after `load_state_dict`. No sockets, no files, no
clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from msgspec.structs import replace
from torch import Tensor

from learner.algorithms import losses
from learner.algorithms.algorithm import Algorithm, Start
from learner.algorithms.cloning.clones import Clones
from learner.algorithms.cloning.demonstrations import Demonstrations
from learner.algorithms.kernels import loss_gradients
from learner.algorithms.kernels.fused import MAX_ROWS, FusedActorCritic, can_fuse
from learner.algorithms.kernels.loss_gradients import Numbers, OutputGradients
from learner.algorithms.kernels.optimizer_step import avoid_compiler_import, load_state, state_of, take_step
from learner.algorithms.minibatches import Index, LossInput, Minibatch, NetworkInput, Observations, rows_of_columns
from learner.algorithms.normalization import ObservationNormalizer, RewardScaler
from learner.algorithms.returns import EpisodeEnds, gae
from learner.algorithms.updates import check_finite, scheduled
from learner.config.hyperparameters import ActorCriticConfig, AlgorithmConfig, PolicyGradientConfig, RecurrentConfig
from protocol.arrays import Array, Bools, Floats
from protocol.errors import RunError, UsageError
from protocol.policy.features import features
from protocol.policy.masks import FORBIDDEN
from protocol.policy.networks import ActorCriticNetwork, RecurrentInput
from protocol.policy.torch_distributions import log_prob_and_entropy, policy_log_prob
from protocol.random_streams import Purpose, torch_seed
from protocol.rollout import Batch
from protocol.specs import ActionSpec, Leaf, PolicySpec

Pulse = Callable[[], None]
Metrics = dict[str, float]

ADVICE = "a lower learning_rate, or normalize_observations and normalize_rewards"
MAX_LOG_STD = 80.0  # e⁸⁰ times the largest noise of numpy, which is below 14, is finite in float32
CHUNK_ROWS = 1024  # observations that are evaluated together where no gradient is needed: this bounds memory


class Estimates(NamedTuple):
    """Targets and advantages of a batch, computed before the losses. Arrays are [T, ΣN]."""

    advantage: Floats
    target: Floats  # the critic is trained to predict these
    values: Floats  # [T+1, ΣN] the values from which advantages and targets were computed
    mask: Bools  # True for the rows to learn from; all of these are valid
    metrics: Metrics  # without the prefix "train/"


class ActorCritic(Clones):
    """The network, the optimizer, schedules and running statistics, and the update that uses them.

    A subclass defines `loss`, unless its loss is the policy gradient with a squared value loss. Advantages are generalized
    advantage estimates; for another rule it defines `estimate`. What else changes in an update, it adds to `state_dict` and
    `load_state_dict`.

    `Config` is the record of the settings, and `self.config` holds their values. Beside those of `PolicyGradientConfig`,
    this class uses `gae_lambda`, `n_epochs`, `batch_size`, `normalize_advantage` and `optimizer` where the record has them.
    Otherwise λ is 1, an update is one step on all rows with their advantages as they are, and the optimizer is Adam.

    How a gradient is computed: `loss` is written with ordinary torch operations, and autograd differentiates it. A built-in
    algorithm also defines `loss_gradients`: the same loss, and its derivatives with respect to the network's outputs,
    derived by hand. If a class has `loss_gradients`, it is always used instead of `loss`. The backward pass through the
    network is then computed

    - in numpy (`kernels.fused`) if the network is a small MLP on the CPU and the minibatch has at most `MAX_ROWS` rows,
    - by autograd in all other cases (images, recurrent cores, custom encoders, large layers or minibatches, GPUs).

    A subclass that overrides `loss` and not `loss_gradients` gets autograd for its loss. Both ways give the same numbers,
    except for rounding errors, which the tests limit. The choice never depends on measured time.
    """

    Config: ClassVar[type[AlgorithmConfig]] = ActorCriticConfig  # see `Algorithm`
    config: PolicyGradientConfig
    n_epochs = 1  # how many times an update uses each row, if the settings do not say it
    estimates_each_epoch: ClassVar[bool] = False  # True: `estimate` is called before each epoch, under the newest weights
    shuffles_single_minibatch: ClassVar[bool] = False  # whether an epoch of one minibatch shuffles its rows

    @staticmethod
    def policy_spec(config: PolicyGradientConfig, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """An actor and a critic. All spaces that we know are supported."""
        spec = replace(Algorithm.policy_spec(config, observation, action), shared_net=config.shared_net)
        if isinstance(config, RecurrentConfig):
            spec = replace(spec, core=config.core, core_size=config.core_size)
        return spec

    def __init__(
        self,
        config: PolicyGradientConfig,
        policy: PolicySpec,
        *,
        total_steps: int,
        seed: int,
        device: str = "cpu",
    ) -> None:
        self.config, self.policy, self.seed = config, policy, seed
        self.n_epochs = getattr(config, "n_epochs", self.n_epochs)
        self.net = ActorCriticNetwork(policy, device, seed=seed)
        if policy.action.kind == "box":
            self.net.parameters["actor.log_std"].detach().fill_(config.log_std_init)
        self.optimizer = make_optimizer(getattr(config, "optimizer", "adam"), self.net, config.learning_rate)
        self.generator = torch.Generator().manual_seed(torch_seed(seed, Purpose.SHUFFLES))
        self.env_steps = 0  # valid rows used so far; schedules depend on it
        self.version = 0  # updates made
        self._total_steps = total_steps
        self._hand_derived = _loss_gradients_are_of_this_loss(type(self))
        self._fused: FusedActorCritic | None = None
        if self._hand_derived and device == "cpu" and can_fuse(policy):
            self._fused = FusedActorCritic(policy, self.net.flat.numpy(), self.net.flat_grad.numpy())
        self._normalizer = ObservationNormalizer(policy)
        self._reward_scaler = RewardScaler(config.gamma)
        self._buffers = self._normalizer.buffers()  # float32 means and standard deviations, as published
        self._remembered: dict[str, Any] = {}

    # ---------------------------------------------------------------- what an algorithm defines

    def estimate(self, batch: Batch, observations: Observations, reward: Floats, pulse: Pulse) -> Estimates:
        """Generalized advantage estimates A, and the targets A + V. `reward` [T, ΣN]: scaled if the settings say so."""
        values = self.values(observations, pulse)
        gae_lambda: float = getattr(self.config, "gae_lambda", 1.0)
        advantage = gae(reward, values, EpisodeEnds.of(batch), self.config.gamma, gae_lambda)
        return Estimates(advantage, advantage + values[:-1], values, batch.valid, {})

    def standardizes_advantages(self) -> bool:
        """Whether the advantages of each minibatch get mean 0 and standard deviation 1."""
        return bool(getattr(self.config, "normalize_advantage", False))

    def loss(self, rows: LossInput) -> tuple[Tensor, Mapping[str, Tensor | float]]:
        """The loss of a minibatch, a tensor of no dimension, and numbers to log by name. Every row is a valid one.

        L = −E[A log π(a)] + vf_coef E[(V − target)²] − ent_coef E[H(π)]
        """
        numbers = {
            "policy_gradient_loss": losses.policy_gradient(rows.log_prob_now, rows.advantage),
            "value_loss": losses.value_loss(rows.value, rows.target),
            "entropy_loss": losses.entropy_loss(rows.entropy),
        }
        policy_loss, value_loss, entropy_loss = numbers.values()
        return policy_loss + self.vf_coef * value_loss + self.config.ent_coef * entropy_loss, numbers

    def loss_gradients(self, rows: LossInput) -> tuple[Numbers, OutputGradients]:
        """The results of `loss`, and the derivatives of the loss with respect to log-probabilities, entropies and values.

        Arguments and results are tensors without a graph, or numpy arrays.
        """
        return loss_gradients.policy_gradient_and_value(rows, ent_coef=self.config.ent_coef, vf_coef=self.vf_coef)

    @property
    def vf_coef(self) -> float:
        """The weight of the value loss."""
        return self.config.vf_coef

    def minibatch_count(self, rows: int) -> int:
        """Number of minibatches, of nearly equal size, in an epoch of `rows` rows."""
        batch_size: int | None = getattr(self.config, "batch_size", None)
        return 1 if batch_size is None else math.ceil(rows / batch_size)

    def stops(self, metrics: Metrics) -> bool:
        """Whether a minibatch with these metrics ends the update, before its gradient step is taken."""
        return False

    def set_schedules(self) -> None:
        """Set what depends on how much of the run remains. Called at the start of each update."""
        config = self.config
        rate = scheduled(config.learning_rate, config.learning_rate_schedule, self.remaining())
        self.optimizer.param_groups[0]["lr"] = rate

    # ---------------------------------------------------------------- an update

    def update(self, batch: Batch, pulse: Pulse) -> Metrics:
        """Learn from a batch, calling `pulse` between minibatches. Returns metrics with the names of Stable-Baselines3.

        Raises `RunError` when a loss or a gradient is not finite, before it reaches the weights; and when the
        actions of these weights would not be.
        """
        if not batch.valid.any():
            return {}
        self.set_schedules()
        observations, reward = self.observations(batch), self.rewards(batch)
        estimates: list[Estimates] = []
        epochs: list[list[Metrics]] = []
        for _ in range(self.n_epochs):
            if not estimates or self.estimates_each_epoch:
                estimates.append(self.estimate(batch, observations, reward, pulse))
                rows = self.rows(batch, observations, estimates[-1])
                minibatches_of_epochs = self._epochs(rows, estimates[-1].mask)
            epochs.append(self._epoch(next(minibatches_of_epochs), pulse))
            if epochs[-1] and self.stops(epochs[-1][-1]):
                break
        self._check_spread_of_actions()
        self.count_update(batch, observations, len(epochs))
        return self.metrics(epochs, estimates)

    def _epoch(self, minibatches: Iterable[Minibatch], pulse: Pulse) -> list[Metrics]:
        """A step on each minibatch, until one ends the update."""
        found: list[Metrics] = []
        for minibatch in minibatches:
            found.append(self.step(minibatch))
            pulse()
            if self.stops(found[-1]):
                break
        return found

    @np.errstate(all="ignore")  # `_gradient` finds and names what is not finite
    def step(self, minibatch: Minibatch) -> Metrics:
        """One gradient step on a minibatch of valid rows, unless `stops` forbids it. Returns what was measured before it."""
        rows = self.evaluate(minibatch)
        metrics = self._gradient(rows)
        check_finite(metrics, self.version, ADVICE)
        if metrics["grad_norm"] > self.config.max_grad_norm:
            self.net.flat_grad.mul_(self.config.max_grad_norm / metrics["grad_norm"])
        if not self.stops(metrics):
            take_step(self.optimizer)
        return metrics

    def evaluate(self, minibatch: Minibatch) -> LossInput:
        """The rows of a minibatch with the network's outputs: arrays of the same library as the minibatch's."""
        if isinstance(minibatch.features, np.ndarray):
            assert self._fused is not None
            outputs: tuple[Any, Any, Any] = self._fused.forward(minibatch.features, minibatch.action, minibatch.mask)
        else:
            params, value = self.net.forward(minibatch.features, minibatch.images, minibatch.recurrent)
            params = _forbid(params, minibatch.mask)
            outputs = *log_prob_and_entropy(self.policy.action, params, minibatch.action), value
        raw = minibatch.advantage
        advantage = losses.standardized(raw) if self.standardizes_advantages() else raw
        return LossInput(minibatch.action, minibatch.log_prob, advantage, raw, minibatch.target, *outputs)

    def _gradient(self, rows: LossInput) -> Metrics:
        """Write the gradient of the weights into `net.flat_grad`. Returns the loss metrics and the gradient norm."""
        gradient = self.net.flat_grad
        if isinstance(rows.value, np.ndarray):
            assert self._fused is not None
            numbers, by_outputs = self.loss_gradients(rows)
            self._fused.backward(*by_outputs)
            flat = gradient.numpy()
            return {name: float(each) for name, each in numbers.items()} | {
                "grad_norm": math.sqrt(float(np.dot(flat, flat)))
            }
        gradient.zero_()
        if self._hand_derived:
            with torch.no_grad():
                numbers, by_outputs = self.loss_gradients(rows)
            torch.autograd.backward((rows.log_prob_now, rows.entropy, rows.value), by_outputs)
        else:
            loss, logged = self._checked_loss(rows)
            loss.backward()  # type: ignore[no-untyped-call]
            numbers = {"loss": loss} | {name: self._logged(name, each, loss) for name, each in logged.items()}
        read = torch.stack((*(number.detach() for number in numbers.values()), gradient.norm())).tolist()
        return dict(zip((*numbers, "grad_norm"), read, strict=True))

    def _checked_loss(self, rows: LossInput) -> tuple[Tensor, Mapping[str, Tensor | float]]:
        match self.loss(rows):
            case (Tensor() as loss, Mapping() as logged) if loss.dim() == 0 and loss.requires_grad:
                return loss, logged
        raise UsageError(
            f"{type(self).__name__}.loss: expected a tensor of no dimension that depends on log_prob_now, entropy or value "
            "of its rows, and a dict of numbers to log"
        )

    def _logged(self, name: str, number: Any, like: Tensor) -> Tensor:
        """A number that `loss` logs, as a tensor of no dimension. Raises `UsageError` for anything else."""
        got = type(number).__name__
        try:
            found = torch.as_tensor(number, dtype=like.dtype, device=like.device)
            if found.numel() == 1:
                return found.reshape(())
            got = f"{got} {list(found.shape)}; log its mean"
        except (TypeError, ValueError, RuntimeError):
            pass
        raise UsageError(f"{type(self).__name__}.loss: {name}: expected one number to log, got {got}")

    def _check_spread_of_actions(self) -> None:
        """Raise `RunError` before Box actions overflow: workers would be refused for them, one after the other."""
        log_std = self.net.parameters.get("actor.log_std")
        if log_std is not None and (largest := log_std.detach().max().item()) > MAX_LOG_STD:
            raise RunError(
                f"learner: update {self.version}: logarithm of the standard deviation of actions: expected at most "
                f"{MAX_LOG_STD:g}, got {largest:.3g}; try a lower ent_coef, or a lower learning_rate"
            )

    def count_update(self, batch: Batch, observations: Observations, epochs: int) -> None:
        """Count an update of `epochs` epochs with this batch: steps, versions, observation statistics."""
        self.env_steps += batch.env_steps
        self.version += 1
        # Workers acted under the statistics that were published before this batch. The losses must normalize observations
        # with the same statistics: otherwise the probability ratio would not be 1 for an unchanged policy. So the
        # statistics change only after the update. They are published together with the weights.
        self._normalizer.update(observations.raw_features[:-1], batch.valid)
        self._buffers = self._normalizer.buffers()

    def metrics(self, epochs: Sequence[Sequence[Metrics]], estimates: Sequence[Estimates]) -> Metrics:
        """The metrics of an update: means over its gradient steps and estimates, and the state of the schedules."""
        found = _means([step for epoch in epochs for step in epoch])
        found["train/learning_rate"] = self.optimizer.param_groups[0]["lr"]
        found["train/n_updates"] = float(self.version)
        log_std = self.net.parameters.get("actor.log_std")
        if log_std is not None:
            found["train/std"] = log_std.detach().exp().mean().item()
        return found | _means([{"explained_variance": _explained_variance(each), **each.metrics} for each in estimates])

    def remaining(self) -> float:
        """The fraction of the run that remains: 1 in the first update, above 0 in the last."""
        return max(0.0, 1 - self.env_steps / self._total_steps)

    # ---------------------------------------------------------------- cloning

    def add_prior(self, batches: Iterable[Batch], observations: int) -> None:
        """Count the rows of a dataset for all statistics."""
        for batch in batches:
            self.rewards(batch)
            self._normalizer.update(features(self.policy, batch.obs)[:-1], batch.valid)
        self._buffers = self._normalizer.buffers()

    def scaled(self, reward: Floats) -> Floats:
        """See `Clones`."""
        return self._reward_scaler.scaled(reward) if self.config.normalize_rewards else reward

    def cloning_loss(self, rows: Demonstrations) -> tuple[Tensor, Tensor]:
        """See `Clones`."""
        params, value = self.net.forward(*self._inputs(rows.obs(rows.at)))
        with torch.no_grad():
            last_value = self.net.value(*self._inputs(rows.obs(rows.last)))
        action, returns, discount = map(self._to_device, (rows.action, rows.returns, rows.discount))
        log_prob = policy_log_prob(self.policy, params, action)
        return self.vf_coef * losses.value_loss(value, returns + discount * last_value) - log_prob.mean(), params

    def _inputs(self, leaves: Sequence[Array]) -> tuple[Tensor, list[Tensor]]:
        """Features [B, D], normalized, and images [B, *leaf] uint8, of leaves [B, *leaf]."""
        _, x, images = self._normalizer.inputs(leaves, self._buffers)
        return self._to_device(x), [self._to_device(image) for image in images]

    # ---------------------------------------------------------------- a batch as tensors

    def observations(self, batch: Batch) -> Observations:
        """The observations as the workers' policy saw them."""
        raw, x, images = self._normalizer.inputs(batch.obs, self._buffers)
        return Observations(raw, self._flat_tensor(x), tuple(map(self._flat_tensor, images)), self._recurrent_input(batch))

    def _recurrent_input(self, batch: Batch) -> RecurrentInput | None:
        """The states before all T+1 steps, and where they are reset; None without a core."""
        if self.policy.core is None:
            return None
        keep_state = np.concatenate([np.ones_like(batch.valid[:1]), batch.valid]).astype(np.float32)
        return RecurrentInput(self._to_device(batch.state), self._to_device(keep_state))

    def rewards(self, batch: Batch) -> Floats:
        """Rewards [T, ΣN], scaled if the settings say so. Updates the scale: call it once for each batch."""
        return self._reward_scaler.scale(batch) if self.config.normalize_rewards else batch.reward

    def values(self, observations: Observations, pulse: Pulse) -> Floats:
        """V(obs) [T+1, ΣN] under the present weights."""
        fused = self._fused

        def value(inputs: NetworkInput, _: Index) -> Tensor:
            return self.net.value(*inputs) if fused is None else torch.from_numpy(fused.value(inputs.features.numpy()))

        return self._evaluate_in_chunks(observations, len(observations.raw_features), value, pulse)

    def log_probs(self, observations: Observations, batch: Batch, pulse: Pulse) -> Floats:
        """Log π(action) [T, ΣN] under the present weights."""
        action = self._flat_tensor(batch.action)
        mask = self._allowed(batch)

        def log_prob(inputs: NetworkInput, rows: Index) -> Tensor:
            params = _forbid(self.net.params(*inputs), None if mask is None else mask[rows])
            return log_prob_and_entropy(self.policy.action, params, action[rows])[0]

        return self._evaluate_in_chunks(observations, len(batch.valid), log_prob, pulse)

    def _evaluate_in_chunks(
        self, observations: Observations, steps: int, function: Callable[[NetworkInput, Index], Tensor], pulse: Pulse
    ) -> Floats:
        """Apply `function` to the observations of the first `steps` steps, in chunks and without gradients.

        `function` returns one number for each row. Returns [steps, ΣN]. `pulse` is called after each chunk.
        """
        found = torch.empty(steps * observations.raw_features.shape[1], device=self.net.flat.device)
        with torch.no_grad():
            for columns, rows in self._chunks(steps, observations.raw_features.shape[1]):
                found[rows] = function(observations.network_input(steps, columns, rows), rows)
                pulse()
        return np.asarray(found.cpu().numpy()).reshape(steps, -1)

    def _chunks(self, steps: int, columns: int) -> Iterator[tuple[Index, Index]]:
        """The columns and rows of each chunk, which has about CHUNK_ROWS rows.

        A chunk holds consecutive rows; with a recurrent core it holds whole columns.
        """
        if self.policy.core is None:
            for at in range(0, steps * columns, CHUNK_ROWS):
                yield slice(None), slice(at, min(at + CHUNK_ROWS, steps * columns))
            return
        for some in torch.split(torch.arange(columns, device=self.net.flat.device), max(1, CHUNK_ROWS // steps)):
            yield some, rows_of_columns(steps, columns, some)

    def _flat_tensor(self, array: Array) -> Tensor:
        """[T, N, …] as [T · N, …] on the device of the weights."""
        return self._to_device(array.reshape(array.shape[0] * array.shape[1], *array.shape[2:]))

    def _to_device(self, array: Array) -> Tensor:
        return torch.from_numpy(array).to(self.net.flat.device)

    # ---------------------------------------------------------------- minibatches

    def rows(self, batch: Batch, observations: Observations, estimates: Estimates) -> Minibatch:
        """All T · ΣN rows of a batch, also those that are not valid."""
        inputs = observations.network_input(len(batch.valid), slice(None), slice(batch.valid.size))
        return Minibatch(
            inputs.features,
            inputs.images,
            self._flat_tensor(batch.action),
            self._flat_tensor(batch.log_prob),
            self._flat_tensor(estimates.advantage),
            self._flat_tensor(estimates.target),
            inputs.recurrent,
            self._allowed(batch),
        )

    def _allowed(self, batch: Batch) -> Tensor | None:
        """The masks [T · ΣN, choices] of a batch, if it has them."""
        return None if batch.mask is None else self._flat_tensor(batch.mask[:-1])

    def _epochs(self, rows: Minibatch, mask: Bools) -> Iterator[Iterable[Minibatch]]:
        """The minibatches of each epoch, without end. A single minibatch is made once, with its rows in order."""
        selected = int(np.count_nonzero(mask))
        count = self.minibatch_count(selected)
        single: tuple[Minibatch, ...] = ()
        if selected and count == 1 and not self.shuffles_single_minibatch:
            single = (self.select(rows, mask),)
        while True:
            yield single or self.minibatches(rows, mask, count)

    def select(self, rows: Minibatch, mask: Bools) -> Minibatch:
        """The rows where `mask` [T, ΣN] is True, in order."""
        if rows.recurrent is None:
            index = np.flatnonzero(mask)
            return rows.in_numpy().select(index) if self._in_numpy(len(index)) else rows.select(self._to_device(index))
        return rows.select_columns(self._to_device(np.arange(mask.shape[1])), self._to_device(mask))

    def minibatches(self, rows: Minibatch, mask: Bools, count: int) -> Iterator[Minibatch]:
        """Shuffle the rows where `mask` [T, ΣN] is True into `count` minibatches of nearly equal size. Each row occurs once.

        With a core, whole columns stay together, because the core learns from rows that follow each other. Then there are at
        most as many minibatches as columns.
        """
        if not mask.any():
            return
        if rows.recurrent is None:
            index = np.flatnonzero(mask)
            if self._in_numpy(math.ceil(len(index) / count)):
                rows = rows.in_numpy()
                for some in np.array_split(self._shuffled(index), count):
                    yield rows.select(some)
                return
            for chosen in self._to_device(self._shuffled(index)).tensor_split(count):
                yield rows.select(chosen)
            return
        columns = np.flatnonzero(mask.any(0))  # a column without a row would make an empty minibatch
        for chosen in self._to_device(self._shuffled(columns)).tensor_split(min(count, len(columns))):
            yield rows.select_columns(chosen, self._to_device(mask))

    def _in_numpy(self, rows: int) -> bool:
        """Whether the network is evaluated in numpy for a minibatch of `rows` rows."""
        return self._fused is not None and rows <= MAX_ROWS

    def _shuffled(self, index: Array) -> Array:
        shuffled: Array = index[torch.randperm(len(index), generator=self.generator).numpy()]
        return shuffled

    # ---------------------------------------------------------------- weights and checkpoints

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the acting parameters [P] and of the buffers, as `protocol.policy.layout` lays them out."""
        return self.net.flat[: self.net.acting_size].cpu().numpy().copy(), self._buffers.copy()

    def is_finite(self) -> bool:
        """Whether all weights are finite, also those that do not act, and the observation statistics."""
        return bool(torch.isfinite(self.net.flat).all() and np.isfinite(self._buffers).all())

    def state_dict(self) -> dict[str, Any]:
        """A copy of everything that the next update depends on: tensors and plain data (`torch.load(weights_only=True)`)."""
        return {
            "parameters": self.net.flat.clone(),
            "optimizer": state_of(self.optimizer),
            "generator": self.generator.get_state(),
            "observations": self._normalizer.state_dict(),
            "rewards": self._reward_scaler.state_dict(),
            "env_steps": self.env_steps,
            "version": self.version,
            "clone_steps": self.clone_steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`: the next update is the one that would have followed it, bit for bit."""
        self.net.flat.copy_(state["parameters"])
        load_state(self.optimizer, state["optimizer"])
        self.generator.set_state(state["generator"])
        self._normalizer.load_state_dict(state["observations"])
        self._reward_scaler.load_state_dict(state["rewards"])
        self._buffers = self._normalizer.buffers()
        self.env_steps, self.version = state["env_steps"], state["version"]
        self.clone_steps = state["clone_steps"]

    def start_from(self, start: Start) -> None:
        """See `Algorithm.start_from`. The spread of actions is part of the policy."""
        self.load_state_dict(start.into(self.state_dict(), ("parameters",), ("optimizer",)))

    def remember(self) -> None:
        """Remember this state, for `roll_back`."""
        self._remembered = self.state_dict()

    def roll_back(self) -> None:
        """Return to the state that was remembered last."""
        self.load_state_dict(self._remembered)


def _forbid(params: Tensor, mask: Tensor | None) -> Tensor:
    """Logits [B, P] without the choices that a mask forbids: their probabilities and gradients are exactly 0."""
    return params if mask is None else params.masked_fill(~mask, FORBIDDEN)


def make_optimizer(kind: Literal["adam", "rmsprop"], net: ActorCriticNetwork, learning_rate: float) -> torch.optim.Optimizer:
    """An optimizer of the flat parameters, with ε 1e-5 outside the square root, as in Stable-Baselines3."""
    avoid_compiler_import()
    if kind == "adam":
        return torch.optim.Adam([net.flat], lr=learning_rate, eps=1e-5, fused=True)
    return torch.optim.RMSprop([net.flat], lr=learning_rate, alpha=0.99, eps=1e-5)


def _loss_gradients_are_of_this_loss(algorithm: type[ActorCritic]) -> bool:
    """False for a class that overrides `loss` but not `loss_gradients`."""
    for owner in algorithm.__mro__:
        if "loss_gradients" in vars(owner):
            return True
        if "loss" in vars(owner):
            return False
    return False


def _explained_variance(estimates: Estimates) -> float:
    mask = estimates.mask
    return losses.explained_variance(estimates.values[:-1][mask], estimates.target[mask])


def _means(measured: Sequence[Metrics]) -> Metrics:
    """The mean of each metric over the measurements that have it, with the prefix "train/"."""
    by_name: dict[str, list[float]] = {}
    for each in measured:
        for name, number in each.items():
            by_name.setdefault(name, []).append(number)
    return {f"train/{name}": sum(found) / len(found) for name, found in by_name.items()}
