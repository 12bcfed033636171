"""DQN: its targets by hand, what moves the target network and ε, what it learns and refuses."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from millrace.learner.algorithms.dqn import DQN, LOSSES, exploration_rate
from millrace.learner.algorithms.replay import ring
from millrace.learner.algorithms.replay.replay_buffer import Sample
from millrace.learner.algorithms.running_statistics import RewardScaler
from millrace.learner.config.hyperparameters import DQNConfig
from millrace.protocol.arrays import Floats, Ints
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.layout import named_views
from millrace.protocol.policy.numpy_policy import NumpyPolicy
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, Leaf
from tests.support.numbers.batches import BOX, no_pulse
from tests.support.numbers.batches import batch as noise_batch
from tests.support.numbers.prior_data import GivenPrior
from tests.support.numbers.rounding import flat_gradient, in_float64, sampled

CHOICE = ActionSpec("discrete", (), "int64", (4,), (0,))
PLAIN = DQNConfig(net=(16,), replay_size=1000, learning_starts=0, gradient_steps=5, target_every=7)


def changed(config: DQNConfig, **settings: Any) -> DQNConfig:
    return msgspec.structs.replace(config, **settings)


def dqn(config: DQNConfig = PLAIN) -> DQN:
    return DQN(config, DQN.policy_spec(config, (BOX,), CHOICE), total_steps=10_000, seed=0)


def batch(seed: int) -> Batch:
    """A batch of noise with ends of both kinds, and random actions."""
    return noise_batch(dqn(), seed)


def test_rewards_of_prior_data_count_for_the_scale_of_all_rewards() -> None:
    algorithm, scaler = dqn(changed(PLAIN, normalize_rewards=True)), RewardScaler(PLAIN.gamma)
    prior, own = batch(1), batch(2)
    algorithm.add_prior(GivenPrior([prior]))
    scaler.count(prior)
    assert scaler.std > 2
    (drawn,) = algorithm.replay.samples(1, 64, 1.0)
    assert np.isin(algorithm.transitions(drawn).reward.numpy(), (prior.reward / scaler.std).astype(np.float32)).all()
    algorithm.update(own, no_pulse)
    scaler.count(own)
    assert algorithm.rewards.std == scaler.std


def test_a_resumed_run_takes_its_new_learning_rate_for_prior_data_too() -> None:
    """The optimizer's state has the rate that it was saved with."""
    interrupted = dqn(changed(PLAIN, prior_steps=2))
    resumed = dqn(changed(PLAIN, prior_steps=5, learning_rate=10 * PLAIN.learning_rate))
    for each in (interrupted, resumed):
        each.add_prior(GivenPrior([batch(1)]))
    interrupted.learn_from_prior(no_pulse)
    resumed.load_state_dict(interrupted.state_dict())
    resumed.learn_from_prior(no_pulse)
    assert resumed.gradient_steps == 5
    assert resumed.optimizers["optimizer"].param_groups[0]["lr"] == 10 * PLAIN.learning_rate


# -------------------------------------------------------------------- a chain of three states, by hand

STATES = np.eye(3, dtype=np.float32)
Q = np.array([[1.0, 5.0, 2.0], [3.0, 4.0, 7.0]], np.float32)  # [action, state], of the network
Q_TARGET = np.array([[10.0, 20.0, 30.0], [40.0, 50.0, 5.0]], np.float32)  # of the target


def chain(**settings: Any) -> DQN:
    """A network that is a table."""
    config = DQNConfig(net=(), gamma=0.5, replay_size=100, **settings)
    spec = DQN.policy_spec(config, (Leaf("", "box", (3,), "float32"),), ActionSpec("discrete", (), "int64", (2,), (0,)))
    made = DQN(config, spec, total_steps=1000, seed=0)
    networks: list[Any] = [made.net, made.target]
    for net, table in zip(networks, (Q, Q_TARGET), strict=True):
        net.flat.zero_()
        named_views(net.flat.numpy(), net.fields)["q.out.weight"][:] = table
    return made


