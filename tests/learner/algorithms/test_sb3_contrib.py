"""Gradient steps of TQC and CrossQ are those of sb3-contrib in float64, for the same weights, batches and noise.

Where sb3-contrib departs from the formulas of the papers, this test changes it:
* It adds 1e-6 to 1 − tanh² in the density of an action: here 0.
* It normalizes by the unbiased variance of a minibatch, the authors of CrossQ by that of the population, as we do.
* In batch renormalization it divides the variance by r² and then adds ε, as the authors do. We divide both, as Ioffe (2017)
  does. Hence that case has an ε of nearly 0.
* It counts the passes that train each network, and then switches that network to renormalization, as the authors do: the
  actor k times later, for a `policy_delay` of k. Ours counts the gradient steps of the critics for both. Here theirs is told
  when.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor

from millrace.learner.algorithms.bodies import normalized_pass, stacked_mlps
from millrace.learner.algorithms.replay.replay_buffer import Sample
from tests.learner.algorithms.bodies import plain_formula as plain
from tests.learner.algorithms.test_continuous import made, sample_of
from tests.support.variants import variants

ROWS, STEPS = 32, 6
RATE = 1e-3
TOLERANCE: dict[str, Any] = {"rtol": 1e-8, "atol": 1e-11}
"""Adam divides by the root of a gradient's mean square: gradients near 0 lose digits"""
LOSSES = 1e-9
TQC: dict[str, Any] = {
    "net": (16, 16),
    "critics": 3,
    "quantiles": 8,
    "dropped_quantiles": 2,
}  # of their 25 fractions, float32 rounds some
CROSSQ: dict[str, Any] = {"net": (16, 12), "critic_net": (14, 18)}

pytestmark = pytest.mark.usefixtures("_float64")


def their_model(algo: str, **settings: Any) -> Any:
    """sb3-contrib's algorithm in float64."""
    contrib = pytest.importorskip("sb3_contrib")
    from stable_baselines3.common.logger import Logger

    env = gymnasium.make("Pendulum-v1")
    env.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,))
    env.action_space = gymnasium.spaces.Box(-1, 1, (2,))
    kind = {"tqc": contrib.TQC, "crossq": contrib.CrossQ}[algo]
    model = kind("MlpPolicy", env, device="cpu", learning_rate=RATE, buffer_size=1, verbose=0, **settings)
    model._logger = Logger(None, [])
    model.policy.double()
    model.actor.action_dist.epsilon = 0.0
    return model


def tensors_of(module: Any) -> list[Tensor]:
    """The parameters of their linear layers and normalizations in the order in which these stand."""
    return [parameter.data for parameter in module.parameters()]


def their_tensors(model: Any) -> dict[str, list[Tensor]]:
    """Parameters of the actor and of each critic, in the order of `our_tensors`."""
    *first, weight, log_std_weight, bias, log_std_bias = [
        *tensors_of(model.actor.latent_pi),
        model.actor.mu.weight.data,
        model.actor.log_std.weight.data,
        model.actor.mu.bias.data,
        model.actor.log_std.bias.data,
    ]
    found = {"actor": [*first, weight, log_std_weight, bias, log_std_bias]}
    for i, network in enumerate(model.critic.q_networks):
        found[f"critic {i}"] = tensors_of(network)
    for i, network in enumerate(model.critic_target.q_networks if hasattr(model, "critic_target") else []):
        found[f"target {i}"] = tensors_of(network)
    return found


def our_tensors(algorithm: Any) -> dict[str, list[Tensor]]:
    """Parameters of the actor and of each critic: views of each layer, those of its normalization first."""
    net, normalizes = algorithm.net, algorithm.net.statistics.numel() > 0

    def of(layers: list[plain.PlainLayer]) -> list[Tensor]:
        return [part for layer in layers for part in (layer if normalizes else layer[2:])]

    (actor,) = plain.layers(net.actor_body.shape, net.actor)
    *first, weight, bias = of(actor)
    found = {"actor": [*first, *weight.chunk(2), *bias.chunk(2)]}
    sources = {"critic": net.critics} | ({} if algorithm.target is net else {"target": algorithm.target.critics})
    for name, flat in sources.items():
        for i, layers in enumerate(plain.layers(net.critic_bodies.shape, flat)):
            found[f"{name} {i}"] = of(layers)
    return found


def norms_of(model: Any) -> list[list[Any]]:
    """Their normalizations: of the actor, and of each critic."""
    from sb3_contrib.common.torch_layers import BatchRenorm1d

    networks = [model.actor.latent_pi, *model.critic.q_networks]
    return [[module for module in network.modules() if isinstance(module, BatchRenorm1d)] for network in networks]


def statistics_of(algorithm: Any) -> list[list[plain.Statistics]]:
    """Views of our running statistics, in the order of `norms_of`."""
    net = algorithm.net
    size = sum(2 * size for size in net.actor_body.shape.sizes[:-1])
    return [
        *plain.statistics(net.actor_body.shape, net.statistics[:size]),
        *plain.statistics(net.critic_bodies.shape, net.statistics[size:]),
    ]


