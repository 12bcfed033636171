"""The computational cost of a policy: the multiply-adds of a forward pass of one row.

Each weight counts once for each place where it is used. Activations, normalizations and additions cost little in comparison,
and a backward pass costs twice as much as a forward pass, so this number alone describes the cost of a pass.
"""

from __future__ import annotations

import math

from millrace.protocol.policy.layout import convolutions, parameter_layout
from millrace.protocol.specs import PolicySpec


def multiply_adds(spec: PolicySpec) -> int:
    """Multiply-adds of a forward pass of one row through all networks of a policy.

    If the policy has a user-defined encoder, it is constructed in order to count its multiply-adds.
    """
    total = 0
    places = _places(spec)
    for field in (field for part in parameter_layout(spec) for field in part):
        if len(field.shape) > 1 and not (spec.encoder is not None and field.name.startswith("encoder.")):
            total += math.prod(field.shape) * places.get(field.name, 1)
    if spec.encoder is None or spec.own is not None:
        return total
    from millrace.protocol.policy.own_encoder import multiply_adds_of_encoder

    return total + multiply_adds_of_encoder(spec)


def _places(spec: PolicySpec) -> dict[str, int]:
    """How many times a pass uses each weight of a convolution: once at each position. The keys are names of fields."""
    places: dict[str, int] = {}
    if not spec.convolves:
        return places
    for i, leaf in enumerate(spec.observation):
        if leaf.is_image:
            stack, (_, height, width), _ = convolutions(leaf)
            for j, conv in enumerate(stack):
                height = conv.output_side(height)
                width = conv.output_side(width)
                places[f"image{i}.{j}.weight"] = height * width
    return places
