"""The multiply-adds of a pass, against PyTorch's own count."""

from __future__ import annotations

import pytest
import torch
from msgspec.structs import replace
from torch.utils.flop_counter import FlopCounterMode

from millrace.learner.algorithms.bodies.networks import ActorCriticNetwork
from millrace.protocol.policy.arithmetic import multiply_adds
from millrace.protocol.policy.features import feature_size
from millrace.protocol.policy.own_encoder import describe_encoder
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec

ACTION = ActionSpec("discrete", (), "int64", (2,), (0,))
VECTOR = Leaf("v", "box", (5,), "float32")
IMAGE = Leaf("i", "box", (40, 36, 3), "uint8")
SMALL_IMAGE = Leaf("i", "box", (7, 7, 3), "uint8")
ROWS = 3


def linear(features: int, images: list[tuple[int, ...]]) -> torch.nn.Module:
    return torch.nn.Sequential(
        torch.nn.Linear(features, 32), torch.nn.Tanh(), torch.nn.LayerNorm(32), torch.nn.Linear(32, 7)
    )


class OfImages(torch.nn.Module):
    """Convolutions, and a linear layer that is used at several places."""

    def __init__(self, features: int, images: list[tuple[int, ...]]) -> None:
        super().__init__()
        self.convolution = torch.nn.Conv2d(3, 8, 5, 2)
        self.at_each_place = torch.nn.Linear(8, 4)

    def forward(self, features: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        places = self.convolution(image.permute(0, 3, 1, 2) / 255).flatten(2).mT
        out: torch.Tensor = self.at_each_place(places).mean(1)
        return out


class Remembers(torch.nn.Module):
    """Modules that use their weights more often than can be seen from outside, and a table that is only looked up."""

    def __init__(self, features: int, images: list[tuple[int, ...]]) -> None:
        super().__init__()
        self.table = torch.nn.Embedding(1_000_000, 4)
        self.cell = torch.nn.LSTM(features, 8, batch_first=True)
        self.attention = torch.nn.MultiheadAttention(8, 2, batch_first=True)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        steps, _ = self.cell(features[:, None].expand(-1, 6, -1))
        found: torch.Tensor = self.table(torch.zeros(len(features), 2).long()).flatten(1)
        remembered: torch.Tensor = self.attention(steps, steps, steps)[0].mean(1)
        return remembered + found


def counted_by_torch(spec: PolicySpec) -> int:
    network = ActorCriticNetwork(spec)
    images = [torch.zeros(ROWS, *leaf.shape, dtype=torch.uint8) for leaf in spec.observation if leaf.is_image]
    with FlopCounterMode(display=False) as counter:
        network.forward(torch.zeros(ROWS, feature_size(spec)), images)
    return int(counter.get_total_flops()) // 2 // ROWS


@pytest.mark.parametrize(
    "spec",
    [
        PolicySpec((VECTOR,), ACTION),
        PolicySpec((VECTOR,), ACTION, net=(32, 16), shared_net=True),
        PolicySpec((VECTOR, IMAGE), ACTION),
        PolicySpec((SMALL_IMAGE,), ACTION, net=()),
    ],
)
def test_it_is_torchs_own_count(spec: PolicySpec) -> None:
    assert multiply_adds(spec) == counted_by_torch(spec)


@pytest.mark.parametrize(("factory", "leaves"), [("linear", (VECTOR,)), ("OfImages", (VECTOR, IMAGE))])
def test_of_an_encoder_too(factory: str, leaves: tuple[Leaf, ...]) -> None:
    encoder = describe_encoder(f"{__name__}:{factory}", leaves, ACTION)
    spec = replace(PolicySpec(leaves, ACTION), encoder=encoder)
    assert multiply_adds(spec) == counted_by_torch(spec)


def test_what_cannot_be_seen_from_outside_counts_little() -> None:
    encoder = describe_encoder(f"{__name__}:Remembers", (VECTOR,), ACTION)
    spec = PolicySpec((VECTOR,), ACTION, net=())
    assert 0 < multiply_adds(replace(spec, encoder=encoder)) < 10_000
