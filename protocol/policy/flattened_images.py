"""Advice for observations that look like images but are flattened: how to pass them to the convolutions. Pure.

Rule: only `Leaf.is_image` decides what an image is. This file only recognizes arrays that the user may have meant as images.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from millrace.protocol.specs import Leaf, PolicySpec

LEAST_SIDE = 36  # the smallest side, in pixels, of an image that goes through three convolutions
COLORS = (1, 3, 4)
GRAY = "gymnasium.wrappers:GrayscaleObservation"
STACKED = '"gymnasium.wrappers:FrameStackObservation(stack_size=4)"'


def flattened_images(policy: PolicySpec) -> Iterator[str]:
    """A line for each array of the observation that may contain images but goes straight into a layer of `net`."""
    if policy.encoder is not None or policy.own is not None:
        return
    for leaf in policy.observation:
        if leaf.kind == "box" and not leaf.is_image and sum(side >= LEAST_SIDE for side in leaf.shape) >= 2:
            numbers = math.prod(leaf.shape)
            layer = f"a layer of {numbers * policy.net[0]:,} weights" if policy.net else "the output layer"
            yield (
                f"{leaf.name} {leaf.dtype}{list(leaf.shape)} goes through no convolutions: its {numbers:,} numbers go into "
                f"{layer}; if these are images, {_what_to_do(leaf)}, or give --encoder"
            )


def _what_to_do(leaf: Leaf) -> str:
    match leaf.shape:
        case (_, _) if leaf.dtype == "uint8":
            return f'stack them (--wrappers {STACKED}), or keep the channel ("{GRAY}(keep_dim=True)")'
        case (_, _, _, colors) if leaf.dtype == "uint8" and colors in COLORS:
            return f"stack gray frames: --wrappers {GRAY} {STACKED}"
    return "make them uint8 from 0 to 255, of three dimensions"
