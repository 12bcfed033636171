"""Action masks in losses, targets and the replay buffer. sb3-contrib's MaskablePPO is the judge of one PPO update."""

from __future__ import annotations

import itertools
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from millrace.learner.algorithms.actor_critic import ActorCritic
from millrace.learner.algorithms.dqn import DQN
from millrace.learner.algorithms.impala import IMPALA
from millrace.learner.algorithms.kernels import trained_networks
from millrace.learner.algorithms.minibatches import Minibatch, log_probs
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.algorithms.replay import ring
from millrace.learner.algorithms.replay.mixed_replay import MixedReplay
from millrace.learner.algorithms.replay.replay_buffer import Sample
from millrace.learner.config.hyperparameters import DQNConfig, IMPALAConfig, PPOConfig
from millrace.protocol.arrays import Array, Bools
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.masks import FORBIDDEN, forbid, masked_distribution, no_choice, not_allowed
from millrace.protocol.policy.numpy_policy import NumpyPolicy
from millrace.protocol.policy.torch_distributions import log_prob_and_entropy
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec
from tests.support.numbers.batches import batch, no_pulse

OBSERVATION = spaces.Box(-np.inf, np.inf, (4,))
ACTIONS: dict[str, Any] = {"discrete": spaces.Discrete(5), "multidiscrete": spaces.MultiDiscrete([2, 4, 3])}
MIXED = spaces.Tuple([spaces.Box(-1, 1, (2,)), spaces.Discrete(5), spaces.MultiBinary(2)])


def spec_of(action: str, **settings: Any) -> PolicySpec:
    space = MIXED if action == "mixed" else ACTIONS[action]
    return PolicySpec(observation_leaves(OBSERVATION), action_spec(space), (16, 16), **settings)


def random_masks(generator: np.random.Generator, shape: tuple[int, ...], sizes: tuple[int, ...]) -> Bools:
    """Masks [*shape, choices] with at least one allowed choice of each entry."""
    parts = []
    for size in sizes:
        part = generator.random((*shape, size)) < 0.5
        np.put_along_axis(part, generator.integers(0, size, (*shape, 1)), True, -1)
        parts.append(part)
    return np.concatenate(parts, -1)


def masked_batch(algorithm: Any, seed: int) -> Batch:
    """A batch of noise that the algorithm's weights acted on with masks."""
    rows, generator, spec = batch(algorithm, seed), np.random.default_rng(seed), algorithm.policy
    mask = random_masks(generator, rows.obs[0].shape[:2], spec.action.sizes)
    policy = NumpyPolicy(spec)
    policy.load(*algorithm.weights())
    params, over = forbid(policy([rows.obs[0][:-1]]), mask[:-1]), masked_distribution(spec)
    action = over.sample(params, over.noise(generator, params.shape[:2]))
    return msgspec.structs.replace(rows, mask=mask, action=action, log_prob=over.log_prob(params, action))


def ppo(action: str, **settings: Any) -> PPO:
    config = PPOConfig(**{"learning_rate": 1e-3, "batch_size": 512, "n_epochs": 1, "ent_coef": 0.1, **settings})
    algorithm = PPO(config, spec_of(action), total_steps=10_000, seed=3)
    for parameter in algorithm.net.parameters.values():
        parameter.detach().add_(0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)))
    return algorithm


def minibatch_of(algorithm: ActorCritic, rows: Batch) -> Minibatch:
    """All rows of a batch that are valid, as tensors."""
    observations = algorithm.observations(rows)
    estimates = algorithm.estimate(rows, observations, rows.reward, no_pulse)
    every = Minibatch.of(rows, observations, estimates.advantage, estimates.target)
    return every.select(torch.from_numpy(np.flatnonzero(estimates.used)))


def gradient(algorithm: ActorCritic, rows: Minibatch) -> dict[str, float]:
    """Writes the gradient of the loss of a minibatch."""
    loss, numbers = algorithm.loss(algorithm.evaluate(rows))
    return algorithm.differentiate(loss, algorithm.optimizers["optimizer"], numbers)


# -------------------------------------------------------------------- the distribution


