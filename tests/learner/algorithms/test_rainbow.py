"""Rainbow: its loss and targets by loops, workers act with the means of its quantiles, and a chain of known returns."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from millrace.learner.algorithms.bodies.networks import QNetwork
from millrace.learner.algorithms.bodies.stacked_mlps import initial
from millrace.learner.algorithms.rainbow import Rainbow
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.learner.config.hyperparameters import RainbowConfig
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.layout import named_views, parameter_layout, total_size
from millrace.protocol.policy.numpy_policy import NumpyPolicy
from millrace.protocol.policy.torch_policy import TorchPolicy
from millrace.protocol.random_streams import Purpose, torch_seed
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec
from tests.learner.algorithms.bodies import plain_formula as plain
from tests.learner.algorithms.test_action_masks import masked_batch, spec_of
from tests.support.numbers.batches import BOX, DISCRETE, GAUSSIAN, IMAGE, no_pulse

N = 6  # quantiles
B = 12
ROUNDING: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-11}
UNIT = 2.0**-24
"""a rounding of an operation in float32, relative"""
KINDS = pytest.mark.parametrize(("dueling", "batch_norm"), [(True, True), (True, False), (False, True), (False, False)])


def made(spaces: PolicySpec = DISCRETE, **settings: Any) -> Rainbow:
    """An algorithm whose numbers are neither 0 nor alike."""
    config = RainbowConfig(**{"net": (9, 8), "quantiles": N, "replay_size": 1000, "learning_starts": 0, **settings})
    policy = Rainbow.policy_spec(config, spaces.observation, spaces.action)
    algorithm = Rainbow(config, policy, total_steps=10_000, seed=0)
    generator = torch.Generator().manual_seed(1)
    for net in (algorithm.net, algorithm.target):
        net.flat.add_(torch.randn(len(net.flat), generator=generator), alpha=0.3)
        net.statistics.add_(torch.rand(len(net.statistics), generator=generator), alpha=0.5)
    return algorithm


def quantiles_of(algorithm: Rainbow, flat: Tensor, x: Tensor, normalize: Any = plain.of_minibatch) -> Tensor:
    """The quantiles [B, N, n] by the plain formula, with these parameters."""
    running = algorithm.net.statistics.to(x.dtype).clone()
    (out,) = plain.outputs(algorithm.net.body.shape, flat, x, normalize, running)
    return by_action(algorithm.policy, out)


def by_action(policy: PolicySpec, out: Tensor, sign: int = -1) -> Tensor:
    """Outputs [B, N (n + 1)], or [B, N n] without dueling, as quantiles [B, N, n]: V + A − mean A, or with another sign."""
    actions = policy.action.sizes[0]
    found = []
    for own in torch.split(out, actions + policy.dueling, 1):
        advantage = own[:, -actions:]
        found.append(own[:, :-actions] + advantage + sign * advantage.mean(1, keepdim=True) if policy.dueling else own)
    return torch.stack(found, 1)


def test_initial_weights_come_from_the_random_stream_of_weights() -> None:
    config = RainbowConfig(net=(9, 8), quantiles=N)
    policy = Rainbow.policy_spec(config, DISCRETE.observation, DISCRETE.action)
    net = Rainbow(config, policy, total_steps=10_000, seed=3).net
    assert torch.equal(net.flat, initial(net.body.shape, torch.Generator().manual_seed(torch_seed(3, Purpose.WEIGHTS))))


# -------------------------------------------------------------------- the loss


class Case:
    """An algorithm in float64 and rows of it, with masks, weights, and ends of episodes."""

    def __init__(self, **settings: Any) -> None:
        self.algorithm = made(spec_of("discrete"), priority_alpha=0.6, **settings)
        replay = self.algorithm.replay
        replay.add(masked_batch(self.algorithm, 0))
        replay.update_priorities(replay.sample(30).slots, np.linspace(0, 5, 30, dtype=np.float32))
        self.rows: Transitions = self.algorithm.transitions(replay.sample(B, beta=0.5))
        assert len(set(self.rows.discount.tolist())) >= 2, "some rows end an episode, and some do not"
        assert self.rows.weight.min() < 1

    def quantiles(self, flat: Tensor) -> tuple[Tensor, Tensor]:
        """Those [B, N, n] of the observations and of the next ones, which pass in one minibatch."""
        now, following = quantiles_of(self.algorithm, flat, torch.cat((self.rows.x, self.rows.next_x))).chunk(2)
        return now, following

    def targets(self) -> Tensor:
        """[B, N], row by row: the best of the allowed actions by expected value, of the network if double."""
        algorithm, rows = self.algorithm, self.rows
        _, target = self.quantiles(algorithm.target.flat)
        _, chooses = self.quantiles(algorithm.net.flat) if algorithm.config.double else (None, target)
        found = []
        assert rows.next_mask is not None
        for b in range(B):
            allowed = [a for a in range(5) if rows.next_mask[b, a]]
            best = max(allowed, key=lambda a: float(chooses[b, :, a].mean()))
            found.append(rows.reward[b] + rows.discount[b] * target[b, :, best])
        return torch.stack(found)

    def loss(self, flat: Tensor) -> Tensor:
        """Mean over rows of w / N² Σᵢⱼ |τᵢ − [u < 0]| H(u), u = yⱼ − zᵢ, term by term."""
        rows, targets = self.rows, self.targets()
        quantiles, _ = self.quantiles(flat)
        total = torch.zeros(())
        for b, i, j in np.ndindex(B, N, N):
            u = targets[b, j] - quantiles[b, i, rows.action[b]]
            huber = 0.5 * u**2 if abs(u) <= 1 else abs(u) - 0.5
            total = total + rows.weight[b] * abs((2 * i + 1) / (2 * N) - float(u < 0)) * huber
        return total / (B * N * N)


@pytest.mark.usefixtures("_float64")
@pytest.mark.parametrize(("double", "n_step"), [(True, 3), (False, 1)])
@KINDS
def test_the_loss_and_its_gradient_are_those_of_the_formula(
    dueling: bool, batch_norm: bool, double: bool, n_step: int
) -> None:
    given = Case(dueling=dueling, batch_norm=batch_norm, double=double, n_step=n_step)
    algorithm = given.algorithm
    torch.testing.assert_close(algorithm.targets(given.rows), given.targets(), **ROUNDING)
    leaf = algorithm.net.flat.clone().requires_grad_()
    expected = given.loss(leaf)
    found = algorithm.loss(given.rows)
    torch.testing.assert_close(found.loss, expected, **ROUNDING)
    algorithm.net.flat_grad.zero_()
    found.loss.backward()  # type: ignore[no-untyped-call]
    torch.testing.assert_close(algorithm.net.flat_grad, torch.autograd.grad(expected, leaf)[0], **ROUNDING)


@pytest.mark.usefixtures("_float64")
def test_errors_are_those_of_the_expected_values() -> None:
    given = Case()
    rows = given.rows
    quantiles, _ = given.quantiles(given.algorithm.net.flat)
    values = quantiles.mean(1)[torch.arange(B), rows.action]
    found = given.algorithm.loss(rows)
    torch.testing.assert_close(found.error, values - given.targets().mean(1), **ROUNDING)
    torch.testing.assert_close(found.numbers["q_mean"], values.mean(), **ROUNDING)


# -------------------------------------------------------------------- what workers act with


def action_values(algorithm: Rainbow, x: Tensor) -> tuple[Tensor, Tensor]:
    """The action values [B, n] of the inputs of the hidden layers [B, D] in float64, and how far float32 may be off.

    A sum or mean of k numbers is off by at most k roundings of the sum of their sizes; so is each layer by 10 more for its
    bias and for the normalization that is folded into it. Errors of earlier layers pass through the later ones. So action
    values are off by at most all these roundings times what the formula gives if each number in it is replaced by its size.
    The last layer is a mean of N; dueling adds a mean of n and two sums.
    """
    shape = algorithm.net.body.shape
    flat = algorithm.net.flat[-total_size(shape.fields()) :].double()
    x = x.double()

    def sizes(h: Tensor, layer: plain.PlainLayer, of: plain.Statistics) -> Tensor:
        return layer.gain * (h + of.mean.abs()) / (of.variance + plain.EPS).sqrt() + layer.shift

    (largest,) = plain.outputs(shape, flat.abs(), x.abs(), sizes, algorithm.net.statistics.double())
    roundings = sum(size + 10 for size in shape.sizes[:-1]) + N + (4 + 2)
    error = roundings * UNIT * by_action(algorithm.policy, largest, sign=1).mean(1)
    values = quantiles_of(algorithm, flat, x, plain.evaluated).mean(1)
    assert error.max() < 0.01 * (values.max() - values.min()), "the bound says something"
    return values, error


@KINDS
@pytest.mark.parametrize("kind", [NumpyPolicy, TorchPolicy])
def test_workers_act_with_the_means_of_the_quantiles(
    kind: Callable[[PolicySpec], Any], dueling: bool, batch_norm: bool
) -> None:
    algorithm = made(dueling=dueling, batch_norm=batch_norm)
    obs = np.random.default_rng(0).normal(0, 1, (1, 50, 4)).astype(np.float32)
    x = torch.from_numpy(obs[0])
    expected, error = action_values(algorithm, x)
    policy = kind(algorithm.policy)
    policy.load(*algorithm.weights())
    found = torch.from_numpy(policy([obs])[0, :, :4])
    assert ((found - expected).abs() <= error).all()
    assert ((algorithm.net.params(x) - expected).abs() <= error).all()


def observed_images() -> tuple[Tensor, list[Tensor]]:
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (20, 8, 8, 1), generator=generator, dtype=torch.uint8)
    return torch.randn(20, 4, generator=generator), [image]


@KINDS
def test_workers_who_see_images_act_with_the_means_of_the_quantiles(dueling: bool, batch_norm: bool) -> None:
    algorithm = made(IMAGE, dueling=dueling, batch_norm=batch_norm)
    acting = QNetwork(algorithm.policy)
    acting.flat.copy_(torch.from_numpy(algorithm.weights()[0]))
    observed = observed_images()
    expected, error = action_values(algorithm, acting.encode(*observed).detach())
    assert ((acting.params(*observed) - expected).abs() <= error).all()
    assert ((algorithm.net.params(*observed) - expected).abs() <= error).all()


def test_convolutions_are_trained_with_the_layers_behind_them() -> None:
    algorithm = made(IMAGE, max_grad_norm=None)
    before = algorithm.net.acting_parameters()
    x, images = observed_images()
    action = torch.zeros(10, dtype=torch.int64)
    ones = torch.ones(10)
    halves = [image.chunk(2) for image in images]
    algorithm.set_schedules()
    algorithm.step(
        Transitions(
            x[:10], tuple(half[0] for half in halves), action, ones, ones,
            x[10:], tuple(half[1] for half in halves), None, ones, x[10:],
        )
    )  # fmt: skip
    moved = named_views(algorithm.net.acting_parameters() - before, parameter_layout(algorithm.policy)[0])
    assert [name for name, change in moved.items() if name.startswith("image") and not change.any()] == []


def test_weights_that_were_published_stay_those_of_their_version() -> None:
    algorithm = made()
    published = algorithm.weights()[0]
    before = published.copy()
    algorithm.net.flat.add_(1)
    assert np.array_equal(published, before)


# -------------------------------------------------------------------- a chain whose returns are known

GAMMA = 0.5
SCALE = 1000
"""Huber's loss is quadratic within 1 of a return, so that a quantile may lie 1 beside its place: little on this scale."""
STATES = np.eye(2, dtype=np.float32)


