"""The base of algorithms that learn from a replay buffer: what an update does besides its gradient steps, and the state.

No sockets, no files, no clock; seeded. The buffer holds raw observations and rewards. They are normalized when they are
drawn, with the current statistics. With one torch thread on a CPU the same batches give the same bits, also after
`load_state_dict`.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, ClassVar

import msgspec
import numpy as np
from torch import Tensor
from torch.optim import Optimizer

from learner.algorithms.algorithm import Algorithm, Start
from learner.algorithms.kernels.optimizer_step import load_state, state_of
from learner.algorithms.normalization import ObservationNormalizer, RewardScaler
from learner.algorithms.replay.mixed_replay import MixedReplay
from learner.algorithms.replay.replay_buffer import Sample
from learner.algorithms.updates import scheduled
from learner.config.hyperparameters import AlgorithmConfig, OffPolicyConfig
from protocol.arrays import Array, Floats
from protocol.policy.features import features
from protocol.rollout import Batch
from protocol.specs import PolicySpec


class OffPolicy(Algorithm):
    """An algorithm with a replay buffer. An update adds a batch to the buffer and makes the gradient steps that are due.

    A subclass writes `__init__`, `steps_due`, `step` and `weights`, and puts everything that a gradient step changes into
    `tensors`, `optimizers` and `numbers`.
    """

    Config: ClassVar[type[AlgorithmConfig]] = OffPolicyConfig
    config: Any
    tensors: dict[str, Tensor]
    """The tensors that gradient steps change in place, by their names in the saved state."""
    optimizers: dict[str, Optimizer]
    """The optimizers, each of one flat tensor, by their names in the saved state."""

    def __init__(
        self, config: OffPolicyConfig, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu"
    ) -> None:
        self.config = config
        self.policy = policy
        self.replay = MixedReplay(
            policy.observation,
            size=config.replay_size,
            n_step=config.n_step,
            gamma=config.gamma,
            seed=seed,
            alpha=config.priority_alpha if config.replay == "prioritized" else None,
            action=policy.action,
            prior_share=config.prior_share,
        )
        self.env_steps = 0  # valid rows used so far; schedules depend on it
        self.version = 0  # updates made
        self.gradient_steps = 0  # what Stable-Baselines3 calls n_updates
        self.prior_gradient_steps = 0  # of these, the ones before the first rollouts
        self._total_steps = total_steps
        # The buffers of the policy also hold what exploration needs: so the normalizer gets the policy with another head.
        self.normalizer = ObservationNormalizer(msgspec.structs.replace(policy, head="actor_critic"))
        self.statistics: Floats = self.normalizer.buffers()
        self.rewards = RewardScaler(config.gamma)
        self._remembered: dict[str, Any] = {}

    @abstractmethod
    def steps_due(self) -> int:
        """The number of gradient steps of this update, whose batch is in the buffer and counted in `env_steps`."""

    @abstractmethod
    def step(self, sample: Sample) -> Sequence[float]:
        """One gradient step on a minibatch. Adds 1 to `gradient_steps`, and updates the priorities.

        Returns a NamedTuple of metrics, with NaN for what this step did not measure. Raises `RunError` when a loss or a
        gradient is not finite, before it reaches the weights.
        """

    def update(self, batch: Batch, pulse: Callable[[], None]) -> dict[str, float]:
        """Add a batch to the replay buffer and learn from it, calling `pulse` between gradient steps. Returns metrics.

        Raises `RunError` when a loss or a gradient is not finite, before it reaches the weights.
        """
        config = self.config
        learning_rate = self._set_learning_rate()
        beta = config.priority_beta + (1 - config.priority_beta) * self._done()
        self.replay.add(batch)
        self._count(batch)
        self.statistics = self.normalizer.buffers()
        self.env_steps += batch.env_steps
        self.version += 1
        measured: list[Any] = []
        for sample in self.samples(self.steps_due() if len(self.replay) else 0, beta):
            measured.append(self.step(sample))
            pulse()
        metrics = {
            "train/learning_rate": learning_rate,
            "train/n_updates": float(self.gradient_steps),
            "replay/size": float(len(self.replay)),
            "replay/bytes": float(self.replay.bytes),
        }
        if measured:
            metrics |= {f"train/{name}": number for name, number in _means(measured).items()}
            metrics["replay/env_steps_per_gradient_step"] = batch.env_steps / len(measured)
        return metrics

    def _count(self, batch: Batch) -> None:
        """Count a batch for the statistics."""
        if self.config.normalize_rewards:
            self.rewards.count(batch)
        self.normalizer.update(features(self.policy, batch.obs)[:-1], batch.valid)

    def _done(self) -> float:
        """The fraction of the run that is done: 0 in the first update, below 1 in the last."""
        return min(1.0, self.env_steps / self._total_steps)

    def _set_learning_rate(self) -> float:
        """Set the learning rate that the settings and the schedule say, and return it."""
        learning_rate = scheduled(self.config.learning_rate, self.config.learning_rate_schedule, 1 - self._done())
        for optimizer in self.optimizers.values():
            optimizer.param_groups[0]["lr"] = learning_rate
        return learning_rate

    def add_prior(self, batches: Iterable[Batch], observations: int) -> None:
        """Store the rows of a dataset beside the replay buffer. They count for all statistics."""

        def counted() -> Iterator[Batch]:
            for batch in batches:
                self._count(batch)
                yield batch

        self.replay.add_prior(counted(), observations)
        self.statistics = self.normalizer.buffers()

    def learn_from_prior(self, pulse: Callable[[], None]) -> None:
        """Make `prior_steps` gradient steps on prior data alone, less those that were made."""
        self._set_learning_rate()  # a state that was loaded may have another
        for sample in self.samples(self.config.prior_steps - self.prior_gradient_steps):
            self.step(sample)
            self.prior_gradient_steps += 1
            pulse()

    def samples(self, number: int, beta: float = 1.0) -> Iterator[Sample]:
        """Minibatches from the replay buffer and from prior data. `beta`: see `ReplayBuffer.sample`."""
        for drawn in self.replay.samples(number, self.config.batch_size, beta):
            if self.config.normalize_rewards:
                drawn = drawn._replace(reward=self.rewards.scaled(drawn.reward))
            yield drawn

    def inputs(self, leaves: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Features [B, D], normalized with the current statistics, and images [B, *leaf] uint8, of leaves [B, *leaf]."""
        _, x, images = self.normalizer.inputs(leaves, self.statistics)
        return x, images

    def is_finite(self) -> bool:
        """Whether all weights are finite, also those that do not act, and the observation statistics."""
        return bool(all(tensor.isfinite().all() for tensor in self.tensors.values()) and np.isfinite(self.statistics).all())

    # ---------------------------------------------------------------- the state

    def numbers(self) -> dict[str, Any]:
        """What the next update depends on besides tensors, optimizers, statistics and the buffer: plain data, copied."""
        names = ("env_steps", "version", "gradient_steps", "prior_gradient_steps")
        return {name: getattr(self, name) for name in names}

    def load_numbers(self, state: dict[str, Any]) -> None:
        """Continue from `numbers`."""
        self.env_steps, self.version = state["env_steps"], state["version"]
        self.gradient_steps = state["gradient_steps"]
        self.prior_gradient_steps = state.get("prior_gradient_steps", 0)  # a state of an earlier millrace has none

    def state_dict(self) -> dict[str, Any]:
        """A copy of everything that the next update depends on: tensors and plain data (`torch.load(weights_only=True)`)."""
        return self._small_state() | {"replay": self.replay.state_dict()}

    def _small_state(self) -> dict[str, Any]:
        """The state without the replay buffer."""
        return (
            {name: tensor.clone() for name, tensor in self.tensors.items()}
            | {name: state_of(optimizer) for name, optimizer in self.optimizers.items()}
            | {"observations": self.normalizer.state_dict()}
            | ({"rewards": self.rewards.state_dict()} if self.config.normalize_rewards else {})
            | self.numbers()
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`: the next update is the one that would have followed it, bit for bit."""
        self._load_small_state(state)
        self.replay.load_state_dict(state["replay"])

    def start_from(self, start: Start) -> None:
        """See `Algorithm.start_from`. The target network starts as the network; the replay buffer is empty."""
        self._load_small_state(start.into(self._small_state(), self.tensors, self.optimizers))

    def remember(self) -> None:
        """Remember this state, for `roll_back`. Of the replay buffer, only what changes from now on is copied."""
        self._remembered = self._small_state()
        self.replay.remember()

    def roll_back(self) -> None:
        """Return to the state that was remembered last."""
        self._load_small_state(self._remembered)
        self.replay.roll_back()

    def _load_small_state(self, state: dict[str, Any]) -> None:
        for name, tensor in self.tensors.items():
            tensor.copy_(state[name])
        for name, optimizer in self.optimizers.items():
            load_state(optimizer, state[name])
        self.normalizer.load_state_dict(state["observations"])
        self.statistics = self.normalizer.buffers()
        if self.config.normalize_rewards:
            self.rewards.load_state_dict(state["rewards"])
        self.load_numbers(state)


def _means(measured: Sequence[Any]) -> dict[str, float]:
    """The mean of each metric over the steps that measured it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # no step measured it
        means = np.nanmean(np.array(measured), 0).tolist()
    return {name: mean for name, mean in zip(measured[0]._fields, means, strict=True) if mean == mean}
