"""A user-defined policy that acts in a worker: it is made, called and checked here. Imports no torch.

The callable `factory(**kwargs)` returns an object with two methods. The second one acts for N env copies:

    load(arrays)             {name: float32 array} as declared; called for each version of the weights
    act(obs, state, rng)     -> action, state, extras

Both methods may change the arrays that they get. `obs` is an array [N, *shape]; for a Dict or Tuple observation, it is a
dict of such arrays, by path. `state` [N, S] float32 is zeros when an episode begins. `rng` is the numpy `Generator` of these
copies. `action` [N, *action] is stored as it is returned: whole numbers that count from 0, or float32 before clipping.
`extras` has one array [N, *shape] for each name that was declared. If there is a method `act_greedy(obs, state, rng)`,
evaluations call it in place of `act`. In a run with action masks, `act` and `act_greedy` are called with `mask=`
[N, choices] bool, which is True where a choice is allowed.

Rule: `act` is called once for each lane and step, with exactly the copies of that lane, and once more, before the first
step, if the lane's saved states come from another worker (`workers/lanes/bring_back.py`). Therefore, if the policy keeps
nothing but `state` between calls, a rollout is the same, bit for bit, whatever else the worker does.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from millrace.protocol.arrays import Array, Bools, Floats
from millrace.protocol.errors import PolicyFailed, UsageError, first_line
from millrace.protocol.own_module import own_callable
from millrace.protocol.policy.layout import named_views, parameter_layout
from millrace.protocol.policy.masks import not_allowed
from millrace.protocol.rows.array_checks import wrong_values
from millrace.protocol.specs import ExtraArray, OwnPolicySpec, PolicySpec

LOG_PROB = ExtraArray("log_prob", (), "float32")


class Acted(NamedTuple):
    """What a policy returned for the N copies of a lane, checked and converted to the run's shapes and dtypes."""

    action: Array
    """[N, *action]"""
    state: Floats
    """[N, S]"""
    extras: tuple[Array, ...]
    """one array [N, *shape] for each declared extra, in order; then the log-probabilities, if the policy returns them"""


class CalledPolicy:
    """A user-defined policy. All its errors are raised as `PolicyFailed`."""

    def __init__(self, spec: PolicySpec, extras: tuple[ExtraArray, ...], called: str = "policy") -> None:
        """Make the policy. `extras` are those of the run; `called` is the word for the policy in errors.

        Raises `PolicyFailed` if it can't be made, or lacks a method.
        """
        assert spec.own is not None
        self._called = called
        self._spec = spec
        self._own = spec.own
        self._fields, _ = parameter_layout(spec)
        self._paths = [leaf.path for leaf in spec.observation]
        self._extras = (*extras, LOG_PROB) if spec.own.has_log_prob else extras
        self._names = {extra.name for extra in self._extras}
        self._made: Any = self._guarded("cannot be made: it", lambda: _factory(self._own, called)(**self._own.kwargs))
        methods = ("load", "act") if spec.own.arrays else ("act",)
        for name in methods:
            if not callable(getattr(self._made, name, None)):
                expected = f"expected an object with {' and '.join(methods)}"
                raise self._wrong(f"{expected}, got {type(self._made).__name__} without {name}")

    def load(self, parameters: Floats, buffers: Floats) -> None:
        """Load these weights. The policy must have been declared with arrays."""
        self._guarded("load", lambda: self._made.load(named_views(parameters.copy(), self._fields)))

    def act(
        self,
        leaves: Sequence[Array],
        state: Floats,
        rng: np.random.Generator,
        *,
        mask: Bools | None = None,
        greedy: bool = False,
    ) -> Acted:
        """Act for the N copies of a lane, given observations `leaves` [N, *leaf] and `state` [N, S].

        In a masked run, `mask` [N, choices] says which choices are allowed. If `greedy`, act as in an evaluation.
        """
        name = "act_greedy" if greedy and hasattr(self._made, "act_greedy") else "act"
        own = [leaf.copy() for leaf in leaves]
        obs = dict(zip(self._paths, own, strict=True)) if self._paths[0] else own[0]
        keywords = {} if mask is None else {"mask": mask.copy()}
        returned = self._guarded(name, lambda: getattr(self._made, name)(obs, state.copy(), rng, **keywords))
        if not (isinstance(returned, tuple) and len(returned) == 3):
            raise self._wrong(f"{name}: expected it to return action, state, extras; got {_described(returned)}")
        action, after, extras = returned
        copies = len(state)
        stored = self._array(
            action, (copies, *self._spec.action.shape), self._spec.action.stored_dtype, f"{name}: the action"
        )
        if why := wrong_values(stored, self._spec.action, ("copy",)):
            raise self._wrong(f"{name}: the action: {why}")
        if mask is not None and (wrong := not_allowed(stored, mask, self._spec.action)).any():
            n = int(np.flatnonzero(wrong)[0])
            raise self._wrong(
                f"{name}: the action: expected one that the mask allows, got {stored[n].tolist()} for copy {n}"
            )
        if self._own.state_size:
            state = self._array(after, state.shape, "float32", f"{name}: the state")
        given = extras or {}
        if not isinstance(given, Mapping) or given.keys() != self._names:
            names = ", ".join(sorted(self._names)) or "none"
            got = ", ".join(map(str, given)) if isinstance(given, Mapping) else type(given).__name__
            raise self._wrong(f"{name}: expected the extras {names}, got {got or 'none'}")
        arrays = (
            self._array(given[each.name], (copies, *each.shape), each.dtype, f"{name}: extra {each.name}")
            for each in self._extras
        )
        return Acted(stored, state, tuple(arrays))

    def _array(self, value: Any, shape: tuple[int, ...], dtype: str, what: str) -> Array:
        """The value as an array of this shape and dtype.

        Raises `PolicyFailed` if the value has another shape or kind of number, or contains an invalid number.
        """
        array: npt.NDArray[Any] = self._guarded(what, lambda: np.asarray(value))
        if array.shape != shape or not np.can_cast(array.dtype, dtype, "same_kind"):
            raise self._wrong(f"{what}: expected {dtype}{list(shape)}, got {array.dtype}{list(array.shape)}")
        array = array.astype(dtype, copy=False)
        if why := wrong_values(array, axes=("copy",)):
            raise self._wrong(f"{what}: {why}")
        return array

    def _guarded(self, what: str, call: Callable[[], Any]) -> Any:
        """Call the user's code. Raises `PolicyFailed` in place of any exception from it."""
        try:
            return call()
        except PolicyFailed:
            raise
        except Exception as error:
            line = f"{what} raised {type(error).__name__}: {first_line(error)}"
            raise self._wrong(line, traceback.format_exc()) from error

    def _wrong(self, line: str, detail: str = "") -> PolicyFailed:
        return PolicyFailed(f"{self._called} {self._own.factory}: {line}", detail)


def _factory(own: OwnPolicySpec, called: str) -> Callable[..., object]:
    """The callable that makes the policy. Raises `PolicyFailed` if it can't be imported."""
    if own.code is not None:
        return own.code.load()
    try:
        return own_callable(own.factory, f"{called} {own.factory}", "my_package.policies:make_policy")
    except UsageError as error:
        raise PolicyFailed(str(error), error.detail) from error


def _described(value: object) -> str:
    return f"a tuple of {len(value)}" if isinstance(value, tuple) else type(value).__name__