def chain(batches: int) -> Batch:
    """0 → 1 → end, by action 0 or 1 of two.

    The first step pays 0 or 1000 and the second -1000 or 2000, each as often. Action 1 pays 5000 less.
    """
    numbers = np.random.default_rng(0)
    copies = 4 * batches
    action = numbers.integers(0, 2, (2, copies))
    each = np.array([[0, 0, 1, 1], [-1, 2, -1, 2]])
    reward = SCALE * (np.tile(each, batches) - 5 * action)
    return Batch(
        obs=(np.stack([np.tile(state, (copies, 1)) for state in (STATES[0], STATES[1], STATES[0])]),),
        action=action,
        log_prob=np.zeros((2, copies), np.float32),
        reward=reward.astype(np.float32),
        terminated=np.array([[False] * copies, [True] * copies]),
        truncated=np.zeros((2, copies), bool),
        valid=np.ones((2, copies), bool),
        state=np.zeros((copies, 0), np.float32),
        lane=np.zeros(copies, np.int64),
        fresh=np.ones(copies, bool),
        columns_per_rollout=copies,
        episodes=(),
    )


@pytest.mark.parametrize("dueling", [True, pytest.param(False, marks=pytest.mark.rest)])
def test_it_learns_the_mean_and_the_spread_of_the_returns_of_a_chain(dueling: bool) -> None:
    """From state 0, the returns of action 0 are -500, 1000, 500 and 2000, as in state 1 action 0 is the better one.

    Sampled rows are not exactly as often as they should be, and steps end at a distance of the learning rate: 3 %. Such a
    learning rate is that of a table, so the gains of batch normalization are left out.
    """
    spaces = PolicySpec((Leaf("", "box", (2,), "float32"),), ActionSpec("discrete", (), "int64", (2,), (0,)))
    algorithm = made(
        spaces, net=(), gamma=GAMMA, dueling=dueling, batch_norm=False, quantiles=8, n_step=1, batch_size=128,
        learning_rate=30.0, gradient_steps=600, tau=0.05, max_grad_norm=None, replay_size=20_000,
    )  # fmt: skip
    rows = chain(500)
    algorithm._total_steps = 4 * rows.env_steps
    for _ in range(4):
        algorithm.update(rows, no_pulse)
    found = quantiles_of(algorithm, algorithm.net.flat, torch.from_numpy(STATES), plain.evaluated)[0]  # [N, n]
    returns = SCALE * np.array([-0.5, 1.0, 0.5, 2.0])
    for action in range(2):
        assert float(found[:, action].mean()) == pytest.approx(returns.mean() - 5 * SCALE * action, abs=0.03 * SCALE)
        assert float(found[:, action].std(correction=0)) == pytest.approx(returns.std(), rel=0.03)


# -------------------------------------------------------------------- refusals


def test_actions_that_are_not_one_choice_are_refused() -> None:
    with pytest.raises(UsageError, match=r"rainbow: expected an action space Discrete\(n\), got box\[2\]; take --algo ppo"):
        Rainbow.policy_spec(RainbowConfig(), (BOX,), GAUSSIAN.action)