def walk(terminated: bool, truncated: bool = False) -> Batch:
    """0 → 1 → 2, with rewards 1 and 3, by actions 1 and 0; the second step ends as asked."""
    ends = np.array([[False], [terminated]]), np.array([[False], [truncated]])
    return Batch(
        obs=(STATES[:, None],),
        action=np.array([[1], [0]]),
        log_prob=np.zeros((2, 1), np.float32),
        reward=np.array([[1], [3]], np.float32),
        terminated=ends[0],
        truncated=ends[1],
        valid=np.ones((2, 1), bool),
        state=np.zeros((1, 0), np.float32),
        lane=np.zeros(1, np.int64),
        fresh=np.ones(1, bool),
        columns_per_rollout=1,
        episodes=(),
    )


@pytest.mark.parametrize(
    ("double", "n_step", "end", "from_0", "from_1"),
    [
        (False, 1, "none", 1 + 0.5 * 50, 3 + 0.5 * 30),  # max Q′(1) = 50, max Q′(2) = 30
        (False, 1, "truncated", 1 + 0.5 * 50, 3 + 0.5 * 30),
        (False, 1, "terminated", 1 + 0.5 * 50, 3),
        (True, 1, "none", 1 + 0.5 * 20, 3 + 0.5 * 5),  # Q prefers 0 in state 1 and 1 in state 2: Q′ says 20 and 5
        (True, 1, "terminated", 1 + 0.5 * 20, 3),
        (True, 2, "none", 1 + 0.5 * 3 + 0.25 * 5, 3 + 0.5 * 5),
        (False, 2, "truncated", 1 + 0.5 * 3 + 0.25 * 30, 3 + 0.5 * 30),
        (False, 2, "terminated", 1 + 0.5 * 3, 3),
        (False, 5, "both", 1 + 0.5 * 3, 3),
    ],
)
def test_targets_on_a_chain_by_hand(double: bool, n_step: int, end: str, from_0: float, from_1: float) -> None:
    made = chain(double=double, n_step=n_step)
    made.replay.add(walk(end in ("terminated", "both"), end in ("truncated", "both")))
    drawn = made.replay.sample(50)
    expected = np.where(drawn.leaves[0][:, 0] == 1, from_0, from_1)
    assert len(set(expected)) == 2
    np.testing.assert_allclose(made.targets(made.transitions(drawn)).numpy(), expected, rtol=1e-6)


# -------------------------------------------------------------------- a gradient step


@pytest.mark.parametrize("name", ["huber", "squared"])
def test_the_gradient_of_a_loss_is_autograds(name: str) -> None:
    generator = torch.Generator().manual_seed(0)
    error = (3 * torch.randn(50, generator=generator)).requires_grad_()
    weight = torch.rand(50, generator=generator)
    usual: Any = torch.nn.functional.huber_loss if name == "huber" else torch.nn.functional.mse_loss
    expected = (weight * usual(error, torch.zeros(50), reduction="none")).mean()
    loss = LOSSES[name](error, weight)
    torch.testing.assert_close(loss, expected)
    torch.testing.assert_close(*(torch.autograd.grad(each, error)[0] for each in (loss, expected)))


@pytest.mark.parametrize("dueling", [False, True])
def test_a_step_follows_the_gradient_of_the_usual_loss(dueling: bool) -> None:
    made = dqn(changed(PLAIN, dueling=dueling, priority_alpha=0.6, double=False))
    made.replay.add(batch(0))
    made.target.flat.mul_(1.5)
    first = made.replay.sample(30)
    made.replay.update_priorities(first.slots, np.linspace(0, 5, 30, dtype=np.float32))
    drawn = made.replay.sample(64, beta=0.5)
    assert isinstance(drawn, Sample)
    x, following = torch.from_numpy(drawn.leaves[0]).double(), torch.from_numpy(drawn.next_leaves[0]).double()
    reward, discount, weight = (torch.from_numpy(each).double() for each in (drawn.reward, drawn.discount, drawn.weight))
    networks: list[Any] = [made.net, made.target]
    net, target_net = map(in_float64, networks)

    def usual() -> list[torch.Tensor]:
        target = (reward + discount * target_net.params(following).amax(1)).detach()
        chosen = net.params(x).gather(1, torch.from_numpy(drawn.action)[:, None])[:, 0]
        loss = (weight * torch.nn.functional.smooth_l1_loss(chosen, target, reduction="none")).mean()
        return [flat_gradient(loss, net), loss, chosen.mean()]

    expected, loss, q_mean = sampled(usual)
    measured, _ = made.step(made.transitions(drawn))
    expected.assert_is(made.net.flat_grad.numpy())
    assert measured["loss"] == pytest.approx(loss.exact.item(), rel=1e-5)
    assert measured["q_mean"] == pytest.approx(q_mean.exact.item(), rel=1e-5)
    assert measured["grad_norm"] == pytest.approx(np.linalg.norm(expected.exact), rel=1e-5)
    assert drawn.weight.min() < 1


