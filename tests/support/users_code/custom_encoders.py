"""Modules of a user's own, good and bad ones: `tests.support.users_code.custom_encoders:attention`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

Shapes = Sequence[tuple[int, ...]]


class Mixer(nn.Module):
    """Features through a layer with a norm, images through their mean colour."""

    def __init__(self, features: int, images: Shapes) -> None:
        super().__init__()
        self.layer = nn.Sequential(nn.Linear(features, 12), nn.LayerNorm(12), nn.SiLU())
        self.colours = nn.ModuleList(nn.Linear(shape[-1], 5) for shape in images)

    def forward(self, x: Tensor, *images: Tensor) -> Tensor:
        seen = [layer(image.float().mean((1, 2)) / 255) for layer, image in zip(self.colours, images, strict=True)]
        return torch.cat([self.layer(x), *seen], -1)


def mixer(features: int, images: Shapes) -> nn.Module:
    return Mixer(features, images)


def nothing_to_learn(features: int, images: Shapes) -> nn.Module:
    return nn.Flatten()


def with_statistics(features: int, images: Shapes) -> nn.Module:
    return nn.Sequential(nn.Linear(features, 4), nn.BatchNorm1d(4))


def not_a_module(features: int, images: Shapes) -> int:
    return features


def of_doubles(features: int, images: Shapes) -> nn.Module:
    return nn.Linear(features, 4).double()


def of_one_dimension(features: int, images: Shapes) -> nn.Module:
    return nn.Sequential(nn.Linear(features, 1), nn.Flatten(0))


def wants_more(features: int, images: Shapes) -> nn.Module:
    return nn.Linear(features + 1, 4)


def raises(features: int, images: Shapes) -> nn.Module:
    raise OSError("no such file\nat all")
