"""SAC and TD3: actions in [-1, 1], targets by hand, the replay ratio, and updates that equal those of Stable-Baselines3."""

from __future__ import annotations

import ast
import math
import re
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
import torch

import millrace.algorithms
import millrace.learner.algorithms
from millrace.learner.algorithms import algorithm_class
from millrace.learner.algorithms.kernels import trained_networks
from millrace.learner.algorithms.replay.continuous import Continuous
from millrace.learner.algorithms.replay.replay_buffer import Sample
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.protocol.arrays import Floats
from millrace.protocol.envs.env_actions import action_converter_of
from millrace.protocol.envs.spaces import action_spec
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.exploration import NoisyDeterministic, SquashedGaussian
from millrace.protocol.policy.layout import LOG_STD_BOUNDS, named_views
from millrace.protocol.policy.numpy_policy import NumpyPolicy
from millrace.protocol.policy.torch_distributions import squashed_sample
from millrace.protocol.policy.torch_policy import TorchPolicy
from millrace.protocol.random_streams import Purpose, torch_seed
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, Leaf

OBSERVATION = (Leaf("", "box", (3,), "float32"),)
ACTION = ActionSpec("box", (2,), "float32", low=(-2.0, 0.0), high=(2.0, 1.0))
SMALL: dict[str, Any] = {"net": (16, 16), "batch_size": 32, "replay_size": 2000, "learning_starts": 0, "rollout_steps": 8}
BOTH = pytest.mark.parametrize("algo", ["sac", "td3"])


def made(algo: str, action: ActionSpec = ACTION, seed: int = 0, **settings: Any) -> Any:
    kind: Any = algorithm_class(algo)
    config = msgspec.convert(SMALL | settings, HYPERPARAMETERS[algo])
    return kind(config, kind.policy_spec(config, OBSERVATION, action), total_steps=10_000, seed=seed)


def batch(seed: int, steps: int = 8, copies: int = 3, fresh: bool = False) -> Batch:
    """A batch of noise with ends of both kinds."""
    generator = np.random.default_rng(seed)
    ends, kind = generator.random((steps, copies)) < 0.15, generator.random((steps, copies)) < 0.5
    valid = np.ones((steps, copies), bool)
    for t in range(1, steps):
        valid[t] = ~ends[t - 1]
        ends[t] &= valid[t]
    return Batch(
        obs=(generator.normal(1, 2, (steps + 1, copies, 3)).astype(np.float32),),
        action=generator.uniform(-1, 1, (steps, copies, 2)).astype(np.float32),
        log_prob=np.zeros((steps, copies), np.float32),
        reward=generator.normal(1, 2, (steps, copies)).astype(np.float32),
        terminated=ends & kind,
        truncated=ends & ~kind,
        valid=valid,
        state=np.zeros((copies, 0), np.float32),
        lane=np.zeros(copies, np.int64),
        fresh=np.full(copies, fresh),
        columns_per_rollout=copies,
        episodes=(),
    )


def no_pulse() -> None:
    pass


# -------------------------------------------------------------------- actions


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (1.5, -1.0), (-2.0, 0.5), (0.3, 0.7)])
def test_the_density_of_squashed_actions_is_the_derivative_of_their_distribution(mean: float, log_std: float) -> None:
    """P(a ≤ A) by the normal distribution function; its numerical derivative is the density. It sums to 1."""
    noise: Any = np.linspace(-2, 2, 4001)  # float64, for the derivative
    params: Any = np.array([mean, log_std, 0.0])
    over = SquashedGaussian((1,))
    both: Any = np.stack([noise, np.zeros_like(noise)], -1)
    action = over.sample(np.broadcast_to(params, (4001, 3)), both)[:, 0]
    density = np.exp(over.log_prob(np.broadcast_to(params, (4001, 3)), action[:, None], both).astype(np.float64))
    between = np.array([0.5 * math.erf(z / math.sqrt(2)) for z in noise])
    middle = slice(1, -1)
    moved = action[2:] - action[:-2]
    np.testing.assert_allclose(density[middle], (between[2:] - between[:-2]) / moved, rtol=2e-4)
    np.testing.assert_allclose(np.trapezoid(density, action), math.erf(2 / math.sqrt(2)), rtol=1e-4)
    _, log_prob = squashed_sample(torch.tensor(params[:2]).expand(4001, 2), torch.tensor(noise)[:, None])
    np.testing.assert_allclose(log_prob.exp(), density, rtol=1e-5)


