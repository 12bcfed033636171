"""Turns actions as the policy chooses them and rollouts store them into the environment's, and back. Pure.

Rule: what is stored is what was chosen; what the environment gets is shifted by `start`, or scaled, and clipped to the Box.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.specs import ActionSpec, PolicySpec


def action_converter_of(policy: PolicySpec) -> Callable[[Array], Array]:
    """A function from the stored actions [N, *action] of this policy to actions of the environment.

    Actions in [-1, 1] are scaled to the bounds of the Box, in float64, and then converted as all others.
    """
    convert = make_action_converter(policy.action)
    spec = policy.action
    if not policy.stores_scaled_actions:
        return convert
    low, high = (np.reshape(bound, spec.shape) for bound in (spec.low, spec.high))
    middle = (low + high) / 2
    half = (high - low) / 2
    return lambda action: convert(middle + half * action.astype(np.float64))


def make_action_converter(spec: ActionSpec) -> Callable[[Array], Array]:
    """A function from stored actions [N, *action] to actions of the environment: shifted by `start`, or clipped (Box).

    A Box action is clipped in the dtype of the space, in which the bounds are exact: the float32 next to a float64 bound may
    lie outside of it.
    """
    dtype = np.dtype(spec.dtype)
    if spec.kind == "box":
        low, high = (np.reshape(np.asarray(bound, dtype), spec.shape) for bound in (spec.low, spec.high))
        return lambda action: np.clip(action.astype(dtype, copy=False), low, high)
    start = np.reshape(np.asarray(spec.start or 0, dtype), spec.shape if spec.start else ())
    if not start.any():
        return lambda action: action.astype(dtype, copy=False)
    return lambda action: (action + start).astype(dtype, copy=False)


def stored_actions_of(policy: PolicySpec) -> Callable[[Array], Array]:
    """The inverse of `action_converter_of`: a function from actions of the environment to stored actions.

    An action outside of a Box that is scaled becomes one at its bounds.
    """
    spec = policy.action
    if spec.kind != "box":
        start = np.reshape(np.asarray(spec.start or 0), spec.shape if spec.start else ())
        return lambda action: (action - start).astype(spec.stored_dtype)
    if not policy.stores_scaled_actions:
        return lambda action: action.astype(spec.stored_dtype)
    low, high = (np.reshape(bound, spec.shape) for bound in (spec.low, spec.high))
    middle = (low + high) / 2
    half = (high - low) / 2
    half = np.where(half > 0, half, 1)  # an element with one value alone is stored as 0
    return lambda action: np.clip((action - middle) / half, -1, 1).astype(spec.stored_dtype)
