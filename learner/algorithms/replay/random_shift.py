"""Random shifts of images (Kostrikov et al. 2021, DrQ), which keep critics from memorizing the images in the buffer.

Rule: each image in a minibatch is moved by a random number of whole pixels along each axis, up to a limit, and its border
pixels are repeated. All channels move together, so the motion between the frames of a stack is preserved.
"""

from __future__ import annotations

import torch
from torch import Tensor


def random_shift(images: Tensor, most: int, *, channels_last: bool, generator: torch.Generator) -> Tensor:
    """Images [B, H, W, C] or [B, C, H, W] of any dtype, each moved by -most to most pixels along each axis."""
    if not most:
        return images
    pixels = images if channels_last else images.movedim(1, 3)
    batch, height, width, _ = pixels.shape
    moves = torch.randint(-most, most + 1, (2, batch, 1), generator=generator).to(images.device)
    rows = (torch.arange(height, device=images.device) + moves[0]).clamp_(0, height - 1)  # [B, H]
    columns = (torch.arange(width, device=images.device) + moves[1]).clamp_(0, width - 1)  # [B, W]
    image = torch.arange(batch, device=images.device)[:, None, None]
    moved = pixels[image, rows[:, :, None], columns[:, None, :]]
    return moved if channels_last else moved.movedim(3, 1)