@pytest.mark.parametrize(
    ("settings", "bound"),
    [
        ({}, None),
        ({"max_grad_norm": 0.01}, "norm"),
        ({"max_grad_value": 0.01}, "value"),
        ({"max_grad_norm": 0.01, "max_grad_value": 0.005}, "both"),
    ],
)
def test_gradients_are_shortened_and_cut_as_asked(settings: dict[str, Any], bound: str | None) -> None:
    """Adam hides the length of the gradient; its first moment after one step does not."""
    made = dqn(changed(PLAIN, **settings))
    made.replay.add(batch(0))
    measured, _ = made.step(made.transitions(made.replay.sample(64)))
    gradient = 10 * made.state_dict()["optimizer"]["state"][0]["exp_avg"]
    assert measured["grad_norm"] > 0.1
    if bound is None:
        assert gradient.norm().item() == pytest.approx(measured["grad_norm"], rel=1e-4)
    if bound in ("norm", "both"):
        assert gradient.norm().item() == pytest.approx(0.01, rel=1e-4)
    if bound == "both":  # cut first: the largest entries are as large as one another
        assert (gradient.abs() > 0.999 * gradient.abs().max()).sum() > 10
    if bound == "value":
        assert gradient.abs().max().item() == pytest.approx(0.01, rel=1e-4)


def test_optimizers_differ_as_they_should() -> None:
    settings: dict[str, dict[str, Any]] = {"adam": {}, "amsgrad": {"amsgrad": True}, "adamw": {"optimizer": "adamw"}}
    made = {name: dqn(changed(PLAIN, **own)) for name, own in settings.items()}
    start = made["adam"].net.flat.clone()
    for each in made.values():
        each.replay.add(batch(0))
        each.set_schedules()
        each.step(each.transitions(each.replay.sample(64)))
    adam = made["adam"].net.flat
    torch.testing.assert_close(
        made["adamw"].net.flat - adam, -start * made["adam"].config.learning_rate * 0.01, atol=1e-7, rtol=0.1
    )
    assert not torch.equal(made["adamw"].net.flat, adam)
    assert {name for name, each in made.items() if "max_exp_avg_sq" in each.state_dict()["optimizer"]["state"][0]} == {
        "amsgrad"
    }


def test_a_polyak_target_follows_at_every_gradient_step() -> None:
    made = dqn(changed(PLAIN, target_every=1, tau=0.25, gradient_steps=1))
    for seed in range(3):
        before = made.target.flat.clone()
        made.update(batch(seed), no_pulse)
        torch.testing.assert_close(made.target.flat, 0.75 * before + 0.25 * made.net.flat)
    assert not torch.equal(made.target.flat, made.net.flat)


def test_a_hard_target_is_a_copy_every_so_many_gradient_steps() -> None:
    made = dqn(changed(PLAIN, target_every=4, gradient_steps=2, learning_rate=0.01))
    start = made.net.flat.clone()
    copies = []
    for seed in range(7):
        made.update(batch(seed), no_pulse)
        copies.append(torch.equal(made.target.flat, made.net.flat))
        assert torch.equal(made.target.flat, start) == (seed < 1)
    assert copies == [False, True, False, True, False, True, False]


def test_priorities_are_the_errors_and_beta_grows_to_one(monkeypatch: pytest.MonkeyPatch) -> None:
    made = dqn(changed(PLAIN, priority_alpha=0.6, gradient_steps=1, priority_beta=0.4))
    betas: list[float] = []
    seen: list[tuple[Ints, Floats]] = []
    sample, told = made.replay.sample, made.replay.update_priorities

    def watched_sample(count: int, beta: float) -> Sample:
        betas.append(beta)
        drawn = sample(count, beta)
        assert isinstance(drawn, Sample)
        return drawn

    def watched_telling(slots: Ints, error: Floats) -> None:
        seen.append((slots, error))
        told(slots, error)

    monkeypatch.setattr(made.replay, "sample", watched_sample)
    monkeypatch.setattr(made.replay, "update_priorities", watched_telling)
    made.update(batch(0), no_pulse)
    assert betas == [pytest.approx(0.4)]
    made.env_steps = 5_000
    made.update(batch(1), no_pulse)
    made.env_steps = 10**6
    made.update(batch(2), no_pulse)
    assert betas[1:] == [pytest.approx(0.7), pytest.approx(1.0)]
    assert len(seen) == 3
    assert all(error.shape == slots.shape and np.abs(error).max() > 0.1 for slots, error in seen)