@pytest.mark.parametrize("action", sorted(ACTIONS))
def test_a_forbidden_choice_is_never_sampled_and_the_others_share_its_probability(action: str) -> None:
    spec, generator = spec_of(action), np.random.default_rng(0)
    mask = random_masks(generator, (3,), spec.action.sizes)
    logits = generator.normal(0, 3, mask.shape).astype(np.float32)
    over, params = masked_distribution(spec), np.repeat(forbid(logits, mask)[None], 4000, 0)
    drawn = over.sample(params, over.noise(generator, params.shape[:2]))
    allowed = np.broadcast_to(mask, params.shape)
    assert not not_allowed(drawn, allowed, spec.action).any()
    assert not not_allowed(over.mode(params), allowed, spec.action).any()
    log_prob, entropy = log_prob_and_entropy(spec.action, torch.tensor(params[0]), torch.tensor(drawn[0]))
    np.testing.assert_allclose(over.log_prob(params[:1], drawn[:1])[0], log_prob.numpy(), atol=1e-5)
    starts = np.cumsum((0, *spec.action.sizes))
    expected = np.zeros(3)
    for a, b in itertools.pairwise(starts):
        for row in range(3):
            of_allowed = logits[row, a:b][mask[row, a:b]].astype(np.float64)
            p = np.exp(of_allowed - of_allowed.max())
            p /= p.sum()
            expected[row] -= (p * np.log(p)).sum()
    np.testing.assert_allclose(entropy.numpy(), expected, atol=1e-5)


def test_only_one_allowed_choice_has_probability_1_and_no_gradient() -> None:
    mask = torch.tensor([[False, True, False]])
    logits = torch.tensor([[50.0, -50.0, 3.0]], requires_grad=True)
    log_prob, entropy = log_prob_and_entropy(
        action_spec(spaces.Discrete(3)), logits.masked_fill(~mask, FORBIDDEN), torch.tensor([1])
    )
    (log_prob + entropy).sum().backward()  # type: ignore[no-untyped-call]
    assert (log_prob.item(), entropy.item()) == (0, 0)
    assert logits.grad is not None
    assert logits.grad.tolist() == [[0, 0, 0]]


def test_exploration_is_uniform_over_the_allowed_actions() -> None:
    spec, generator = spec_of("discrete", head="q"), np.random.default_rng(0)
    over, mask = masked_distribution(spec), np.array([True, False, True, False, True])
    for epsilon, chances in ((1.0, [1 / 3] * 3), (0.3, [0.1, 0.8, 0.1]), (0.0, [0, 1, 0])):
        params = np.tile(forbid(np.array([1, 9, 2, 8, -3, epsilon], np.float32), mask), (30_000, 1))
        drawn = over.sample(params, over.noise(generator, (30_000,)))
        counts = np.bincount(drawn, minlength=5) / len(drawn)
        np.testing.assert_allclose(counts[[0, 2, 4]], chances, atol=0.01)
        assert counts[1] == counts[3] == 0
        np.testing.assert_allclose(np.exp(over.log_prob(params[:3], np.array([0, 2, 4]))), chances, atol=1e-6)


def test_a_choice_for_each_entry() -> None:
    action = action_spec(ACTIONS["multidiscrete"])
    mask = np.ones(9, bool)
    assert not no_choice(mask, action)
    mask[2:6] = False
    assert no_choice(mask, action)


# -------------------------------------------------------------------- losses and gradients


@pytest.mark.parametrize("small", [True, False])
@pytest.mark.parametrize("action", [*sorted(ACTIONS), "mixed"])
def test_a_choice_that_is_always_forbidden_gets_no_gradient(
    action: str, small: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trained_networks, "is_small", lambda *_: small)
    algorithm = ppo(action)
    rows = masked_batch(algorithm, 0)
    assert rows.mask is not None
    forbidden = ~rows.mask[:-1][..., 1]
    rows = msgspec.structs.replace(rows, valid=rows.valid & forbidden)
    minibatch = minibatch_of(algorithm, rows)
    gradient(algorithm, minibatch)
    by_weight = algorithm.net.parameters["actor.out.weight"].grad
    assert by_weight is not None
    assert float(by_weight[1].abs().max()) == 0
    assert float(by_weight[2].abs().max()) > 0


