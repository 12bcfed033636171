"""Converts actions between the form in which they are chosen and stored and the form that environments expect. Pure.

Rule: the chosen action is stored. For the environment, it is converted: shifted by `start`, or, for a Box, scaled if the
policy asks for that, and then clipped. A mixed action is stored as a row; the environment gets a Dict or Tuple
(`millrace.protocol.action_parts`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from millrace.protocol.action_parts import make_nest, parts_of
from millrace.protocol.arrays import Array
from millrace.protocol.specs import ActionSpec, PolicySpec


def action_converter_of(policy: PolicySpec) -> Callable[[Array], Array]:
    """Return a function that converts this policy's stored actions [..., *action] to actions for the environment.

    For a Dict or Tuple space it returns an array [...] of objects. If the policy stores scaled actions, they are scaled from
    [-1, 1] to the bounds of the Box, in float64, before they are converted like all others.
    """
    convert = make_action_converter(policy.action)
    spec = policy.action
    if not policy.stores_scaled_actions:
        return convert
    low, high = (np.reshape(bound, spec.shape) for bound in (spec.low, spec.high))
    middle = (low + high) / 2
    half = (high - low) / 2
    return lambda action: convert(middle + half * action.astype(np.float64))


def action_leaves_of(policy: PolicySpec) -> Callable[[Array], tuple[Array, ...]]:
    """Return a function that converts this policy's stored actions [..., *action] to the environment's arrays [..., *part].

    It returns one array for each part of a Dict or Tuple, in the order of the space; for any other space, one array.
    """
    if policy.action.parts:
        return _make_leaves(policy.action)
    convert = action_converter_of(policy)
    return lambda action: (convert(action),)


def _make_leaves(spec: ActionSpec) -> Callable[[Array], tuple[Array, ...]]:
    """`action_leaves_of` for a mixed action."""
    parts = parts_of(spec)
    converters = [make_action_converter(part.spec) for part in parts]

    def leaves(action: Array) -> tuple[Array, ...]:
        stored = [action[..., part.columns].reshape(*action.shape[:-1], *part.spec.shape) for part in parts]
        return tuple(convert(array) for convert, array in zip(converters, stored, strict=True))

    return leaves


def _make_structures(spec: ActionSpec) -> Callable[[Array], Array]:
    """Return a function that converts stored actions [..., D] to an array [...] of objects: a dict or tuple per action."""
    leaves = _make_leaves(spec)
    nest = make_nest([part.path for part in spec.parts])

    def structures(action: Array) -> Array:
        found = np.empty(action.shape[:-1], object)
        each = found.reshape(-1)
        columns = [leaf.reshape(-1, *leaf.shape[action.ndim - 1 :]) for leaf in leaves(action)]
        for i, values in enumerate(zip(*columns, strict=True)):
            each[i] = nest(values)
        return found

    return structures


def make_action_converter(spec: ActionSpec) -> Callable[[Array], Array]:
    """Return a function that converts stored actions [..., *action] to actions for the environment.

    It shifts actions by `start`, or clips them if the space is a Box. It clips in the dtype of the space, in which the
    bounds are exact. The float32 closest to a float64 bound may lie outside it.
    """
    if spec.parts:
        return _make_structures(spec)
    dtype = np.dtype(spec.dtype)
    if spec.kind == "box":
        low, high = (np.reshape(np.asarray(bound, dtype), spec.shape) for bound in (spec.low, spec.high))
        return lambda action: np.clip(action.astype(dtype, copy=False), low, high)
    start = np.reshape(np.asarray(spec.start or 0, dtype), spec.shape if spec.start else ())
    if not start.any():
        return lambda action: action.astype(dtype, copy=False)
    return lambda action: (action + start).astype(dtype, copy=False)


def stored_actions_of(policy: PolicySpec) -> Callable[[Sequence[Array]], Array]:
    """The inverse of `action_leaves_of`: return a function that converts arrays [..., *part] to stored actions.

    If the policy stores scaled actions, those outside the Box are clipped to its bounds.
    """
    spec = policy.action
    if spec.parts:
        return _make_rows(spec)
    to_stored = _stored(policy)
    return lambda leaves: to_stored(leaves[0])


def _make_rows(spec: ActionSpec) -> Callable[[Sequence[Array]], Array]:
    """`stored_actions_of` for a mixed action."""
    parts = parts_of(spec)
    converters = [_stored(PolicySpec((), part.spec)) for part in parts]

    def rows(leaves: Sequence[Array]) -> Array:
        first = leaves[0]
        lead = first.shape[: first.ndim - len(parts[0].spec.shape)]
        found = np.empty((*lead, *spec.shape), spec.stored_dtype)
        for part, convert, leaf in zip(parts, converters, leaves, strict=True):
            found[..., part.columns] = convert(leaf).reshape(*lead, -1)
        return found

    return rows


def _stored(policy: PolicySpec) -> Callable[[Array], Array]:
    """Return a function that converts the environment's actions [..., *action], unless they are mixed, to stored actions."""
    spec = policy.action
    if spec.kind != "box":
        start = np.reshape(np.asarray(spec.start or 0), spec.shape if spec.start else ())
        return lambda action: (action - start).astype(spec.stored_dtype)
    if not policy.stores_scaled_actions:
        return lambda action: action.astype(spec.stored_dtype)
    low, high = (np.reshape(bound, spec.shape) for bound in (spec.low, spec.high))
    middle = (low + high) / 2
    half = (high - low) / 2
    half = np.where(half > 0, half, 1)  # an element with only one value is stored as 0
    return lambda action: np.clip((action - middle) / half, -1, 1).astype(spec.stored_dtype)