# -------------------------------------------------------------------- an update


def test_what_is_published_acts_as_the_network_and_explores_by_epsilon() -> None:
    made = dqn(changed(PLAIN, normalize_observations=True, epsilon_start=0.75, epsilon_end=0.25, epsilon_steps=10**6))
    for seed in range(2):
        made.update(batch(seed), no_pulse)
    policy = NumpyPolicy(made.policy)
    policy.load(*made.weights())
    obs = batch(5).obs[0][:1]
    params = policy([obs])
    assert params[..., -1] == pytest.approx(exploration_rate(made.config, made.env_steps))
    assert made.weights()[1][:4] == pytest.approx([2] * 4, abs=1)
    assert made.weights()[1][4:8] == pytest.approx([3] * 4, abs=1)
    with torch.no_grad():
        values = made.net.head(made.inputs([obs[0]])[0]).numpy()
    np.testing.assert_allclose(params[0, :, :-1], values, atol=1e-5)
    assert (distribution(made.policy).mode(params) == values.argmax(-1)).all()  # greedy: ε plays no part


@pytest.mark.parametrize(
    ("schedule", "expected"),
    [
        ("linear", {0: 1.0, 500: 0.55, 1000: 0.1, 9000: 0.1}),
        ("exponential", {0: 1.0, 500: 0.1 + 0.9 * math.exp(-0.5), 1000: 0.1 + 0.9 / math.e, 9000: 0.1 + 0.9 * math.exp(-9)}),
    ],
)
def test_epsilon_falls_with_the_env_steps(schedule: Any, expected: dict[int, float]) -> None:
    config = changed(PLAIN, epsilon_end=0.1, epsilon_steps=1000, epsilon_schedule=schedule, gradient_steps=1)
    assert {steps: exploration_rate(config, steps) for steps in expected} == pytest.approx(expected)
    made = dqn(config)
    assert made.weights()[1].tolist() == [1.0]
    rows = batch(0)
    metrics = made.update(rows, no_pulse)
    assert metrics["rollout/exploration_rate"] == pytest.approx(exploration_rate(config, rows.env_steps))
    assert made.weights()[1] == pytest.approx(exploration_rate(config, rows.env_steps))


def test_learning_starts_after_so_many_env_steps_and_keeps_the_replay_ratio() -> None:
    made = dqn(changed(PLAIN, learning_starts=200, gradient_steps=6))
    start, pulses = made.net.flat.clone(), []
    rows = [batch(seed) for seed in range(4)]
    seen = [made.update(each, lambda: pulses.append(1)) for each in rows]
    steps = np.cumsum([each.env_steps for each in rows])
    assert steps[0] < 200 <= steps[1]
    assert [metrics["train/n_updates"] for metrics in seen] == [0, 6, 12, 18]
    assert len(pulses) == 18
    assert "train/loss" not in seen[0]
    assert [metrics["replay/size"] for metrics in seen] == steps.tolist()
    for metrics, each in zip(seen[1:], rows[1:], strict=True):
        assert metrics["replay/env_steps_per_gradient_step"] == pytest.approx(each.env_steps / 6)
    assert not torch.equal(made.net.flat, start)
    names = {"rollout/exploration_rate", "replay/bytes"}
    names |= {f"train/{name}" for name in ("loss", "q_mean", "learning_rate", "n_updates", "grad_norm")}
    assert names <= seen[-1].keys()


def test_the_learning_rate_falls_to_zero_if_asked() -> None:
    made = dqn(changed(PLAIN, learning_rate=1e-3, learning_rate_schedule="linear"))
    rates = [made.update(batch(seed), no_pulse)["train/learning_rate"] for seed in range(2)]
    assert rates == pytest.approx([1e-3, 1e-3 * (1 - batch(0).env_steps / 10_000)])