def step_both(model: Any, algorithm: Any, sample: Sample, noise: list[Tensor], monkeypatch: pytest.MonkeyPatch) -> None:
    """One gradient step of both, and a comparison of what they log.

    `noise`: of the next actions, then of the current ones. Theirs of TQC draws them the other way round.
    """
    from stable_baselines3.common import policies
    from stable_baselines3.common.distributions import DiagGaussianDistribution
    from stable_baselines3.common.type_aliases import ReplayBufferSamples

    monkeypatch.setattr(policies, "preprocess_obs", lambda obs, *_, **__: obs)  # it makes float32
    ours, theirs = list(noise), list(noise if hasattr(model, "policy_delay") else reversed(noise))
    algorithm.noise = lambda rows: ours.pop(0)

    def sampled(self: Any) -> Tensor:
        found: Tensor = self.distribution.mean + self.distribution.stddev * theirs.pop(0)
        return found

    monkeypatch.setattr(DiagGaussianDistribution, "sample", sampled)
    rows = sample.leaves[0], sample.action, sample.next_leaves[0], sample.discount == 0, sample.reward
    arrays = [torch.from_numpy(array.astype(np.float64)).reshape(ROWS, -1) for array in rows]
    names = ("observations", "actions", "next_observations", "dones", "rewards")
    gamma = torch.full((ROWS, 1), float(np.float32(0.99)))  # the discount of a stored row is float32
    given = ReplayBufferSamples(**dict(zip(names, arrays, strict=True)), discounts=gamma)
    monkeypatch.setattr(model.replay_buffer, "sample", lambda *a, **k: given)
    model.logger.name_to_value.clear()
    model.train(gradient_steps=1, batch_size=ROWS)
    metrics, _ = algorithm.step(algorithm.transitions(sample))
    logged = model.logger.name_to_value
    assert ("actor_loss" in metrics) == ("train/actor_loss" in logged)
    for name in ("critic_loss", "actor_loss", "ent_coef_loss", "ent_coef"):
        if name in metrics:
            assert metrics[name] == pytest.approx(logged[f"train/{name}"], rel=LOSSES, abs=1e-12), name


def their_numbers_match(model: Any, algorithm: Any) -> None:
    """All weights, and the temperature."""
    ours, theirs = our_tensors(algorithm), their_tensors(model)
    assert ours.keys() == theirs.keys()
    for name, arrays in ours.items():
        for mine, other in zip(arrays, theirs[name], strict=True):
            torch.testing.assert_close(mine, other, **TOLERANCE)
    torch.testing.assert_close(algorithm.log_temperature, model.log_ent_coef.detach(), rtol=1e-9, atol=1e-12)


def same_weights(model: Any, algorithm: Any) -> None:
    """Ours, moved away from zeros and ones, become theirs."""
    generator = torch.Generator().manual_seed(0)
    for flat in (algorithm.net.flat, algorithm.target.flat):
        flat.add_(torch.randn(len(flat), generator=generator), alpha=0.1)
    theirs = their_tensors(model)
    for name, arrays in our_tensors(algorithm).items():
        for mine, other in zip(arrays, theirs[name], strict=True):
            other.copy_(mine)


def steps_match(model: Any, algorithm: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six gradient steps of both."""
    assert algorithm.net.flat.dtype == torch.float64
    same_weights(model, algorithm)
    before = algorithm.net.flat.clone()
    generator = np.random.default_rng(0)
    for _ in range(STEPS):
        noise = list(torch.from_numpy(generator.normal(0, 1, (2, ROWS, 2))))
        step_both(model, algorithm, sample_of(generator, ROWS), noise, monkeypatch)
    assert not torch.isclose(algorithm.net.flat, before, **TOLERANCE).all()
    their_numbers_match(model, algorithm)


def test_gradient_steps_of_tqc_are_those_of_sb3_contrib(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = {"net_arch": [16, 16], "n_critics": 3, "n_quantiles": 8}
    model = their_model("tqc", policy_kwargs=policy, top_quantiles_to_drop_per_net=2)
    steps_match(model, made("tqc", learning_rate=RATE, **TQC), monkeypatch)


@pytest.mark.parametrize("delay", variants([1, 3], default=[3]))
@pytest.mark.parametrize("renormalizes", [False, True])
def test_gradient_steps_of_crossq_are_those_of_sb3_contrib(
    delay: int, renormalizes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also the running statistics. Units that are tanh never give the same number for all rows, whose variance is 0."""
    variance = torch.var
    monkeypatch.setattr(Tensor, "var", lambda self, dim: variance(self, dim=dim, correction=0))
    after = 3 if renormalizes else 1000
    policy: dict[str, Any] = {"net_arch": {"pi": [16, 12], "qf": [14, 18]}}
    if renormalizes:
        policy |= {"batch_norm_eps": 1e-12, "activation_fn": torch.nn.Tanh}
        for file in (normalized_pass, stacked_mlps):
            monkeypatch.setattr(file, "EPS", 1e-12)
    model = their_model("crossq", policy_kwargs=policy, policy_delay=delay)
    activation = "tanh" if renormalizes else "relu"
    algorithm = made(
        "crossq", learning_rate=RATE, policy_delay=delay, renormalize_after=after, activation=activation, **CROSSQ
    )
    for modules, passes in zip(norms_of(model), (after // delay, after, after), strict=True):
        for norm in modules:
            norm.warmup_steps = passes - 1  # theirs renormalizes when more passes than this came before
    steps_match(model, algorithm, monkeypatch)
    for modules, running in zip(norms_of(model), statistics_of(algorithm), strict=True):
        for norm, (mean, found) in zip(modules, running, strict=True):
            torch.testing.assert_close(mean, norm.ra_mean, **TOLERANCE)
            torch.testing.assert_close(found, norm.ra_var, **TOLERANCE)
