"""The base class of algorithms with a replay buffer: everything about an update except its gradient steps.

DQN derives from it directly; SAC, TD3 and their variants derive from it through `continuous.py`. These algorithms define
`steps_due`, the number of gradient steps in an update, and `step`, which takes one gradient step, adds 1 to `gradient_steps`
and moves the target networks.

The buffer holds raw observations and rewards. They are normalized when they are drawn, with the current statistics. With one
torch thread on a CPU, the same batches give the same bits, even after `load_state_dict`. This module uses no sockets, no
files and no clock, and all randomness comes from the seed.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar, NamedTuple

from msgspec.structs import replace
from torch import Tensor

from millrace.learner.algorithms.gradient_descent import GradientDescent, UpdateMetrics
from millrace.learner.algorithms.prior_data import PriorData
from millrace.learner.algorithms.replay.hindsight import Hindsight
from millrace.learner.algorithms.replay.mixed_replay import MixedReplay
from millrace.learner.algorithms.replay.replay_buffer import Sample
from millrace.learner.algorithms.replay.sequence_replay import SequenceReplay, SequenceSample
from millrace.learner.algorithms.replay.transitions import Sequences, Transitions
from millrace.learner.config.hyperparameters import AlgorithmConfig, OffPolicyConfig
from millrace.protocol.arrays import Array
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.encoder import RecurrentInput
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec


class CriticLoss(NamedTuple):
    """The loss of the critics or the Q-network on a minibatch."""

    loss: Tensor
    """the loss, a 0-dimensional tensor"""
    error: Tensor
    """[B] TD errors, or their absolute values, from which prioritized replay computes priorities"""
    numbers: Mapping[str, Tensor | float]
    """the numbers to log, by name"""


class OffPolicy(GradientDescent):
    """An algorithm with a replay buffer. An update adds a batch to the buffer and takes the gradient steps that are due.

    A subclass defines `__init__`, `steps_due`, `step` and `weights`.
    """

    Config: ClassVar[type[AlgorithmConfig]] = OffPolicyConfig

    @staticmethod
    def policy_spec(config: Any, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """See `Algorithm.policy_spec`. Raises `UsageError` if the settings ask for hindsight that the run can't use."""
        Hindsight.of(config, observation)
        spec = GradientDescent.policy_spec(config, observation, action)
        return replace(spec, core=config.core, core_size=config.core_size)

    def __init__(self, config: OffPolicyConfig, policy: PolicySpec, *, total_steps: int, seed: int) -> None:
        super().__init__(config, policy, total_steps=total_steps)
        self.replay = self._make_replay(config, policy, seed)
        self.gradient_steps = 0  # all gradient steps so far, which Stable-Baselines3 calls n_updates
        self.prior_gradient_steps = 0  # how many of them preceded the first rollouts

    @staticmethod
    def _make_replay(config: OffPolicyConfig, policy: PolicySpec, seed: int) -> MixedReplay | SequenceReplay:
        if policy.core is not None:
            return SequenceReplay(
                policy,
                rows=config.replay_size,
                steps=config.rollout_steps,
                n_step=config.n_step,
                gamma=config.gamma,
                seed=seed,
                alpha=config.priority_alpha or None,
            )
        return MixedReplay(
            policy.observation,
            size=config.replay_size,
            n_step=config.n_step,
            gamma=config.gamma,
            seed=seed,
            alpha=config.priority_alpha or None,
            action=policy.action,
            hindsight=Hindsight.of(config, policy.observation),
        )

    @abstractmethod
    def steps_due(self) -> int:
        """The number of gradient steps to take in this update.

        The update's batch is already in the buffer and counted in `env_steps`.
        """

    @abstractmethod
    def step(self, rows: Transitions) -> tuple[UpdateMetrics, Tensor]:
        """Take one gradient step on a minibatch, and add 1 to `gradient_steps`. Returns its metrics, and the TD errors [B].

        If a loss or a gradient is not finite, raises `RunError` before it changes the weights.
        """

    def update(self, batch: Batch, pulse: Callable[[], None]) -> UpdateMetrics:
        """Add a batch to the replay buffer, then take the gradient steps that are due. Returns metrics.

        Calls `pulse` between gradient steps. If a loss or a gradient is not finite, raises `RunError` before it changes the
        weights.
        """
        self.set_schedules()
        beta = 1 - (1 - self.config.priority_beta) * self.remaining()
        self.replay.add(batch)
        self.count(batch)
        self.statistics = self.normalizer.buffers()
        self.env_steps += batch.env_steps
        measured = list(self.steps(self.steps_due() if len(self.replay) else 0, pulse, beta))
        self.version += 1
        metrics = {
            "train/learning_rate": self.learning_rate,
            "train/n_updates": float(self.gradient_steps),
            "replay/size": float(len(self.replay)),
            "replay/bytes": float(self.replay.bytes),
        } | self.means(measured)
        if measured:
            metrics["replay/env_steps_per_gradient_step"] = batch.env_steps / len(measured)
        return metrics

    def steps(self, number: int, pulse: Callable[[], None], beta: float = 1.0) -> Iterator[UpdateMetrics]:
        """Take gradient steps on minibatches from the replay buffer and the prior data, yielding each step's metrics.

        For `beta`, see `ReplayBuffer.sample`.
        """
        for sample in self.replay.samples(number, self.config.batch_size, beta):
            metrics, error = self.step(self.transitions(sample))
            if self.replay.prioritized:
                self.replay.update_priorities(sample.slots, error.detach().cpu().numpy())
            yield metrics
            pulse()

    def transitions(self, sample: Sample | SequenceSample) -> Transitions:
        """A sample as tensors on the weights' device, normalized if the settings say so."""
        if isinstance(sample, SequenceSample):
            return self._of_sequences(sample)
        next_x, next_images = self.inputs(sample.next_leaves)
        return Transitions(
            *self.inputs(sample.leaves),
            self.tensor(sample.action),
            self._number(self.scaled(sample.reward)),
            self._number(sample.discount),
            next_x,
            next_images,
            None if sample.next_mask is None else self.tensor(sample.next_mask),
            self._number(sample.weight),
            next_x,
        )

    def _of_sequences(self, sample: SequenceSample) -> Transitions:
        steps, columns = sample.keep_state.shape
        x, images = self.inputs([leaf.reshape(steps * columns, *leaf.shape[2:]) for leaf in sample.leaves])
        keep_state = self._number(sample.keep_state)
        advances = self.tensor(sample.advances)
        half = steps // 2
        sequences = Sequences(
            RecurrentInput(self._number(sample.state), keep_state[:half], advances=advances[:half]),
            keep_state[half:],
            advances[half:],
            self.tensor(sample.rows),
            self.tensor(sample.next_rows),
        )
        return Transitions(
            x,
            images,
            self.tensor(sample.action),
            self._number(self.scaled(sample.reward)),
            self._number(sample.discount),
            x,
            images,
            None if sample.next_mask is None else self.tensor(sample.next_mask),
            self._number(sample.weight),
            x,
            sequences,
        )

    def _number(self, array: Array) -> Tensor:
        """The array as a tensor with the weights' dtype, on their device."""
        return self.tensor(array).to(self.net.flat.dtype)

    # ---------------------------------------------------------------- prior data

    def add_prior(self, prior: PriorData) -> None:
        """Store the rows of a dataset alongside the replay buffer, and add them to all running statistics.

        Raises `UsageError` if the policy has a recurrent core, because a dataset has no core states.
        """
        if isinstance(self.replay, SequenceReplay):
            raise UsageError(f"prior: expected no recurrent core, got {self.policy.core}; take --core none, or no --prior")

        def counted() -> Iterator[Batch]:
            for batch in prior.batches():
                self.count(batch)
                yield batch

        self.replay.add_prior(counted(), prior.rows + prior.episodes, self.config.prior_share)
        self.statistics = self.normalizer.buffers()

    def learn_from_prior(self, pulse: Callable[[], None]) -> None:
        """Take `prior_steps` gradient steps on only prior data, except those already taken."""
        self.set_schedules()  # loading a state may have changed the learning rate
        for _ in self.steps(self.config.prior_steps - self.prior_gradient_steps, pulse):
            self.prior_gradient_steps += 1

    # ---------------------------------------------------------------- the state

    def other_state(self) -> dict[str, Any]:
        """See `GradientDescent`."""
        counts = {"gradient_steps": self.gradient_steps, "prior_gradient_steps": self.prior_gradient_steps}
        return super().other_state() | counts

    def load_other_state(self, state: dict[str, Any]) -> None:
        """See `GradientDescent`."""
        super().load_other_state(state)
        self.gradient_steps = state["gradient_steps"]
        self.prior_gradient_steps = state["prior_gradient_steps"]

    def state_dict(self) -> dict[str, Any]:
        """See `GradientDescent`. The state includes the replay buffer."""
        return super().state_dict() | {"replay": self.replay.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `GradientDescent`."""
        super().load_state_dict(state)
        self.replay.load_state_dict(state["replay"])

    def remember(self) -> None:
        """Remember the current state, for `roll_back`. The replay buffer copies a slot only before it writes to the slot."""
        self._remembered = super().state_dict()
        self.replay.remember()

    def roll_back(self) -> None:
        """Return to the state of the last `remember`."""
        super().load_state_dict(self._remembered)
        self.replay.roll_back()