def test_an_action_at_the_bound_has_a_finite_density() -> None:
    params, noise = np.array([[30.0, 0.0, 0.0]], np.float32), np.array([[1.0, 0.0]], np.float32)
    over = SquashedGaussian((1,))
    assert over.sample(params, noise) == 1
    expected = -0.5 - 0.5 * math.log(2 * math.pi) - 2 * (math.log(2) - 31)  # log(1 − tanh²(31))
    assert over.log_prob(params, over.sample(params, noise), noise)[0] == pytest.approx(expected, rel=1e-5)
    with pytest.raises(ValueError, match="noise"):
        over.log_prob(params, over.sample(params, noise))


@pytest.mark.parametrize("over", [SquashedGaussian((2,)), NoisyDeterministic((2,))])
def test_actions_are_uniform_while_the_buffer_says_so(over: SquashedGaussian | NoisyDeterministic) -> None:
    generator = np.random.default_rng(0)
    params = np.zeros((20_000, over.params_size), np.float32)
    params[:, 0] = 3.0
    noise = over.noise(generator, (20_000,))
    acted = over.sample(params, noise)
    assert acted[:, 0].mean() > 0.8
    assert acted.dtype == np.float32
    params[:, -1] = 1
    uniform = over.sample(params, noise)
    counts = np.histogram(uniform, 10, (-1, 1))[0]
    assert counts.sum() == 40_000
    assert np.ptp(counts) < 400  # six standard deviations of a difference: 6 · √(2 · 3600)
    if isinstance(over, SquashedGaussian):
        np.testing.assert_allclose(over.log_prob(params, uniform, noise), -2 * math.log(2), rtol=1e-6)


def test_noise_of_a_deterministic_action_has_the_scale_of_the_buffer() -> None:
    over, generator = NoisyDeterministic((1,)), np.random.default_rng(0)
    params = np.tile(np.array([0.5, 0.1, 0], np.float32), (20_000, 1))
    acted = over.sample(params, over.noise(generator, (20_000,)))
    assert acted.mean() == pytest.approx(math.tanh(0.5), abs=0.005)
    assert acted.std() == pytest.approx(0.1, rel=0.03)
    assert over.mode(params)[0, 0] == pytest.approx(math.tanh(0.5))


@BOTH
def test_actions_are_scaled_to_the_bounds(algo: str) -> None:
    write = action_converter_of(made(algo).policy)
    stored = np.array([[-1, -1], [0, 0], [1, 1], [0.5, -0.5]], np.float32)
    assert write(stored).tolist() == [[-2, 0], [0, 0.5], [2, 1], [1, 0.25]]
    assert write(stored).dtype == np.float32


def test_actions_of_other_policies_are_clipped_as_before() -> None:
    ppo: Any = algorithm_class("ppo")
    write = action_converter_of(ppo.policy_spec(HYPERPARAMETERS["ppo"](), OBSERVATION, ACTION))
    assert write(np.array([[-9, 0.25]], np.float32)).tolist() == [[-2, 0.25]]


