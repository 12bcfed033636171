"""Advice for observations that look like images but are flattened: how to pass them to the convolutions. Pure.

Rule: only `Leaf.is_image` decides what an image is. This file only recognizes arrays that the user may have meant as images.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from msgspec.structs import replace

from millrace.protocol.specs import Leaf, PolicySpec

LEAST_SIDE = 36  # the smallest side, in pixels, of an image that goes through three convolutions
GRAY = "gymnasium.wrappers:GrayscaleObservation"
STACKED = '"gymnasium.wrappers:FrameStackObservation(stack_size=4)"'


def flattened_images(policy: PolicySpec) -> Iterator[str]:
    """A line for each array of the observation that may contain images but goes straight into a layer of `net`."""
    if policy.encoder is not None or policy.own is not None:
        return
    for leaf in policy.observation:
        if is_stack(leaf) or (
            leaf.kind == "box" and not leaf.is_image and sum(side >= LEAST_SIDE for side in leaf.shape) >= 2
        ):
            numbers = math.prod(leaf.shape)
            layer = f"a layer of {numbers * policy.net[0]:,} weights" if policy.net else "the output layer"
            yield (
                f"{leaf.name} {leaf.dtype}{list(leaf.shape)} goes through no convolutions: its {numbers:,} numbers go into "
                f"{layer}; if these are images, {_what_to_do(leaf)}, or give --encoder"
            )


def is_stack(leaf: Leaf) -> bool:
    """Whether the array consists of images, stacked along a first, fourth dimension. It isn't an image itself."""
    return len(leaf.shape) == 4 and replace(leaf, shape=leaf.shape[1:]).is_image


def _what_to_do(leaf: Leaf) -> str:
    match leaf.shape:
        case (_, _) if leaf.dtype == "uint8":
            return f'stack them (--wrappers {STACKED}), or keep the channel ("{GRAY}(keep_dim=True)")'
    if is_stack(leaf):
        return f'stack them along the channels (--wrappers "millrace:StackImages(n={leaf.shape[0]})")'
    return "make them uint8 from 0 to 255, of three dimensions"
