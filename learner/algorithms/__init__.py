"""The mathematics of learning: no sockets and no files.

One file is one class, with its settings in `learner.config.hyperparameters`; each is entered in one dict there and here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from learner.algorithms.a2c import A2C
from learner.algorithms.dqn import DQN
from learner.algorithms.impala import Impala
from learner.algorithms.ppo import PPO
from learner.algorithms.reinforce import REINFORCE
from protocol.arrays import Floats
from protocol.rollout import Batch
from protocol.specs import ActionSpec, Leaf, PolicySpec


class Algorithm(Protocol):
    """What the loop of `learner.train` drives."""

    @staticmethod
    def policy_spec(config: Any, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """The policy that it learns. Raises `UsageError`, in one line, when it cannot learn on such spaces."""
        ...

    def __init__(self, config: Any, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu") -> None:
        """`config` is its record of `learner.config.hyperparameters`; raises `UsageError` when that cannot be done here."""
        ...

    def update(self, batch: Batch, pulse: Callable[[], None]) -> dict[str, float]:
        """Learn from a batch, calling `pulse` now and then; metrics by the names users know."""
        ...

    def weights(self) -> tuple[Floats, Floats]:
        """Copies of the acting parameters and of the policy's buffers: what `Weights` carries."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """A copy of all that the next update depends on, in tensors and plain data."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        ...


ALGORITHMS: dict[str, type[Algorithm]] = {
    "ppo": PPO,
    "a2c": A2C,
    "dqn": DQN,
    "impala": Impala,
    "reinforce": REINFORCE,
}
