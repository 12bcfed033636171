"""The networks that the learner trains compute the textbook's formula; their parameters are views of one tensor."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from millrace.learner.algorithms.bodies.mlp_nodes import MLPNode
from millrace.learner.algorithms.bodies.networks import ActorCriticNetwork
from millrace.protocol.policy.features import features
from millrace.protocol.policy.layout import convolutions, parameter_layout, total_size
from millrace.protocol.specs import Leaf, PolicySpec
from tests.protocol.policy.test_torch_policy import ACTIONS, BOX, IMAGES, OBSERVATIONS, leaves
from tests.support.numbers.rounding import in_float64, sampled


def plain(net: ActorCriticNetwork, x: Tensor, images: list[Tensor]) -> tuple[Tensor, Tensor]:
    """The forward pass as a textbook writes it."""
    p, spec = net.parameters, net.spec
    act = torch.tanh if spec.activation == "tanh" else torch.relu
    parts, waiting = [x], list(images)
    for i, leaf in enumerate(spec.observation):
        if leaf.is_image:
            stack, shape, _ = convolutions(leaf)
            image = waiting.pop(0).to(x.dtype) / 255
            h = image if leaf.shape == shape else image.movedim(-1, 1)
            for j, conv in enumerate(stack):
                h = torch.relu(torch.conv2d(h, p[f"image{i}.{j}.weight"], p[f"image{i}.{j}.bias"], conv.stride))
            parts.append(torch.relu(h.flatten(1) @ p[f"image{i}.out.weight"].T + p[f"image{i}.out.bias"]))
    outputs = []
    for name in ("actor", "critic"):
        h = torch.cat(parts, -1)
        for layer in range(len(spec.net)):
            h = act(h @ p[f"{name}.{layer}.weight"].T + p[f"{name}.{layer}.bias"])
        outputs.append(h @ p[f"{name}.out.weight"].T + p[f"{name}.out.bias"])
    return outputs[0], outputs[1][:, 0]


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("observation", [OBSERVATIONS["box"], *IMAGES.values()])
def test_forward_and_gradients_are_those_of_the_textbook(observation: tuple[Leaf, ...], activation: Any) -> None:
    generator = np.random.default_rng(0)
    spec = PolicySpec(observation, ACTIONS["discrete"], (7, 5), activation)
    net = ActorCriticNetwork(spec, seed=3)
    net.flat.add_(0.1 * torch.randn(net.flat.shape, generator=torch.Generator().manual_seed(0)))
    obs = leaves(observation, (6,), generator)
    x = torch.tensor(features(spec, obs))
    images = [torch.tensor(array) for leaf, array in zip(observation, obs, strict=True) if leaf.is_image]
    exact = in_float64(net)

    def textbook() -> list[Tensor]:
        params, value = plain(exact, x.double(), images)
        loss = params.sin().sum() + value.square().sum()
        return [params, value, *torch.autograd.grad(loss, list(exact.parameters.values()))]

    params, value = net.forward(x, images)
    (params.sin().sum() + value.square().sum()).backward()  # type: ignore[no-untyped-call]
    gradients = [p.grad for p in net.parameters.values() if p.grad is not None]
    for ours, expected in zip([params, value, *gradients], sampled(textbook), strict=True):
        expected.assert_is(ours.detach().numpy())
    assert all((gradient != 0).any() for gradient in gradients)


@pytest.mark.parametrize("relu", [False, True])
def test_the_mlps_derivative_is_exact(relu: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    shapes = [(4, 3), (4,), (5, 4), (5,), (2, 5), (2,)]
    x, *layers = (torch.randn(s, dtype=torch.float64, generator=generator).requires_grad_() for s in [(6, 3), *shapes])
    assert torch.autograd.gradcheck(lambda x, *layers: MLPNode.apply(x, relu, *layers), (x, *layers))  # type: ignore[no-untyped-call]


def test_every_parameter_and_gradient_is_a_view_of_one_flat_tensor() -> None:
    spec = PolicySpec((BOX, *IMAGES["channels last"]), ACTIONS["box"])
    net = ActorCriticNetwork(spec)
    assert net.flat.grad is net.flat_grad
    acting_fields, critic_fields = parameter_layout(spec)
    assert list(net.parameters) == [field.name for field in (*acting_fields, *critic_fields)]
    assert net.acting_size == total_size(acting_fields)
    net.flat.copy_(torch.arange(len(net.flat)))
    net.flat_grad.copy_(torch.arange(len(net.flat)))
    at = 0
    for field in (*acting_fields, *critic_fields):
        count, view = math.prod(field.shape), net.parameters[field.name]
        expected = torch.arange(at, at + count, dtype=torch.float32).reshape(field.shape)
        assert view.shape == field.shape
        assert torch.equal(view.detach(), expected)
        assert view.grad is not None
        assert torch.equal(view.grad, expected)
        at += count
    assert at == len(net.flat)


def test_a_backward_pass_fills_the_flat_gradient_in_place() -> None:
    net = ActorCriticNetwork(PolicySpec((BOX,), ACTIONS["box"]))
    before = net.flat_grad.data_ptr()
    params, value = net.forward(torch.ones(3, 6))
    (params.sum() + value.sum()).backward()  # type: ignore[no-untyped-call]
    assert net.flat_grad.data_ptr() == before
    assert net.parameters["critic.out.bias"].grad is not None
    assert net.flat_grad[-1] == 3  # the critic's last bias, once for each row
    assert net.parameters["actor.log_std"].grad is not None
    assert (net.parameters["actor.log_std"].grad == 3).all()


def test_initialisation_is_orthogonal_with_each_fields_gain() -> None:
    spec = PolicySpec((BOX, *IMAGES["channels last"]), ACTIONS["box"], (8, 8))
    net = ActorCriticNetwork(spec, seed=1)
    for field in net.fields:
        weight = net.parameters[field.name].detach()
        if field.gain == 0:
            assert not weight.any()
            continue
        flat = weight.flatten(1)
        gram = flat @ flat.T if len(flat) <= flat.shape[1] else flat.T @ flat
        torch.testing.assert_close(gram, field.gain**2 * torch.eye(len(gram)), atol=1e-4, rtol=1e-4)
    gains = {field.name: field.gain for field in net.fields}
    assert (gains["actor.0.weight"], gains["actor.out.weight"], gains["critic.out.weight"]) == (math.sqrt(2), 0.01, 1)


def test_initialisation_follows_from_the_seed_alone() -> None:
    spec = PolicySpec((BOX,), ACTIONS["discrete"])
    torch.manual_seed(0)
    first = ActorCriticNetwork(spec, seed=5).flat
    torch.manual_seed(1)
    assert torch.equal(first, ActorCriticNetwork(spec, seed=5).flat)
    assert not torch.equal(first, ActorCriticNetwork(spec, seed=6).flat)
