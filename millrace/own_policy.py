"""A user-defined policy: the callable that makes it in the workers, and its declared arrays. Imports no torch."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from millrace.arguments import plain
from millrace.protocol.env_spec import PickledCallable, Scalar, check_arguments
from millrace.protocol.errors import UsageError, safe_repr
from millrace.protocol.policy.called_policy import LOG_PROB
from millrace.protocol.specs import ActionSpec, ExtraArray, Leaf, NamedShape, OwnPolicySpec, PolicySpec
from millrace.protocol.wire.codec import DTYPES

BATCH_NAMES = frozenset(
    {"obs", "action", "reward", "terminated", "truncated", "valid", "state", "lane", "version", "fresh", "episodes", "mask"}
)


@dataclass(frozen=True)
class OwnPolicy:
    """Your own policy for `RolloutService`: any network and distribution, in any framework that the workers have installed.

    >>> import millrace, numpy
    >>> class Policy:
    ...     def load(self, arrays):                     # for each version of the weights
    ...         self.arrays = arrays                    # {"w": float32 [4, 2]}
    ...
    ...     def act(self, obs, state, rng):             # obs [N, 4] of the N columns of a lane
    ...         logits = obs @ self.arrays["w"]
    ...         action = (logits + rng.gumbel(size=logits.shape)).argmax(-1)
    ...         return action, state, {"logits": logits}
    >>> policy = millrace.OwnPolicy(Policy, {"w": (4, 2)}, extras={"logits": ("float32", (2,))})
    >>> with millrace.RolloutService("CartPole-v1", policy, workers=1, envs=2, lanes=1, rollout_steps=8) as service:
    ...     _ = service.publish({"w": numpy.zeros((4, 2))})
    ...     service.gather().extras["logits"].shape
    (8, 2, 2)

    Each worker calls `factory(**kwargs)`, which returns such an object. `act` is called once for each step of a lane, with
    the observations of all its copies. If copies have several agents, these are the observations of all agents, including
    those that wait or have left. If a worker continues a lane from states that the environment has saved, it calls `act`
    once more, as a check. `state` [N, state_size] float32 is the policy's memory, which is zero when an episode
    begins. If the object stores nothing else between calls, results do not depend on the number of workers. An action
    consists of whole numbers that count from 0, or of float32 numbers, which are clipped to the space after they were
    stored. If the environment has action masks, `act` also gets `mask=` [N, choices] bool, and must choose an allowed
    action. `service.evaluate` calls the object's `act_greedy` if it has one, and `act` otherwise. See also
    docs/how-to/own_learner.md.
    """

    factory: str | Callable[..., object]
    """`module:callable`, which every worker can import; or a callable, which is sent to the workers by cloudpickle (over
    ipc, inproc, or tcp with keys)"""
    arrays: Mapping[str, tuple[int, ...]]
    """shape of each parameter array, by name: `publish` takes these arrays, and `load` gets them as float32"""
    extras: Mapping[str, Any] = field(default_factory=dict)
    """dtype of each further array that `act` returns, by name, as numpy.dtype takes it: `"float32"` for one number per
    action, `("float32", (2,))` for an array of shape [2] per action. `log_prob` must be float32; it becomes `batch.log_prob`
    """
    state_size: int = 0
    """S, the number of floats in the state of one column"""
    kwargs: Mapping[str, Scalar] = field(default_factory=dict)
    """keyword arguments of the factory"""

    def __post_init__(self) -> None:
        for name in ("arrays", "extras", "state_size", "kwargs"):
            object.__setattr__(self, name, plain(getattr(self, name)))

    @property
    def name(self) -> str:
        """The policy's name in errors."""
        return (
            self.factory if isinstance(self.factory, str) else getattr(self.factory, "__name__", type(self.factory).__name__)
        )

    @property
    def extra_arrays(self) -> tuple[ExtraArray, ...]:
        """The declared extras except `log_prob`. Raises `UsageError` if a declaration can't be used."""
        return tuple(extra for extra in self._declared() if extra != LOG_PROB)

    def spec(self, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """The specification of the policy for these spaces. Raises `UsageError` if a declaration can't be used."""
        if not (isinstance(self.factory, str) or callable(self.factory)):
            raise UsageError(f"policy: factory: expected module:callable or a callable, got {self.factory!r:.60}")
        for name, table in (("arrays", self.arrays), ("extras", self.extras), ("kwargs", self.kwargs)):
            if not isinstance(table, Mapping):
                raise UsageError(f"policy {self.name}: {name}: expected a dict, got {table!r:.60}")
        if isinstance(self.factory, str) and not all(self.factory.partition(":")):
            raise UsageError(f"policy {self.factory}: expected module:factory, as in my_package.policies:make_policy")
        if not (type(self.state_size) is int and self.state_size >= 0):
            raise UsageError(
                f"policy {self.name}: state_size: expected a whole number from 0, got {safe_repr(self.state_size)}"
            )
        check_arguments(self.kwargs, f"policy {self.name}", self.name.rpartition(":")[2] + "({name}={name})")
        for name in (*self.arrays, *self.extras):
            if not isinstance(name, str):
                raise UsageError(f"policy {self.name}: expected text as the name of an array, got {safe_repr(name)}")
        own = OwnPolicySpec(
            self.name,
            tuple(NamedShape(name, self._shape(name, shape)) for name, shape in self.arrays.items()),
            dict(self.kwargs),
            self.state_size,
            LOG_PROB in self._declared(),
            None if isinstance(self.factory, str) else PickledCallable.of(self.factory, f"policy {self.name}"),
        )
        return PolicySpec(observation, action, own=own)

    def _shape(self, name: str, shape: Any) -> tuple[int, ...]:
        sides = tuple(shape) if isinstance(shape, (tuple, list)) else (None,)
        if not (all(type(side) is int and side > 0 for side in sides) and math.prod(sides)):
            raise UsageError(f"policy {self.name}: array {name}: expected a shape, as (64, 4), got {safe_repr(shape)}")
        return sides

    def _declared(self) -> tuple[ExtraArray, ...]:
        arrays = []
        for name, dtype in self.extras.items():
            try:
                kind = np.dtype(dtype)
            except (TypeError, ValueError) as error:
                raise UsageError(f"policy {self.name}: extra {name}: {_EXPECTED}, got {safe_repr(dtype)}") from error
            extra = ExtraArray(name, kind.shape, kind.base.name)
            if kind.base.str not in DTYPES:
                raise UsageError(f"policy {self.name}: extra {name}: {_EXPECTED}, got {safe_repr(dtype)}")
            if name in BATCH_NAMES or (name == LOG_PROB.name and extra != LOG_PROB):
                expected = (
                    "float32 for each action" if name == LOG_PROB.name else "another name; a batch has an array of this one"
                )
                raise UsageError(f"policy {self.name}: extra {name}: expected {expected}")
            arrays.append(extra)
        return tuple(arrays)


_EXPECTED = 'expected a dtype of numbers as numpy.dtype takes it, "float32" or ("float32", (2,))'
