"""The learning algorithms. No sockets, no files.

Each algorithm is one class in one file. Its settings are one record in `learner.config.hyperparameters`. `ALGORITHMS` here
and `HYPERPARAMETERS` there list them by name. Importing this module does not import torch; calling `algorithm_class` does.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, ClassVar, Protocol

from protocol.arrays import Floats
from protocol.rollout import Batch
from protocol.specs import ActionSpec, Leaf, PolicySpec

ALGORITHMS = {
    "ppo": "learner.algorithms.ppo:PPO",
    "a2c": "learner.algorithms.a2c:A2C",
    "dqn": "learner.algorithms.dqn:DQN",
    "impala": "learner.algorithms.impala:Impala",
    "reinforce": "learner.algorithms.reinforce:REINFORCE",
}
"""`module:Class` of each algorithm, imported when it is used"""


class Algorithm(Protocol):
    """The interface of an algorithm, as the training loop of `learner.train` uses it."""

    whole_episodes: ClassVar[bool]
    """True if the algorithm learns only from whole episodes: a run whose rollouts are too short for one is refused."""

    @staticmethod
    def policy_spec(config: Any, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """The policy to train. Raises `UsageError`, with a one-line message, if the algorithm cannot use these spaces."""
        ...

    def __init__(self, config: Any, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu") -> None:
        """`config` is a record of `HYPERPARAMETERS`. Raises `UsageError` if this machine cannot do what it asks for."""
        ...

    def update(self, batch: Batch, pulse: Callable[[], None]) -> dict[str, float]:
        """Learn from a batch and return metrics by name.

        Calls `pulse` between gradient steps, so that the learner can answer its workers meanwhile.
        """
        ...

    def remember(self) -> None:
        """Remember this state, for `roll_back`. Called before each update, so it must be quick."""
        ...

    def roll_back(self) -> None:
        """Return to the state that was remembered last, from any state in between: an update was not made whole."""
        ...

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the acting parameters [P] and of the policy's buffers, both float32, for a `Weights` message."""
        ...

    def is_finite(self) -> bool:
        """Whether all weights are finite, also those that do not act, and the policy's buffers. Called after each update."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """A copy of everything that the next update depends on, as tensors and plain data."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        ...


def algorithm_class(name: str) -> type[Algorithm]:
    """The class of an algorithm in `ALGORITHMS`, imported now. Raises KeyError for any other name."""
    module, _, attribute = ALGORITHMS[name].partition(":")
    found: type[Algorithm] = getattr(import_module(module), attribute)
    return found