@pytest.mark.parametrize("small", [True, False])
@pytest.mark.parametrize("action", sorted(ACTIONS))
def test_one_update_is_that_of_maskable_ppo(action: str, small: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The losses and the gradient of a minibatch, for the same weights and rows; the loss as MaskablePPO.train has it."""
    pytest.importorskip("sb3_contrib")
    from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy

    monkeypatch.setattr(trained_networks, "is_small", lambda *_: small)
    algorithm = ppo(action, vf_coef=0.5, normalize_advantage=True)
    rows = minibatch_of(algorithm, masked_batch(algorithm, 0))
    torch.manual_seed(0)
    other = MaskableActorCriticPolicy(
        OBSERVATION, ACTIONS[action], lambda _: 0.0, net_arch={"pi": [16, 16], "vf": [16, 16]}, activation_fn=torch.nn.Tanh
    )
    kept = dict(other.named_parameters())
    names = {_theirs(name): name for name in algorithm.net.parameters}
    assert set(names) == set(kept)
    other.load_state_dict(
        {name: algorithm.net.parameters[own].detach().clone() for name, own in names.items()}, strict=False
    )

    value, log_prob, entropy = other.evaluate_actions(
        rows.features, rows.action.float() if action == "discrete" else rows.action, rows.mask
    )
    assert entropy is not None
    advantage = (rows.advantage - rows.advantage.mean()) / (rows.advantage.std() + 1e-8)
    ratio = torch.exp(log_prob - rows.log_prob)
    policy_loss = -torch.min(advantage * ratio, advantage * torch.clamp(ratio, 0.8, 1.2)).mean()
    value_loss = torch.nn.functional.mse_loss(rows.target, value.flatten())
    their_losses = {"policy_gradient_loss": policy_loss, "value_loss": value_loss, "entropy_loss": -entropy.mean()}
    (policy_loss + 0.1 * -entropy.mean() + 0.5 * value_loss).backward()  # type: ignore[no-untyped-call]

    metrics = gradient(algorithm, rows)
    for name, theirs in their_losses.items():
        assert abs(metrics[name] - theirs.item()) < 1e-5 * max(1.0, abs(theirs.item())), name
    for name, own in names.items():
        ours, theirs_grad = algorithm.net.parameters[own].grad, kept[name].grad
        assert ours is not None
        assert theirs_grad is not None
        assert float((ours - theirs_grad).abs().max()) < 1e-6 * max(1.0, float(theirs_grad.abs().max())), name
    without = gradient(algorithm, rows._replace(mask=None))
    assert abs(without["entropy_loss"] - their_losses["entropy_loss"].item()) > 0.01, "the mask makes no difference"


def _theirs(name: str) -> str:
    layer, _, kind = name.rpartition(".")
    match layer.split("."):
        case ["actor", "out"]:
            return f"action_net.{kind}"
        case ["critic", "out"]:
            return f"value_net.{kind}"
        case [net, i]:
            return f"mlp_extractor.{'policy' if net == 'actor' else 'value'}_net.{2 * int(i)}.{kind}"
    raise ValueError(name)


def test_the_ratio_of_impala_is_1_under_the_policy_that_acted() -> None:
    algorithm = IMPALA(IMPALAConfig(), spec_of("multidiscrete"), total_steps=10_000, seed=0)
    rows = masked_batch(algorithm, 1)
    found = log_probs(algorithm.net, algorithm.observations(rows), rows, no_pulse)
    np.testing.assert_allclose(found[rows.valid], rows.log_prob[rows.valid], atol=1e-5)
    without = msgspec.structs.replace(rows, mask=None)
    assert np.abs(log_probs(algorithm.net, algorithm.observations(rows), without, no_pulse) - rows.log_prob).max() > 0.1


# -------------------------------------------------------------------- DQN


def dqn(**settings: Any) -> DQN:
    config = DQNConfig(net=(16,), replay_size=1000, learning_starts=0, gradient_steps=2, **settings)
    spec = DQN.policy_spec(config, observation_leaves(OBSERVATION), action_spec(ACTIONS["discrete"]))
    algorithm = DQN(config, spec, total_steps=10_000, seed=0)
    algorithm.target.flat.add_(0.3 * torch.randn(algorithm.target.flat.shape, generator=torch.Generator().manual_seed(1)))
    return algorithm


def true_masks(rows: Batch) -> Batch:
    """The same batch, with a mask that can be computed from the observation."""
    return msgspec.structs.replace(rows, mask=masks_of(rows.obs[0]))


def masks_of(obs: Array) -> Bools:
    mask = np.concatenate([obs > 2, np.ones((*obs.shape[:-1], 1), bool)], -1)
    return np.asarray(mask)


def values(net: Any, obs: Array) -> Array:
    with torch.no_grad():
        found: Tensor = net.params(torch.from_numpy(obs))
    return np.asarray(found.numpy())


@pytest.mark.parametrize("n_step", [1, 3])
@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("priority_alpha", [0.0, 0.6])
@pytest.mark.parametrize("small", [True, False])
def test_targets_are_the_best_of_the_allowed_actions_of_the_next_observation(
    n_step: int, double: bool, priority_alpha: float, small: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trained_networks, "is_small", lambda *_: small)
    algorithm = dqn(n_step=n_step, double=double, priority_alpha=priority_alpha)
    for seed in range(3):
        algorithm.replay.add(true_masks(masked_batch(algorithm, seed)))
    sample = algorithm.replay.sample(200)
    assert isinstance(sample, Sample)
    (following,) = sample.next_leaves
    allowed = masks_of(following)
    assert sample.next_mask is not None
    assert np.array_equal(sample.next_mask, allowed)
    target, own = values(algorithm.target, following), values(algorithm.net, following)
    best = np.where(allowed, own if double else target, -np.inf).argmax(1)
    expected = sample.reward + sample.discount * target[np.arange(200), best]
    np.testing.assert_allclose(algorithm.targets(algorithm.transitions(sample)).numpy(), expected, atol=1e-4)
    unmasked = algorithm.targets(algorithm.transitions(sample._replace(next_mask=None))).numpy()
    assert np.abs(unmasked - expected).max() > 0.05


def kept(algorithm: DQN) -> Array:
    """The masks that its buffer holds."""
    assert isinstance(algorithm.replay, MixedReplay)
    return algorithm.replay.arrays["mask"].copy()


def test_masks_are_overwritten_with_their_slots() -> None:
    algorithm = dqn()
    rows = [true_masks(masked_batch(algorithm, seed)) for seed in range(12)]  # more than fit
    for each in rows[:9]:
        algorithm.replay.add(each)
    before = kept(algorithm)
    for each in rows[9:]:
        algorithm.replay.add(each)
    assert not np.array_equal(before, kept(algorithm))
    sample = algorithm.replay.sample(500)
    assert isinstance(sample, Sample)
    assert sample.next_mask is not None
    assert np.array_equal(sample.next_mask, masks_of(sample.next_leaves[0]))


def test_masks_count_for_the_memory_and_are_refused_if_they_do_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    algorithm = dqn()
    replay, before = algorithm.replay, algorithm.replay.bytes
    masked = true_masks(masked_batch(algorithm, 0))
    monkeypatch.setattr(ring, "available_bytes", lambda: 2 * before)
    with pytest.raises(UsageError, match=r"^replay_size \d+: .*take --replay-size \d+ or less$"):
        replay.add(masked)
    assert len(replay) == 0
    monkeypatch.setattr(ring, "available_bytes", lambda: None)
    replay.add(masked)
    assert replay.bytes == before + kept(algorithm).nbytes


def test_without_masks_nothing_is_stored() -> None:
    algorithm = dqn()
    algorithm.replay.add(batch(algorithm, 0))
    assert isinstance(algorithm.replay, MixedReplay)
    assert "mask" not in algorithm.replay.arrays
    assert algorithm.replay.sample(4).next_mask is None
    assert "mask" not in algorithm.replay.state_dict()["arrays"]
    assert distribution(spec_of("discrete")).params_size == 5
