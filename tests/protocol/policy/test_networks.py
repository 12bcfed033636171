"""The torch networks are the numpy ones; every parameter and gradient is a view of one flat tensor."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from millrace.protocol.action_parts import mixed
from millrace.protocol.arrays import Array
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.features import features
from millrace.protocol.policy.layout import buffer_size, convolutions, parameter_layout, total_size
from millrace.protocol.policy.networks import ActorCriticNetwork, MLPNode
from millrace.protocol.policy.normalize import normalize
from millrace.protocol.policy.numpy_policy import NumpyPolicy
from millrace.protocol.policy.torch_distributions import log_prob_and_entropy
from millrace.protocol.policy.torch_policy import TorchPolicy
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec
from tests.support.examples import examples
from tests.support.numbers.rounding import in_double, in_float64, sampled

BOX = Leaf("x", "box", (2, 3), "float32")
OBSERVATIONS = {
    "box": (BOX,),
    "bytes": (Leaf("x", "box", (5,), "uint8", divisor=255),),
    "discrete": (Leaf("x", "discrete", (), "int64", (5,), (-2,)),),
    "multidiscrete": (Leaf("x", "multidiscrete", (2,), "int64", (3, 4), (0, 1)),),
    "multibinary": (Leaf("x", "multibinary", (3,), "int8"),),
    "dict": (BOX, Leaf("y", "discrete", (), "int64", (3,), (0,))),
}
IMAGES = {
    "channels last": (Leaf("i", "box", (12, 11, 3), "uint8", divisor=255),),
    "channels first, and a box": (BOX, Leaf("i", "box", (3, 12, 14), "uint8", divisor=255)),
    "two, one large": (
        Leaf("i", "box", (36, 36, 1), "uint8", divisor=255),
        Leaf("j", "box", (9, 9, 2), "uint8", divisor=255),
    ),
}
ACTIONS = {
    "discrete": ActionSpec("discrete", (), "int64", (4,), (0,)),
    "multidiscrete": ActionSpec("multidiscrete", (2, 2), "int64", (2, 3, 4, 2), (0, 0, 0, 0)),
    "multibinary": ActionSpec("multibinary", (3,), "int8"),
    "box": ActionSpec("box", (2, 2), "float32", low=(-1.0,) * 4, high=(1.0,) * 4),
}
ACTIONS |= {
    "choice and numbers": mixed([((0,), ACTIONS["box"]), ((1,), ACTIONS["discrete"])]),
    "bits twice": mixed([(("a",), ACTIONS["multibinary"]), (("b",), ACTIONS["multibinary"])]),
    "all kinds": mixed([(("a", number), spec) for number, spec in enumerate(ACTIONS.values())]),
}


def leaves(observation: tuple[Leaf, ...], lead: tuple[int, ...], generator: np.random.Generator) -> list[Array]:
    found: list[Array] = []
    for leaf in observation:
        shape = (*lead, *leaf.shape)
        if leaf.sizes:
            low = np.reshape(leaf.start, leaf.shape)
            found.append(generator.integers(low, low + np.reshape(leaf.sizes, leaf.shape), shape))
        elif leaf.kind == "multibinary" or leaf.dtype == "uint8":
            high = 2 if leaf.kind == "multibinary" else 256
            found.append(generator.integers(0, high, shape).astype(leaf.dtype))
        else:
            found.append(generator.normal(size=shape).astype(leaf.dtype))
    return found


def random_weights(spec: PolicySpec, net: ActorCriticNetwork, generator: np.random.Generator) -> tuple[Array, Array]:
    """Fill the network with random parameters; give the acting ones and random buffers."""
    net.flat.copy_(torch.tensor(generator.normal(0, 0.5, len(net.flat)), dtype=torch.float32))
    buffers = generator.uniform(0.5, 2, buffer_size(spec)).astype(np.float32)
    return net.flat.numpy()[: net.acting_size].copy(), buffers


@given(
    st.sampled_from(sorted(OBSERVATIONS)),
    st.sampled_from(sorted(ACTIONS)),
    st.sampled_from(["tanh", "relu"]),
    st.lists(st.integers(1, 9), max_size=3),
    st.booleans(),
    st.integers(0, 2**32),
)
@examples(60)
def test_numpy_and_torch_agree(
    observation: str, action: str, activation: Any, net: list[int], normal: bool, seed: int
) -> None:
    generator = np.random.default_rng(seed)
    spec = PolicySpec(OBSERVATIONS[observation], ACTIONS[action], tuple(net), activation, normal)
    torch_net, numpy_net = ActorCriticNetwork(spec), NumpyPolicy(spec)
    parameters, buffers = random_weights(spec, torch_net, generator)
    numpy_net.load(parameters, buffers)
    obs = leaves(spec.observation, (1, 7), generator)
    x = features(spec, obs)
    x = normalize(x, *np.split(buffers, 2)) if normal else x
    expected = numpy_net(obs)[0]
    params, value = torch_net.forward(torch.tensor(x[0]))
    exact = in_float64(torch_net)
    (of_params,) = sampled(lambda: [exact.params(torch.tensor(x[0]).double())])
    of_params.assert_is(params.detach().numpy(), expected)
    np.testing.assert_array_equal(value.detach(), torch_net.value(torch.tensor(x[0])).detach())

    over = distribution(spec)
    actions = over.sample(expected, over.noise(generator, (7,)))
    log_prob, entropy = log_prob_and_entropy(spec.action, torch.tensor(expected), torch.tensor(actions))
    doubles = torch.tensor(expected).double(), in_double(torch.tensor(actions))
    (of_log_prob,) = sampled(lambda: [log_prob_and_entropy(spec.action, *doubles)[0]])
    of_log_prob.assert_is(log_prob.numpy(), over.log_prob(expected, actions))
    assert entropy.shape == (7,)


@pytest.mark.parametrize("kind", ["discrete", "multidiscrete", "multibinary"])
def test_entropy_is_minus_the_expected_log_probability(kind: str) -> None:
    spec = ACTIONS[kind]
    params = torch.randn(1, distribution(PolicySpec((), spec)).params_size, generator=torch.Generator().manual_seed(0))
    choices = [range(n) for n in spec.sizes or (2,) * math.prod(spec.shape)]
    every = torch.tensor(list(itertools.product(*choices))).reshape(-1, *spec.shape)
    log_prob, entropy = log_prob_and_entropy(spec, params.expand(len(every), -1), every)
    torch.testing.assert_close(log_prob.exp().sum(), torch.tensor(1.0))
    torch.testing.assert_close(entropy[0], -(log_prob.exp() * log_prob).sum())


def test_gaussian_log_probability_and_entropy_are_those_of_torch() -> None:
    params = torch.randn(6, 8, generator=torch.Generator().manual_seed(0))
    action = torch.randn(6, 2, 2, generator=torch.Generator().manual_seed(1))
    normal = torch.distributions.Normal(params[:, :4], params[:, 4:].exp())
    log_prob, entropy = log_prob_and_entropy(ACTIONS["box"], params, action)
    torch.testing.assert_close(log_prob, normal.log_prob(action.reshape(6, 4)).sum(-1))  # type: ignore[no-untyped-call]
    torch.testing.assert_close(entropy, normal.entropy().sum(-1))  # type: ignore[no-untyped-call]


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


@dataclasses.dataclass(frozen=True)
class Loaded:
    policy: TorchPolicy
    net: ActorCriticNetwork
    spec: PolicySpec
    buffers: Array


def loaded(observation: tuple[Leaf, ...]) -> Loaded:
    spec = PolicySpec(observation, ACTIONS["box"], (8,), normalize_observations=True)
    net, policy = ActorCriticNetwork(spec), TorchPolicy(spec)
    parameters, buffers = random_weights(spec, net, np.random.default_rng(1))
    parameters.flags.writeable = False  # as it comes from a frame
    policy.load(parameters, buffers)
    return Loaded(policy, net, spec, buffers)


@pytest.mark.parametrize("observation", [OBSERVATIONS["dict"], *IMAGES.values()])
def test_torch_policy_gives_each_lane_the_bits_it_gets_alone(observation: tuple[Leaf, ...]) -> None:
    it = loaded(observation)
    obs = leaves(observation, (3, 5), np.random.default_rng(2))
    together = it.policy(obs)
    assert together.shape == (3, 5, 8)
    assert together.dtype == np.float32
    for lane in range(3):
        np.testing.assert_array_equal(together[lane], it.policy([array[lane : lane + 1] for array in obs])[0])
    x = torch.tensor(normalize(features(it.spec, obs), *np.split(it.buffers, 2)).reshape(15, -1))
    images = [torch.tensor(a.reshape(15, *leaf.shape)) for leaf, a in zip(observation, obs, strict=True) if leaf.is_image]
    exact = in_float64(it.net)
    (expected,) = sampled(lambda: [exact.params(x.double(), images)])
    expected.assert_is(it.net.params(x, images).detach().numpy(), together.reshape(15, 8))


@pytest.mark.parametrize("observation", IMAGES.values())
def test_images_in_bfloat16_are_seen_nearly_the_same_under_all_weights(observation: tuple[Leaf, ...]) -> None:
    it = loaded(observation)
    narrow = TorchPolicy(it.spec, images="bfloat16")
    obs = leaves(observation, (2, 5), np.random.default_rng(2))
    for seed in (3, 4):
        parameters, buffers = random_weights(it.spec, it.net, np.random.default_rng(seed))
        for policy in (it.policy, narrow):
            policy.load(parameters * np.float32(0.1), buffers)  # or every tanh is at its end
        exact, seen = it.policy(obs), narrow(obs)
        assert seen.dtype == np.float32
        assert 0 < np.abs(seen - exact).max() < 0.03 * exact.std()


def test_torch_policy_acts_as_the_numpy_policy() -> None:
    it = loaded(OBSERVATIONS["dict"])
    numpy_policy = NumpyPolicy(it.spec)
    numpy_policy.load(it.net.flat.numpy()[: it.net.acting_size], it.buffers)
    obs = leaves(it.spec.observation, (2, 4), np.random.default_rng(0))
    x = normalize(features(it.spec, obs), *np.split(it.buffers, 2)).reshape(8, -1)
    exact = in_float64(it.net)
    (expected,) = sampled(lambda: [exact.params(torch.tensor(x).double())])
    expected.assert_is(it.policy(obs).reshape(8, -1), numpy_policy(obs).reshape(8, -1))


def test_torch_policy_refuses_weights_of_another_size() -> None:
    it = loaded(OBSERVATIONS["box"])
    with pytest.raises(ValueError, match="parameters"):
        it.policy.load(np.zeros(it.net.acting_size + 1, np.float32), it.buffers)
    with pytest.raises(ValueError, match="buffers"):
        it.policy.load(np.zeros(it.net.acting_size, np.float32), it.buffers[1:])