# -------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("action", "got", "take"),
    [
        (ActionSpec("box", (2,), "float32", low=(-1.0,) * 2, high=(1.0,) * 2), r"box\[2\]", "ppo, sac or xqc"),
        (ActionSpec("box", (2,), "float32", low=(-np.inf,) * 2, high=(np.inf,) * 2), r"box\[2\]", "ppo"),
        (ActionSpec("multidiscrete", (2,), "int64", (2, 3), (0, 0)), r"multidiscrete\[2\]", "ppo"),
        (ActionSpec("multibinary", (4,), "int8"), r"multibinary\[4\]", "ppo"),
    ],
)
def test_actions_that_are_not_one_choice_are_refused(action: ActionSpec, got: str, take: str) -> None:
    with pytest.raises(
        UsageError, match=rf"dqn: expected an action space Discrete\(n\), got {got}; take --algo {take} for it"
    ) as error:
        DQN.policy_spec(PLAIN, (BOX,), action)
    assert "\n" not in str(error.value)


def test_a_replay_too_big_for_this_machine_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ring, "available_bytes", lambda: 10**6)
    with pytest.raises(UsageError, match=r"replay_size 100000: .* take --replay-size \d+ or less"):
        dqn(DQNConfig())


# -------------------------------------------------------------------- learning


def corridor(made: DQN, generator: np.random.Generator, ends: str) -> Batch:
    """Four states in a row; 1 goes right, 0 left, 1 reward on leaving at the right, which ends the episode as said."""
    steps, N = 32, 4
    policy, over = NumpyPolicy(made.policy), distribution(made.policy)
    policy.load(*made.weights())
    at, obs = generator.integers(0, 4, N), np.zeros((steps + 1, N, 4), np.float32)
    action, reward = np.zeros((steps, N), np.int64), np.zeros((steps, N), np.float32)
    ended, valid = np.zeros((steps, N), bool), np.ones((steps, N), bool)
    for t in range(steps):
        obs[t] = np.eye(4)[at]
        action[t] = over.sample(policy([obs[t][None]])[0], over.noise(generator, (N,)))
        valid[t] = ~ended[t - 1] if t else True
        ended[t] = valid[t] & (at == 3) & (action[t] == 1)
        reward[t] = ended[t]
        moved = np.clip(at + 2 * (action[t] == 1) - 1, 0, 3)
        at = np.where(valid[t], moved, generator.integers(0, 4, N))
    obs[-1] = np.eye(4)[at]
    none = np.zeros_like(ended)
    return Batch(
        obs=(obs,),
        action=action,
        log_prob=np.zeros((steps, N), np.float32),
        reward=reward,
        terminated=ended if ends == "terminated" else none,
        truncated=none if ends == "terminated" else ended,
        valid=valid,
        state=np.zeros((N, 0), np.float32),
        lane=np.zeros(N, np.int64),
        fresh=np.ones(N, bool),
        columns_per_rollout=N,
        episodes=(),
    )


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param({"target_every": 20}, marks=pytest.mark.rest),
        {"target_every": 1, "tau": 0.05, "priority_alpha": 0.6, "n_step": 3, "dueling": True},
    ],
)
@pytest.mark.parametrize("ends", ["terminated", "truncated"])
def test_it_learns_a_corridor_and_what_its_end_is_worth(ends: str, settings: dict[str, Any]) -> None:
    """Leaving pays 1 once if the task ends there; if only the clock does, it pays for ever: the copy would go on."""
    config = DQNConfig(
        net=(32,),
        gamma=0.5,
        learning_rate=3e-3,
        learning_starts=0,
        gradient_steps=32,
        epsilon_steps=1000,
        epsilon_end=0.3,
        replay_size=5000,
        **settings,
    )
    made = DQN(config, DQN.policy_spec(config, (BOX,), replace_sizes(CHOICE, 2)), total_steps=10**6, seed=0)
    generator = np.random.default_rng(0)
    for _ in range(30):
        made.update(corridor(made, generator, ends), no_pulse)
    with torch.no_grad():
        values = made.net.head(torch.eye(4)).numpy()
    assert (values.argmax(1) == 1).all()
    at_the_end = 1.0 if ends == "terminated" else 2.0  # v = 1 + ½ v
    expected = at_the_end * 0.5 ** np.arange(3, -1, -1)
    atol = 0.12 if config.n_step == 1 else 0.25  # several steps hold what exploring cost
    np.testing.assert_allclose(values[:, 1], expected, atol=atol)


def replace_sizes(action: ActionSpec, choices: int) -> ActionSpec:
    return msgspec.structs.replace(action, sizes=(choices,))
