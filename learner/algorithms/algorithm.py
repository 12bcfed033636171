"""The base class of every algorithm: the methods that the training loop (`millrace.learner.train`) calls.

This module also checks the results of these methods, because your own algorithm may return anything. If a result cannot be
used, a one-line error says why and names the class. This module doesn't need torch.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from millrace.learner.algorithms.prior_data import PriorData
from millrace.learner.config.hyperparameters import AlgorithmConfig
from millrace.protocol.arrays import Floats
from millrace.protocol.errors import UsageError, safe_repr
from millrace.protocol.policy.layout import acting_size, buffer_size
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec


class Start(NamedTuple):
    """The parts of an earlier run that a new run loads. Both runs' policies have the same `PolicySpec`."""

    state: dict[str, Any]
    """The `state_dict` of the earlier run's algorithm. If only that run's policy is known, the dict holds only `parameters`
    and perhaps the observation statistics, `observations`.
    """
    acting: int
    """The number P of acting parameters: the first P of the `parameters` compute actions."""
    critic: bool = False
    """Whether to load all weights, not only those that compute actions."""
    optimizer: bool = False
    """Whether to load the optimizers' moments, too."""

    def into(self, fresh: dict[str, Any], weights: Iterable[str], optimizers: Iterable[str]) -> dict[str, Any]:
        """The state `fresh` of a new algorithm, with some parts replaced by parts of the earlier run's state.

        `weights` and `optimizers` are the names of the tensors and the optimizers in the state. The first P numbers of
        `parameters` and `target` compute actions; if the new algorithm has no other parameters, the earlier one must have
        none either. Raises `ValueError` if a tensor's shape or dtype isn't the same in both algorithms.
        """
        state = self.state
        taken = dict[str, Any]()
        if "observations" in state:
            taken["observations"] = state["observations"]
        if "rewards" in state and "rewards" in fresh:
            taken["rewards"] = state["rewards"] | {"returns": {}}
        for name in weights if self.critic else {"parameters", "target"}.intersection(weights):
            own = taken[name] = fresh[name].clone()
            saved = state[name if self.critic else "parameters"]
            if not self.critic and len(own) > self.acting:
                own = own[: self.acting]
                saved = saved[: self.acting]
            if (saved.shape, saved.dtype) != (own.shape, own.dtype):
                raise ValueError(f"{name}: expected {own.dtype} {list(own.shape)}, got {saved.dtype} {list(saved.shape)}")
            own.copy_(saved)
        for name in optimizers if self.optimizer else ():
            taken[name] = fresh[name] | {"state": state[name]["state"]}
        return fresh | taken


