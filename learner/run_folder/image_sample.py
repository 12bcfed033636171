"""A picture of what the policy sees: some image observations from the first rollouts. Pure.

The picture has a row for each of four steps, from the first to the last of one env copy's rollout. The channels, such as
stacked frames, are side by side; three channels are shown as red, green and blue. Large images are reduced to every second,
third, … pixel. If the bounds aren't 0 and 255, the largest value is shown as white, so that planes of zeros and ones are
visible.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from millrace.learner.run_folder.run_folder import as_folder_name
from millrace.protocol.arrays import Array
from millrace.protocol.specs import Leaf

ROWS = 4  # number of rows in the picture
GAP = 2  # pixels between images
GRAY = 128  # brightness of the gap
MOST_PIXELS = 256  # limit on the height and the width of an image
Pixels = npt.NDArray[np.uint8]


def image_samples(obs: Sequence[Array], leaves: Sequence[Leaf]) -> dict[str, bytes]:
    """A PNG file for each image among the arrays of a batch [T+1, ΣN, *leaf], by the name of the file."""
    names = ["-".join(filter(None, ("observation", leaf.path and as_folder_name(leaf.path)))) + ".png" for leaf in leaves]
    return {name: png(_sheet(array, leaf)) for name, array, leaf in zip(names, obs, leaves, strict=True) if leaf.is_image}


def png(pixels: Pixels) -> bytes:
    """A PNG file of pixels [height, width] in gray, or [height, width, 3] in color (ISO/IEC 15948)."""
    height, width = pixels.shape[:2]
    color = 2 if pixels.ndim == 3 else 0
    lines = np.concatenate([np.zeros((height, 1), np.uint8), pixels.reshape(height, -1)], axis=1)  # leading 0: no filter
    head = struct.pack(">IIBBBBB", width, height, 8, color, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(lines.tobytes())), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )


def _sheet(array: Array, leaf: Leaf) -> Pixels:
    """The rows of the picture, joined into one image."""
    steps = dict.fromkeys(np.linspace(0, len(array) - 1, ROWS).astype(int).tolist())
    images = [np.asarray(array[t, 0], np.uint8) for t in steps]
    white = 255 if leaf.divisor == 255 else max(1, *(int(image.max()) for image in images))
    return _joined([_row(image * np.uint8(255 // white), leaf) for image in images], axis=0)


def _row(image: Array, leaf: Leaf) -> Pixels:
    """The channels of an image side by side, or an image in color if there are three channels."""
    last = np.asarray(image if leaf.has_channels_last else np.moveaxis(image, 0, -1), np.uint8)
    every = -(-max(last.shape[:2]) // MOST_PIXELS)
    last = last[::every, ::every]
    if last.shape[-1] == 3:
        return last
    return _joined(list(np.moveaxis(last, -1, 0)), axis=1)


def _joined(images: Sequence[Pixels], axis: int) -> Pixels:
    """Images next to each other, with a gap between them."""
    shape = list(images[0].shape)
    shape[axis] = GAP
    gap = np.full(shape, GRAY, np.uint8)
    return np.concatenate([part for image in images for part in (gap, image)][1:], axis=axis)
