"""Checks whether a policy can be made from a spec that was read from a file. Pure; imports no torch.

Rule: such a spec has the same limits as a worker's description of an environment (`protocol/space_spec.py`), and weights
that are too large for a message are refused before anything of their size is allocated.
"""

from __future__ import annotations

import math
from typing import get_args

from millrace.protocol.action_parts import make_nest, mixed, parts_of
from millrace.protocol.bounds import LARGEST, one_line
from millrace.protocol.policy.layout import acting_size
from millrace.protocol.space_spec import MAX_DEPTH, MAX_ELEMENTS, MAX_LEAVES, Dtype
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec
from millrace.protocol.wire.message_sizes import MAX_FRAME_BYTES

MOST_LAYERS = 64


def why_impossible(spec: PolicySpec) -> str:
    """Why no policy can be made from this spec, in one line, or an empty string if one can."""
    leaves = spec.observation
    action = spec.action
    paths = {leaf.path for leaf in leaves}
    if not leaves or len(leaves) > MAX_LEAVES or len(paths) < len(leaves):
        return f"observation: expected 1 to {MAX_LEAVES} arrays of different names, got {len(leaves)}"
    if why := _why_no_action(action):
        return f"action: {why}"
    for leaf in leaves:
        if why := _why_no_space(leaf):
            return f"{one_line(f'observation {leaf.path}', 80)}: {why}"
    if spec.head == "q" and action.kind != "discrete":
        return f"head q: expected a discrete action, got {action.kind}"
    if spec.stores_scaled_actions and not (action.kind == "box" and all(map(math.isfinite, (*action.low, *action.high)))):
        return f"head {spec.head}: expected a box action with finite bounds, got another"
    arrays = () if spec.encoder is None else spec.encoder.arrays
    layers = (*spec.net, spec.core_size, 1 if spec.encoder is None else spec.encoder.size)
    if spec.own is not None or len(layers) > MOST_LAYERS or not all(0 < width <= LARGEST for width in layers):
        return "expected a network of layers with 1 or more units, got another"
    if any(min(array.shape, default=0) < 0 for array in arrays) or 4 * acting_size(spec) > MAX_FRAME_BYTES:
        return f"expected weights of at most {MAX_FRAME_BYTES:,} bytes, got more"
    return ""


def _why_no_action(action: ActionSpec) -> str:
    if action.kind != "mixed":
        bounds = math.prod(action.shape) if action.kind == "box" else 0
        if why := _why_no_space(action):
            return why
        if (len(action.low), len(action.high)) != (bounds, bounds) or any(map(math.isnan, (*action.low, *action.high))):
            return f"expected {bounds} lower and upper bounds, got {len(action.low)} and {len(action.high)}"
        return "expected no parts" if action.parts else ""
    if not 0 < len(action.parts) <= MAX_LEAVES or max(len(part.path) for part in action.parts) > MAX_DEPTH:
        return f"expected 1 to {MAX_LEAVES} parts, each inside of at most {MAX_DEPTH} Dicts and Tuples, got others"
    try:
        make_nest([part.path for part in action.parts])
    except ValueError as error:
        return one_line(f"parts: {error}", 200)
    parts = parts_of(action)
    for part in parts:
        if why := _why_no_action(part.spec):
            return f"{one_line(f'part {part.path}', 80)}: {why}"
    if action != mixed([(part.path, part.spec) for part in parts]):
        return "expected the sizes and bounds of its parts, got others"
    return ""


def _why_no_space(space: Leaf | ActionSpec) -> str:
    if math.prod(space.shape) > MAX_ELEMENTS or (space.kind == "discrete" and space.shape):
        return f"expected a shape of at most {MAX_ELEMENTS:,} elements, got {one_line(str(space.shape), 80)}"
    is_float = isinstance(space, ActionSpec) and space.kind == "box"
    if space.dtype not in get_args(Dtype) or (is_float and not space.dtype.startswith("float")):
        return f"expected a dtype of its space, got {one_line(space.dtype, 80)}"
    counts = math.prod(space.shape) if space.kind in ("discrete", "multidiscrete") else 0
    if (len(space.sizes), len(space.start)) != (counts, counts):
        return f"expected {counts} sizes and starts, got {len(space.sizes)} and {len(space.start)}"
    if not all(0 < size <= LARGEST for size in space.sizes) or not all(abs(start) <= LARGEST for start in space.start):
        return f"expected sizes above 0 and starts, both up to {LARGEST:,}"
    return ""
