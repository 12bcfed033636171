"""Acting in torch is acting in numpy, and as the network that the learner trains; and so are log-probabilities."""

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

from millrace.learner.algorithms.bodies.networks import ActorAndCritics, ActorCriticNetwork, FlatNetwork, QNetwork
from millrace.protocol.action_parts import mixed
from millrace.protocol.arrays import Array
from millrace.protocol.policy.acting_network import ActingNetwork
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.features import features
from millrace.protocol.policy.layout import acting_size, buffer_size
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


def random_weights(spec: PolicySpec, net: FlatNetwork, generator: np.random.Generator) -> tuple[Array, Array]:
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


@pytest.mark.parametrize("core", [None, "gru"])
@pytest.mark.parametrize("net", [(), (9, 8)])
@pytest.mark.parametrize(
    ("kind", "action", "settings"),
    [
        (ActorCriticNetwork, "box", {"activation": "relu"}),
        (ActorCriticNetwork, "discrete", {"shared_net": True}),
        (QNetwork, "discrete", {"head": "q"}),
        (QNetwork, "discrete", {"head": "q", "dueling": True}),
        (ActorAndCritics, "box", {"head": "squashed"}),
        (ActorAndCritics, "box", {"head": "deterministic"}),
    ],
)
def test_torch_policy_gives_the_bits_of_the_network_that_the_learner_trains(
    kind: Any, action: str, settings: dict[str, Any], net: tuple[int, ...], core: Any
) -> None:
    generator = np.random.default_rng(1)
    spec = PolicySpec((BOX, *IMAGES["channels last"]), ACTIONS[action], net, core=core, core_size=7, **settings)
    trained, policy = kind(spec), TorchPolicy(spec)
    policy.load(*random_weights(spec, trained, generator))
    obs = leaves(spec.observation, (1, 5), generator)
    with torch.no_grad():
        expected = trained.params(torch.tensor(features(spec, obs)[0]), [torch.tensor(obs[1][0])]).numpy()
    found = policy(obs)[0]
    np.testing.assert_array_equal(found[:, : expected.shape[1]], expected)
    assert found.shape == (5, distribution(spec).params_size)


@pytest.mark.parametrize("head", ["actor_critic", "squashed"])
def test_the_network_that_acts_has_neither_critics_nor_gradients(head: Any) -> None:
    spec = PolicySpec(IMAGES["channels last"], ACTIONS["box"], head=head)
    network = ActingNetwork(spec)
    assert network.flat.shape == (acting_size(spec),)
    images = [torch.tensor(leaf) for leaf in leaves(spec.observation, (5,), np.random.default_rng(0))]
    out, _ = network(torch.zeros(5, 0), images, torch.zeros(5, 0))
    assert not out.requires_grad


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