class Algorithm(ABC):
    """The base class of every algorithm. An algorithm learns from batches, and provides the weights that workers act with.

    A subclass defines `__init__`, `update`, `weights`, `state_dict` and `load_state_dict`, and has its settings in `Config`.
    """

    Config: ClassVar[type[AlgorithmConfig]] = AlgorithmConfig
    """The record of the algorithm's settings. Its fields become flags, TOML keys and keyword arguments of a run."""

    whole_episodes: ClassVar[bool] = False
    """True if the algorithm learns only from whole episodes. Runs whose rollouts are shorter than an episode are refused."""

    @staticmethod
    def policy_spec(config: Any, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """The policy to train. By default, an actor and a critic for any space, with the layers that the settings give.

        Raises `UsageError`, with a one-line message, if the algorithm cannot use these spaces.
        """
        return PolicySpec(
            observation,
            action,
            net=config.net,
            activation=config.activation,
            normalize_observations=config.normalize_observations,
        )

    @abstractmethod
    def __init__(self, config: Any, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu") -> None:
        """Create the weights of version 0.

        `config` is an instance of `Config`. `total_steps` is the number of env steps of the run, which schedules need. All
        random numbers must derive from `seed`. `device` is "cpu" or "cuda". Raises `UsageError` if this machine cannot do
        what the settings ask for.
        """

    @abstractmethod
    def update(self, batch: Batch, pulse: Callable[[], None]) -> dict[str, float]:
        """Learn from a batch and return metrics by name, such as "train/loss".

        Must call `pulse` between gradient steps, so that the learner can answer its workers meanwhile, and must let any
        exception that `pulse` raises propagate. Must use only rows where `batch.valid` is True, and change no array of the
        batch. If a loss or a gradient is not finite, must raise `RunError` before it changes the weights (see
        `check_finite`).
        """

    @abstractmethod
    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the acting parameters [P] and of the policy's buffers, both float32, to be sent to the workers."""

    def is_finite(self) -> bool:
        """Whether all weights, including those that don't compute actions, and the policy's buffers are finite.

        Called after each update.
        """
        return all(bool(np.isfinite(array).all()) for array in self.weights())

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """A copy of everything that the next update depends on: tensors, numbers, text, and lists and dicts of these.

        Keys are text or whole numbers. The state of a PyTorch module or optimizer may be among it.
        """

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`: the next update gives the same bits as if the saved algorithm had continued."""

    def start_from(self, start: Start) -> None:
        """Load an earlier run's policy (`--from`), its statistics, and whatever else `start` names.

        Called once, on a new algorithm, before `add_prior`; a resumed run does not call it. By default, raises `UsageError`.
        """
        raise UsageError(f"{type(self).__name__} does not start from another run: it has no method start_from")

    def add_prior(self, prior: PriorData) -> None:
        """Accept the rows of a dataset (`--prior`) to learn from.

        Called once, before the first update and before `load_state_dict`. By default, raises `UsageError`.
        """
        raise UsageError(f"prior: {type(self).__name__} does not learn from prior data: it has no method add_prior")

    def learn_from_prior(self, pulse: Callable[[], None]) -> None:
        """Take the gradient steps on prior data that precede the first rollouts, except those already taken.

        By default, there are none. Like `update`, it calls `pulse` between gradient steps and may raise `RunError`.
        """
        return

    def remember(self) -> None:
        """Remember the current state, for `roll_back`. Called before each update, so it must be quick."""
        self._remembered = copy.deepcopy(self.state_dict())

    def roll_back(self) -> None:
        """Return to the state of the last `remember`. Must work even if the update stopped halfway."""
        self.load_state_dict(copy.deepcopy(self._remembered))


def numbers(metrics: Any, who: str) -> dict[str, float]:
    """The metrics of an update as floats, by name. Scalars from numpy and torch become floats, too.

    `who` is the name of the algorithm's class. Raises `UsageError` for anything but a dict of numbers by name.
    """
    if not isinstance(metrics, Mapping):
        raise UsageError(f"{who}.update: expected a dict of metrics, got {type(metrics).__name__}; return {{}} for none")
    numbers = {}
    for name, number in metrics.items():
        try:
            numbers[name] = float("text" if isinstance(number, str | bytes) or not isinstance(name, str) else number)
        except (TypeError, ValueError, OverflowError, RuntimeError):  # torch raises RuntimeError
            got = f"{type(number).__name__} for {safe_repr(name)}"
            raise UsageError(f"{who}.update: metrics: expected a name and a number, got {got}") from None
    return numbers


def wrong_weights(weights: Any, policy: PolicySpec) -> Iterator[str]:
    """Yield what is wrong with an algorithm's weights: one line for each array that doesn't fit the policy."""
    if not isinstance(weights, tuple) or len(weights) != 2:
        yield f"weights: expected a pair of arrays, got {type(weights).__name__}"
        return
    sizes = {"parameters": acting_size(policy), "buffers": buffer_size(policy)}
    for (name, size), array in zip(sizes.items(), weights, strict=True):
        if not isinstance(array, np.ndarray):
            yield f"weights: {name}: expected a numpy array, got {type(array).__name__}"
        elif array.dtype != np.float32 or array.shape != (size,):
            yield f"weights: {name}: expected float32[{size}], got {array.dtype}{list(array.shape)}"


def acting_weights(algorithm: Algorithm, policy: PolicySpec) -> tuple[Floats, Floats]:
    """The parameters and buffers that workers act with. Raises `UsageError` if they don't fit the policy."""
    weights = algorithm.weights()
    if why := next(wrong_weights(weights, policy), None):
        who = type(algorithm).__name__
        raise UsageError(f"{who}.{why}; millrace.testing.check_algorithm finds such mistakes before a run")
    return weights
