"""The same weights in Stable-Baselines3's policies give the same actions, values, log-probabilities and entropies.

An implementation that others wrote is the judge of ours: layout, activations, distributions, and the example that takes a
policy there (examples/policy_in_sb3.py).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor, nn

from millrace.learner.algorithms.bodies.networks import ActorCriticNetwork
from millrace.learner.algorithms.dqn import DQN
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.config.hyperparameters import DQNConfig, PPOConfig
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.env_actions import make_action_converter
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.policy.torch_distributions import log_prob_and_entropy
from millrace.protocol.specs import PolicySpec
from tests.support.in_process.saved_policies import policy_run
from tests.support.numbers.batches import batch, no_pulse

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.dqn.policies import DQNPolicy

from examples.policy_in_sb3 import stable_baselines3_actor

OBSERVATION = spaces.Box(-np.inf, np.inf, (4,))
ACTIONS: dict[str, spaces.Space[Any]] = {
    "discrete": spaces.Discrete(5),
    "box": spaces.Box(-1, 1, (3,)),
    "multidiscrete": spaces.MultiDiscrete([2, 4, 3]),
    "multibinary": spaces.MultiBinary(3),
}
ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}
TOLERANCE = 1e-5
ROWS = 64


class Trunk(BaseFeaturesExtractor):
    """Hidden layers that actor and critic share: in Stable-Baselines3 they stand in the features extractor."""

    def __init__(self, observation_space: spaces.Space[Any], net: tuple[int, ...], activation: type[nn.Module]) -> None:
        super().__init__(observation_space, net[-1])
        layers: list[nn.Module] = []
        for inputs, outputs in zip((*OBSERVATION.shape, *net), net, strict=False):
            layers += [nn.Linear(inputs, outputs), activation()]
        self.layers = nn.Sequential(*layers)

    def forward(self, observations: Tensor) -> Tensor:
        out: Tensor = self.layers(observations)
        return out


def theirs(name: str) -> str:
    """Where Stable-Baselines3 has the array that we call so: their hidden layers are every second of a Sequential."""
    layer, _, kind = name.rpartition(".")
    match layer.split("."):
        case ["actor"]:
            return kind  # log_std
        case ["actor", "out"]:
            return f"action_net.{kind}"
        case ["critic", "out"]:
            return f"value_net.{kind}"
        case ["shared", i]:
            return f"features_extractor.layers.{2 * int(i)}.{kind}"
        case [net, i]:
            return f"mlp_extractor.{'policy' if net == 'actor' else 'value'}_net.{2 * int(i)}.{kind}"
    raise ValueError(name)


def exactly(state: Mapping[str, Tensor]) -> Callable[[nn.Module], None]:
    """Load these and nothing else; arrays that they hold twice (a shared extractor) may be named once."""

    def load(module: nn.Module) -> None:
        kept = dict(module.named_parameters())  # each once
        assert set(state) == set(kept)
        module.load_state_dict(dict(state), strict=len(kept) == len(module.state_dict()))

    return load


def policy_spec(action: spaces.Space[Any], **settings: Any) -> PolicySpec:
    return PolicySpec(observation_leaves(OBSERVATION), action_spec(action), **settings)


def trained(spec: PolicySpec) -> PPO:
    """After a few updates at a high learning rate, no weight is zero and no two layers are alike."""
    algorithm = PPO(
        PPOConfig(learning_rate=1e-2, batch_size=32, n_epochs=3, normalize_rewards=False), spec, total_steps=10_000, seed=1
    )
    for seed in range(4):
        algorithm.update(batch(algorithm, seed), no_pulse)
    flat = algorithm.net.flat
    flat.add_(0.01 * torch.randn(flat.shape, generator=torch.Generator().manual_seed(0)))  # units that never fire, too
    assert all(float(parameter.detach().abs().min()) > 0 for parameter in algorithm.net.parameters.values())
    return algorithm


def their_policy(spec: PolicySpec, action: spaces.Space[Any]) -> ActorCriticPolicy:
    """Theirs, of the same shape, with weights of its own."""
    torch.manual_seed(0)
    activation = ACTIVATIONS[spec.activation]
    if spec.shared_net:
        trunk: dict[str, Any] = {
            "features_extractor_class": Trunk,
            "features_extractor_kwargs": {"net": spec.net, "activation": activation},
            "net_arch": [],
        }
    else:
        trunk = {"net_arch": {"pi": list(spec.net), "vf": list(spec.net)}}
    return ActorCriticPolicy(OBSERVATION, action, lambda _: 0.0, activation_fn=activation, **trunk)


def differences(spec: PolicySpec, net: ActorCriticNetwork, other: ActorCriticPolicy) -> dict[str, float]:
    """The largest absolute difference of each thing that two policies say about the same observations and actions."""
    generator = np.random.default_rng(5)
    obs = generator.normal(0, 2, (ROWS, *OBSERVATION.shape)).astype(np.float32)
    acting, over = make_policy(spec), distribution(spec)
    acting.load(net.flat.numpy()[: net.acting_size], np.zeros(0, np.float32))
    params = acting([obs[None]])[0]
    action = over.sample(params, over.noise(generator, (ROWS,)))
    with torch.no_grad():
        given = torch.tensor(action, dtype=torch.float32)  # as they store every action
        value, log_prob, entropy = other.evaluate_actions(torch.tensor(obs), given)
        our_params, our_value = net.forward(torch.tensor(obs))
        our_log_prob, our_entropy = log_prob_and_entropy(spec.action, our_params, torch.tensor(action))
    assert entropy is not None
    greedy, _ = other.predict(obs, deterministic=True)
    pairs = {
        "greedy action": (np.stack(list(make_action_converter(spec.action)(over.mode(params)))), greedy),
        "value": (our_value.numpy(), value[:, 0].numpy()),
        "log π, torch": (our_log_prob.numpy(), log_prob.numpy()),
        "log π, numpy": (over.log_prob(params, action), log_prob.numpy()),
        "entropy": (our_entropy.numpy(), entropy.numpy()),
    }
    assert all(ours.shape == others.shape for ours, others in pairs.values())
    return {name: float(np.abs(ours - others).max()) for name, (ours, others) in pairs.items()}


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
@pytest.mark.parametrize("action", sorted(ACTIONS))
def test_our_weights_in_their_policy(action: str, activation: str, shared: bool) -> None:
    spec = policy_spec(ACTIONS[action], net=(16, 16), activation=activation, shared_net=shared)
    net, other = trained(spec).net, their_policy(spec, ACTIONS[action])
    assert max(differences(spec, net, other).values()) > 0.1, "two policies that differ look alike"
    exactly({theirs(name): parameter.detach() for name, parameter in net.parameters.items()})(other)
    found = differences(spec, net, other)
    assert max(found.values()) < TOLERANCE, found


@pytest.mark.parametrize("action", ["box", "discrete"])
def test_their_weights_in_our_network(action: str) -> None:
    spec = policy_spec(ACTIONS[action], net=(16, 12))
    other, net = their_policy(spec, ACTIONS[action]), ActorCriticNetwork(spec, seed=3)
    generator = torch.Generator().manual_seed(4)
    for own in other.parameters():
        own.data.normal_(0, 0.4, generator=generator)
    their_parameters = {name: parameter.detach() for name, parameter in other.named_parameters()}
    for name, parameter in net.parameters.items():
        parameter.detach().copy_(their_parameters.pop(theirs(name)))
    assert not their_parameters
    found = differences(spec, net, other)
    assert max(found.values()) < TOLERANCE, found


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("actor.0.bias", "greedy action"),
        ("actor.1.weight", "log π, numpy"),
        ("actor.log_std", "log π, torch"),
        ("critic.0.weight", "value"),
    ],
)
def test_two_swapped_weights_are_noticed(name: str, what: str) -> None:
    """The comparison itself: it must see the smallest mistake there is."""
    spec = policy_spec(ACTIONS["box"], net=(16, 16))
    net, other = trained(spec).net, their_policy(spec, ACTIONS["box"])
    state = {theirs(each): parameter.detach().clone() for each, parameter in net.parameters.items()}
    flat = state[theirs(name)].view(-1)
    flat[[0, 1]] = flat[[1, 0]]
    exactly(state)(other)
    assert differences(spec, net, other)[what] > 10 * TOLERANCE


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_action_values_are_theirs(activation: str) -> None:
    space = spaces.Discrete(5)
    config = msgspec.convert(
        {"activation": activation, "net": [16, 16], "learning_starts": 0, "learning_rate": 1e-2}, DQNConfig
    )
    spec = DQN.policy_spec(config, observation_leaves(OBSERVATION), action_spec(space))
    algorithm = DQN(config, spec, total_steps=10_000, seed=1)
    acted = PPO(PPOConfig(), policy_spec(space), total_steps=1, seed=0)  # any policy will do to fill the replay buffer
    for seed in range(2):
        algorithm.update(batch(acted, seed), no_pulse)
    torch.manual_seed(0)
    other = DQNPolicy(OBSERVATION, space, lambda _: 0.0, net_arch=list(spec.net), activation_fn=ACTIVATIONS[activation])
    obs = np.random.default_rng(5).normal(0, 2, (ROWS, 4)).astype(np.float32)
    ours, before = algorithm.net.head(torch.tensor(obs)).detach(), other.q_net(torch.tensor(obs)).detach()
    assert float((ours - before).abs().max()) > 0.1, "two policies that differ look alike"
    net: Any = algorithm.net
    arrays = [parameter.detach() for parameter in net.parameters.values()]
    for parameter, array in zip(other.q_net.parameters(), arrays, strict=True):
        parameter.data.copy_(array)
    np.testing.assert_allclose(other.q_net(torch.tensor(obs)).detach(), ours, rtol=TOLERANCE, atol=TOLERANCE)
    acting = make_policy(spec)
    acting.load(*algorithm.weights())
    greedy = distribution(spec).mode(acting([obs[None]])[0])
    assert len(set(greedy.tolist())) > 1
    np.testing.assert_array_equal(other.predict(obs, deterministic=True)[0], greedy)


# ----------------------------------------------------------------------------------------- a run folder, by the example


@pytest.mark.parametrize(("env", "activation", "normal"), [("CartPole-v1", "tanh", False), ("Pendulum-v1", "relu", True)])
def test_the_example_takes_a_run_to_stable_baselines3(tmp_path: Path, env: str, activation: str, normal: bool) -> None:
    made = gymnasium.make(env)
    spec = PolicySpec(
        observation_leaves(made.observation_space),
        action_spec(made.action_space),
        net=(16, 16),
        activation=activation,  # type: ignore[arg-type]
        normalize_observations=normal,
    )
    net = ActorCriticNetwork(spec)
    net.flat.normal_(0, 0.5, generator=torch.Generator().manual_seed(2))
    count = sum(int(np.prod(leaf.shape)) for leaf in spec.observation)
    buffers = np.random.default_rng(3).uniform(0.5, 2, 2 * count).astype(np.float32) if normal else np.zeros(0, np.float32)
    RunFolder(tmp_path).write_policy(policy_run(spec, EnvSpec(env)), net.flat.numpy(), buffers)
    act = stable_baselines3_actor(tmp_path)

    ours, over, write = make_policy(spec), distribution(spec), make_action_converter(spec.action)
    ours.load(net.flat.numpy()[: net.acting_size], buffers)
    obs, _ = made.reset(seed=1)
    made.action_space.seed(1)
    seen = set()
    for _ in range(200):
        (expected,) = write(over.mode(ours([np.asarray(obs, np.float32)[None, None]])[0]))
        action = act(obs)
        np.testing.assert_allclose(action, expected, rtol=0, atol=TOLERANCE)
        seen.add(np.asarray(action).tobytes())
        obs, _, terminated, truncated, _ = made.step(made.action_space.sample())
        if terminated or truncated:
            obs, _ = made.reset()
    made.close()
    assert len(seen) > 1