@BOTH
def test_workers_act_as_the_network_does(algo: str) -> None:
    """In numpy, in torch, and in the network that learns; warm-up and log std bounds included."""
    algorithm = made(algo, learning_starts=5, exploration_noise=0.3) if algo == "td3" else made(algo, learning_starts=5)
    algorithm.net.flat.normal_(0, 2, generator=torch.Generator().manual_seed(0))
    obs = np.random.default_rng(0).normal(0, 3, (1, 50, 3)).astype(np.float32)
    numpy_policy, torch_policy = NumpyPolicy(algorithm.policy), TorchPolicy(algorithm.policy)
    for policy in (numpy_policy, torch_policy):
        policy.load(*algorithm.weights())
    params, other = numpy_policy([obs]), torch_policy([obs])
    expected = algorithm.net.params(torch.tensor(obs[0])).detach().numpy()
    np.testing.assert_allclose(params[0, :, : expected.shape[1]], expected, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(other, params, rtol=1e-4, atol=1e-3)
    assert (params[..., -1] == 1).all(), "the warm-up lasts"
    if algo == "sac":
        assert (params[0, :, 2:4].min(), params[0, :, 2:4].max()) == LOG_STD_BOUNDS, "both bounds are met"
    else:
        assert (params[..., -2] == np.float32(0.3)).all()
    algorithm.update(batch(0), no_pulse)
    assert algorithm.weights()[1][-1] == 0, "the warm-up is over"
    assert distribution(algorithm.policy).params_size == params.shape[-1]


@BOTH
@pytest.mark.parametrize(("env_steps", "uniform"), [(23, 1), (24, 0)])
def test_actions_are_uniform_in_as_many_env_steps_as_learning_waits_for(algo: str, env_steps: int, uniform: int) -> None:
    algorithm = made(algo, learning_starts=24)
    algorithm.env_steps = env_steps
    assert algorithm.weights()[1][-1] == uniform


@BOTH
@pytest.mark.parametrize(
    ("observation", "action", "settings", "expected"),
    [
        (OBSERVATION, action_spec(gymnasium.spaces.Discrete(3)), {}, "Box, got discrete(?=.* ppo, dqn or rainbow for it)"),
        (OBSERVATION, action_spec(gymnasium.spaces.Box(-np.inf, np.inf, (2,))), {}, "finite bounds, got -inf to inf"),
        *(
            (
                OBSERVATION,
                action_spec(gymnasium.spaces.Box(-bound, bound, (2,), dtype)),
                {},
                re.escape(f"got -{bound:g} to {bound:g}"),
            )
            for bound, dtype in (
                (float(np.finfo(np.float64).max), np.float64),
                (float(np.finfo(np.float32).max), np.float32),
                (float(np.finfo(np.float32).max), np.float64),
                (float(np.finfo(np.float16).max), np.float16),
            )
        ),
    ],
)
def test_other_spaces_are_refused_in_one_line(
    algo: str, observation: tuple[Leaf, ...], action: ActionSpec, settings: dict[str, Any], expected: str
) -> None:
    kind: Any = algorithm_class(algo)
    with pytest.raises(UsageError, match=f"^{algo}: .*{expected}.*--algo ppo[^\n]*$"):
        kind.policy_spec(msgspec.convert(settings, HYPERPARAMETERS[algo]), observation, action)


# -------------------------------------------------------------------- what a run begins with


def test_noise_comes_from_its_own_random_stream() -> None:
    """If it were the stream of weights, noise would depend on them."""
    expected = torch.randn(5, 2, generator=torch.Generator().manual_seed(torch_seed(3, Purpose.NOISE)))
    assert torch.equal(made("sac", seed=3).noise(5), expected)


@pytest.mark.parametrize("algo", ["sac", "td3", "tqc", "xqc"])
def test_target_networks_begin_as_copies(algo: str) -> None:
    algorithm = made(algo, seed=3)
    assert algorithm.target is not algorithm.net
    assert torch.equal(algorithm.target.flat, algorithm.net.flat)


def test_the_learning_rates_of_critics_actor_and_temperature_all_follow_the_schedule() -> None:
    """After a quarter of the run."""
    algorithm = made("sac", learning_rate=1e-3, learning_rate_schedule="linear")
    algorithm.env_steps = 2_500
    algorithm.set_schedules()
    rates = {name: each.param_groups[0]["lr"] for name, each in algorithm.optimizers.items()}
    assert rates == dict.fromkeys(("actor_optimizer", "critic_optimizer", "ent_coef_optimizer"), 0.75e-3)


# -------------------------------------------------------------------- targets by hand


def rows_of(algorithm: Continuous, terminated: bool, truncated: bool) -> Transitions:
    """The second step of a walk of two, in tensors: reward 3, ended as asked."""
    obs = np.eye(3, dtype=np.float32)[:, None]
    ends = np.array([[False], [terminated]]), np.array([[False], [truncated]])
    walk = msgspec.structs.replace(
        batch(0, 2, 1),
        obs=(obs,),
        reward=np.array([[1], [3]], np.float32),
        terminated=ends[0],
        truncated=ends[1],
        valid=np.ones((2, 1), bool),
    )
    algorithm.replay.add(walk)
    sample = algorithm.replay.sample(64)
    assert isinstance(sample, Sample)
    second = sample.leaves[0][:, 1] == 1
    assert second.any()
    assert not second.all()
    return algorithm.transitions(sample._replace(**{
        name: getattr(sample, name)[second] for name in ("slots", "action", "reward", "discount", "weight")
    }, leaves=(sample.leaves[0][second],), next_leaves=(sample.next_leaves[0][second],)))  # fmt: skip


def as_table(algorithm: Any) -> None:
    """Networks without hidden layers: Q₀ = 5, Q₁ = 7 in the last state; (1, -1) is the action before the tangent."""
    for net in (algorithm.net, algorithm.target):
        net.flat.zero_()
        fields = named_views(net.flat.numpy(), net.fields)
        fields["critic0.out.weight"][0, 2], fields["critic1.out.weight"][0, 2] = 5, 7
        fields["critic0.out.weight"][0, 3], fields["critic1.out.weight"][0, 3] = 1, 1  # for the action
        fields["actor.out.bias"][:2] = 1, -1


@pytest.mark.parametrize(("terminated", "truncated"), [(False, False), (True, False), (False, True), (True, True)])
def test_targets_bootstrap_unless_the_task_has_terminated(terminated: bool, truncated: bool) -> None:
    noise = torch.full((1, 2), 0.5)
    sac, td3 = (made(algo, net=(), gamma=0.5) for algo in ("sac", "td3"))
    for algorithm in (sac, td3):
        as_table(algorithm)
    sac.log_temperature.fill_(math.log(0.2))
    sac.noise, td3.noise = lambda rows: noise, lambda rows: 10 * noise  # 10 · 0.5 · 0.2 is clipped to 0.5
    found = sac.targets(rows_of(sac, terminated, truncated))
    latent = np.array([1.5, -0.5])
    log_prob = (-0.125 - 0.5 * math.log(2 * math.pi) - np.log(1 - np.tanh(latent) ** 2)).sum()
    value = 5 + math.tanh(1.5) - 0.2 * log_prob
    np.testing.assert_allclose(found, 3 + (0 if terminated else 0.5 * value), rtol=1e-5)

    found = td3.targets(rows_of(td3, terminated, truncated))
    value = 5 + min(1, math.tanh(1) + 0.5)
    np.testing.assert_allclose(found, 3 + (0 if terminated else 0.5 * value), rtol=1e-5)


def ring(terminated: bool, truncated: bool) -> Batch:
    """0 → 1 → 2 → 0 with rewards 1, 3 and -2 and random actions, 30 times; each third step ends as asked."""
    episodes, generator = 30, np.random.default_rng(0)
    last = np.tile([False, False, True], (episodes, 1)).T
    return msgspec.structs.replace(
        batch(0, 3, episodes),
        obs=(np.repeat(np.eye(3, dtype=np.float32)[[0, 1, 2, 0], None], episodes, 1),),
        action=generator.uniform(-1, 1, (3, episodes, 2)).astype(np.float32),
        reward=np.repeat(np.array([[1], [3], [-2]], np.float32), episodes, 1),
        terminated=last & terminated,
        truncated=last & truncated,
        valid=np.ones((3, episodes), bool),
    )


@pytest.mark.parametrize(
    ("algo", "terminated", "truncated", "n_step"),
    [("sac", True, False, 1), ("sac", False, True, 2), ("td3", True, True, 2), ("td3", False, True, 1)],
)
def test_values_of_a_chain_are_learned(algo: str, terminated: bool, truncated: bool, n_step: int) -> None:
    """V(2) = -2 if the task ends there, else -2 + γ V(0); V(1) = 3 + γ V(2); V(0) = 1 + γ V(1)."""
    fixed: dict[str, Any] = {"ent_coef": 1e-9} if algo == "sac" else {}
    settings: dict[str, Any] = {
        "net": (),
        "gamma": 0.5,
        "tau": 0.2,
        "learning_rate": 0.02,
        "n_step": n_step,
        "batch_size": 64,
    }
    algorithm = made(algo, **settings, **fixed)
    algorithm.replay.add(ring(terminated, truncated))
    for left in range(200, 0, -1):
        for optimizer in algorithm.optimizers.values():
            optimizer.param_groups[0]["lr"] = 0.1 * left / 200
        algorithm.step(algorithm.transitions(algorithm.replay.sample(32)))
    around = np.array([[0, 0.5, 0], [0, 0, 0.5], [0 if terminated else 0.5, 0, 0]])
    expected = np.linalg.solve(np.eye(3) - around, [1, 3, -2])
    found = algorithm.net.values(torch.eye(3), torch.zeros(3, 2)).detach().numpy()
    np.testing.assert_allclose(found, [expected, expected], atol=0.1)  # the values of the two kinds of end differ by 0.28


# -------------------------------------------------------------------- the replay ratio


@BOTH
@pytest.mark.parametrize(("ratio", "starts"), [(1.0, 100), (0.29, 0), (2.5, 37), (0.1, 1)])
def test_gradient_steps_are_exactly_those_of_the_replay_ratio(algo: str, ratio: float, starts: int) -> None:
    algorithm = made(algo, net=(4,), batch_size=4, updates_per_step=ratio, learning_starts=starts)
    pulses = []
    for seed, (steps, copies) in enumerate([(7, 3), (1, 3), (13, 3), (5, 3), (3, 3), (20, 3), (1, 3)]):
        algorithm.update(batch(seed, steps, copies), lambda: pulses.append(1))
        expected = round(ratio * 100) * max(0, algorithm.env_steps - starts) // 100
        assert algorithm.gradient_steps == len(pulses) == expected
    assert algorithm.gradient_steps > 0


def test_the_ratio_counts_on_from_where_it_is_changed() -> None:
    before = made("sac", net=(4,), batch_size=4, updates_per_step=1.0)
    before.update(batch(0), no_pulse)
    after = made("sac", net=(4,), batch_size=4, updates_per_step=0.5)
    after.load_state_dict(before.state_dict())
    made_so_far, env_steps = after.gradient_steps, after.env_steps
    for seed in range(1, 4):
        after.update(batch(seed), no_pulse)
        assert after.gradient_steps == made_so_far + (after.env_steps - env_steps) // 2


# -------------------------------------------------------------------- reward normalization


@pytest.mark.parametrize("algo", ["sac", "td3", "dqn"])
def test_with_normalized_rewards_their_scale_does_not_matter(algo: str) -> None:
    """A power of two scales float32 numbers exactly."""
    action = action_spec(gymnasium.spaces.Discrete(3)) if algo == "dqn" else ACTION
    settings: dict[str, Any] = {"gradient_steps": 5} if algo == "dqn" else {"updates_per_step": 0.2}
    weights = []
    for scale, normalize in ((1, True), (1024, True), (1024, False)):
        algorithm = made(algo, action, normalize_rewards=normalize, batch_size=16, n_step=2, **settings)
        for seed in range(3):
            noise = batch(seed)
            taken = np.arange(24).reshape(8, 3) % 3 if algo == "dqn" else noise.action
            algorithm.update(msgspec.structs.replace(noise, action=taken, reward=noise.reward * np.float32(scale)), no_pulse)
        weights.append(algorithm.weights()[0])
        std = algorithm.rewards.std
        assert std == 1 if not normalize else 2 * scale < std < 20 * scale, "the rewards have mean 1 and deviation 2"
    np.testing.assert_array_equal(weights[0], weights[1])
    assert not np.array_equal(weights[1], weights[2])


@pytest.mark.parametrize("name", ["sac", "td3", "replay/continuous", "replay/off_policy"])
def test_they_import_nothing_that_a_user_could_not(name: str) -> None:
    """Every name of ours that these files import, kernels aside, is the object that `millrace.algorithms` exports."""
    path = Path(millrace.learner.algorithms.__file__).parent / f"{name}.py"
    aliases = {"millrace.protocol.arrays"}  # names of numpy's array types
    found = [
        (node.module, alias.name)
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
        if node.module.split(".")[0] == "millrace"
        and not node.module.startswith("millrace.learner.algorithms.kernels.")
        and node.module not in aliases
    ]
    assert len(found) > 5
    for module, imported in found:
        ours = getattr(__import__(module, fromlist=[imported]), imported)
        assert imported in millrace.algorithms.__all__, f"{name}.py imports {imported}, which millrace.algorithms lacks"
        assert getattr(millrace.algorithms, imported) is ours


# -------------------------------------------------------------------- Stable-Baselines3, in float64


def sample_of(generator: np.random.Generator, rows: int) -> Sample:
    def normal(*shape: int) -> Floats:
        return generator.normal(0, 1, shape).astype(np.float32)

    return Sample(
        slots=np.arange(rows),
        leaves=(normal(rows, 3),),
        action=np.tanh(normal(rows, 2)),
        reward=normal(rows),
        discount=np.where(generator.random(rows) < 0.3, 0, 0.99).astype(np.float32),
        next_leaves=(normal(rows, 3),),
        weight=np.ones(rows, np.float32),
    )


def copy_into(module: Any, arrays: dict[str, torch.Tensor], layers: list[str]) -> None:
    """Our layers into the parameters of their module, in order."""
    theirs = list(module.parameters())
    ours = [arrays[f"{layer}.{kind}"] for layer in layers for kind in ("weight", "bias")]
    for parameter, array in zip(theirs, ours, strict=True):
        parameter.data.copy_(array)


def their_model(algo: str, algorithm: Any) -> Any:
    """Stable-Baselines3's algorithm in float64 with the same weights."""
    sb3 = pytest.importorskip("stable_baselines3")
    env = gymnasium.make("Pendulum-v1")
    env.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,))
    env.action_space = gymnasium.spaces.Box(-1, 1, (2,))
    kind = {"sac": sb3.SAC, "td3": sb3.TD3}[algo]
    model = kind("MlpPolicy", env, policy_kwargs={"net_arch": [16, 16]}, device="cpu", learning_rate=1e-3, verbose=0)
    model._logger = sb3.common.logger.Logger(None, [])
    for net, suffix in ((algorithm.net, ""), (algorithm.target, "_target")):
        arrays = {name: array.detach() for name, array in net.parameters.items()}
        critic = getattr(model, f"critic{suffix}")
        for i in (0, 1):
            copy_into(critic.q_networks[i], arrays, [f"critic{i}.0", f"critic{i}.1", f"critic{i}.out"])
        if algo == "td3":
            copy_into(getattr(model, f"actor{suffix}").mu, arrays, ["actor.0", "actor.1", "actor.out"])
    if algo == "sac":
        arrays = {name: array.detach() for name, array in algorithm.net.parameters.items()}
        copy_into(model.actor.latent_pi, arrays, ["actor.0", "actor.1"])
        for i, head in enumerate((model.actor.mu, model.actor.log_std)):
            head.weight.data.copy_(arrays["actor.out.weight"][2 * i : 2 * i + 2])
            head.bias.data.copy_(arrays["actor.out.bias"][2 * i : 2 * i + 2])
        model.actor.action_dist.epsilon = 0.0  # which it adds to 1 − tanh²; ours is exact
    return model


@BOTH
@pytest.mark.parametrize("small", [True, False])
@pytest.mark.usefixtures("_float64")
def test_updates_are_those_of_stable_baselines3(algo: str, small: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six gradient steps: losses, both networks, their targets and the temperature, for the same batches and noise."""
    monkeypatch.setattr(trained_networks, "is_small", lambda *_: small)
    algorithm = made(algo, learning_rate=1e-3)
    assert algorithm.net.flat.dtype == torch.float64
    model = their_model(algo, algorithm)
    from stable_baselines3.common import policies
    from stable_baselines3.common.distributions import DiagGaussianDistribution
    from stable_baselines3.common.type_aliases import ReplayBufferSamples

    monkeypatch.setattr(policies, "preprocess_obs", lambda obs, *_, **__: obs)  # it makes float32
    generator, losses = np.random.default_rng(0), []
    for _ in range(6):
        sample = sample_of(generator, 32)
        noise = torch.from_numpy(generator.normal(0, 1, (2, 32, 2)))
        current = [noise[1], noise[0]]  # theirs draws the action of the current state first
        ours = [noise[0], noise[1]]  # that of the next state first
        algorithm.noise = lambda rows, ours=ours: ours.pop(0)

        def sampled(self: Any, current: list[torch.Tensor] = current) -> torch.Tensor:
            mean, std = self.distribution.mean, self.distribution.stddev
            result: torch.Tensor = mean + std * current.pop(0)
            return result

        monkeypatch.setattr(DiagGaussianDistribution, "sample", sampled)
        if algo == "td3":
            draw = lambda tensor, mean, std, noise=noise: tensor.copy_(mean + std * noise[0])  # noqa: E731
            monkeypatch.setattr(torch.Tensor, "normal_", draw)
        sampled_rows = sample.leaves[0], sample.action, sample.next_leaves[0], sample.discount == 0, sample.reward
        arrays = [torch.from_numpy(array.astype(np.float64)).reshape(32, -1) for array in sampled_rows]
        fields = dict(zip(("observations", "actions", "next_observations", "dones", "rewards"), arrays, strict=True))
        if "discounts" in ReplayBufferSamples._fields:
            fields["discounts"] = torch.full((32, 1), float(np.float32(0.99)))
        model.gamma = float(np.float32(0.99))  # the discount of a stored row is float32
        theirs = ReplayBufferSamples(**fields)
        monkeypatch.setattr(model.replay_buffer, "sample", lambda *a, theirs=theirs, **k: theirs)
        model.train(gradient_steps=1, batch_size=32)
        metrics, _ = algorithm.step(algorithm.transitions(sample))
        logged = model.logger.name_to_value
        losses.append(metrics["critic_loss"])
        assert metrics["critic_loss"] == pytest.approx(logged["train/critic_loss"], rel=1e-9)
        if "actor_loss" in metrics:
            assert metrics["actor_loss"] == pytest.approx(logged["train/actor_loss"], rel=1e-9)
        if algo == "sac":
            assert metrics["ent_coef"] == pytest.approx(logged["train/ent_coef"], rel=1e-9)
    assert len(set(losses)) == 6
    their_weights_match(algo, model, algorithm)


def their_weights_match(algo: str, model: Any, algorithm: Any) -> None:
    """Every weight that the updates changed."""
    tolerance = 1e-6  # Adam divides by the root of a gradient's mean square: gradients near 0 lose digits
    for net, suffix in ((algorithm.net, ""), (algorithm.target, "_target")):
        arrays = {name: array.detach() for name, array in net.parameters.items()}
        critic = getattr(model, f"critic{suffix}")
        for i in (0, 1):
            ours = [arrays[f"critic{i}.{layer}.{kind}"] for layer in ("0", "1", "out") for kind in ("weight", "bias")]
            for mine, theirs in zip(ours, critic.q_networks[i].parameters(), strict=True):
                torch.testing.assert_close(mine, theirs.detach(), rtol=tolerance, atol=1e-9)
    mine = algorithm.net.parameters["actor.0.weight"].detach()
    theirs = (model.actor.latent_pi if algo == "sac" else model.actor.mu)[0].weight.detach()
    torch.testing.assert_close(mine, theirs, rtol=tolerance, atol=1e-9)
    head = algorithm.net.parameters["actor.out.weight"].detach()
    others = torch.cat([model.actor.mu.weight, model.actor.log_std.weight]) if algo == "sac" else model.actor.mu[4].weight
    torch.testing.assert_close(head, others.detach(), rtol=tolerance, atol=1e-9)
    if algo == "sac":
        torch.testing.assert_close(algorithm.log_temperature, model.log_ent_coef.detach(), rtol=1e-9, atol=1e-12)
    else:
        target = algorithm.target.parameters["actor.0.weight"].detach()
        torch.testing.assert_close(target, model.actor_target.mu[0].weight.detach(), rtol=tolerance, atol=1e-9)
