"""Cloning: its loss by hand, every kind of action, each step once in an epoch, and going on after an interrupt."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from millrace.extras.datasets import cloning
from millrace.extras.datasets.cloning import center_critic, clone, cloning_loss
from millrace.extras.datasets.demonstrations import Demonstrations
from millrace.learner.algorithms import algorithm_class
from millrace.learner.algorithms.minibatches import Minibatch
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.protocol.arrays import Array
from millrace.protocol.errors import RunError, UsageError
from millrace.protocol.policy.exploration import SquashedGaussian
from millrace.protocol.policy.torch_distributions import policy_log_prob
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec
from tests.learner.algorithms.bodies import plain_formula
from tests.support.numbers.prior_data import GivenPrior

BOX = Leaf("", "box", (3,), "float32")
IMAGE = Leaf("i", "box", (8, 8, 1), "uint8", divisor=255)
DISCRETE = ActionSpec("discrete", (), "int64", (3,), (0,))
CONTINUOUS = ActionSpec("box", (2,), "float32", low=(-1.0,) * 2, high=(1.0,) * 2)
ACTIONS = [
    DISCRETE,
    ActionSpec("multidiscrete", (2,), "int64", (2, 3), (0, 0)),
    ActionSpec("multibinary", (2,), "int8"),
    CONTINUOUS,
]


def expert(x: Array, action: ActionSpec) -> Array:
    """A simple function of observations [B, 3]: the actions [B, *action] to learn."""
    match action.kind:
        case "discrete":
            return np.asarray(x.argmax(-1))
        case "multidiscrete":
            return np.stack(((x[:, 0] > 0).astype(np.int64), x.argmax(-1)), -1)
        case "multibinary":
            return np.asarray(x[:, :2] > 0, np.int64)
        case _:
            return np.tanh(0.5 * x[:, :2]).astype(np.float32)


def episode(seed: int, T: int, action: ActionSpec, *, image: bool = False, terminated: bool = True) -> Batch:
    """An episode as `PriorDataset` gives it."""
    generator = np.random.default_rng(seed)
    x = generator.normal(1, 2, (T + 1, 3)).astype(np.float32)
    obs: list[Array] = [x[:, None]]
    if image:  # it alone shows what to do
        pictures = np.zeros((T + 1, 1, 8, 8, 1), np.uint8)
        for picture, choice in zip(pictures[:, 0], x.argmax(-1), strict=True):
            picture[3 * choice : 3 * choice + 2] = 255
        obs = [np.zeros_like(x)[:, None], pictures]
    ended = np.arange(T)[:, None] == T - 1
    return Batch(
        obs=tuple(obs),
        action=expert(x[:-1], action)[:, None],
        log_prob=np.zeros((T, 1), np.float32),
        reward=generator.normal(1, 1, (T, 1)).astype(np.float32),
        terminated=ended & terminated,
        truncated=ended & (not terminated),
        valid=np.ones((T, 1), bool),
        state=np.zeros((1, 0), np.float32),
        lane=np.array([-1]),
        fresh=np.array([True]),
        columns_per_rollout=1,
        episodes=(),
    )


def made(algo: str, action: ActionSpec, *, image: bool = False, **settings: Any) -> Any:
    config = msgspec.structs.replace(HYPERPARAMETERS[algo](), net=(32,), **settings)
    kind = algorithm_class(algo)
    spec = kind.policy_spec(config, (BOX, IMAGE) if image else (BOX,), action)
    return kind(config, spec, total_steps=1000, seed=3)


def episodes_of(action: ActionSpec, *, image: bool = False) -> list[Batch]:
    return [episode(i, 40 + i, action, image=image, terminated=bool(i % 2)) for i in range(6)]


def cloned(algorithm: Any, batches: list[Batch], pulse: Callable[[], None] = lambda: None) -> dict[str, float]:
    """As a run calls it."""
    algorithm.add_prior(GivenPrior(batches))
    return clone(algorithm, batches, pulse)


def test_the_loss_is_the_one_that_the_file_states() -> None:
    """Of two episodes, the second of which is truncated, with rewards and observations as they are."""
    ppo: PPO = made("ppo", DISCRETE, normalize_rewards=False, normalize_observations=False, gamma=0.9, vf_coef=0.3)
    batches = [episode(0, 4, DISCRETE), episode(1, 3, DISCRETE, terminated=False)]
    rows = Demonstrations.of(batches, np.asarray, 0.9)
    loss, params = cloning_loss(ppo, rows)
    x = [torch.from_numpy(one.obs[0][:, 0]) for one in batches]
    with torch.no_grad():
        log_probs = [torch.log_softmax(ppo.net.params(each[:-1]), -1) for each in x]
        values = [ppo.net.value(each).double().numpy() for each in x]
    errors = []
    for one, value in zip(batches, values, strict=True):
        rest = 0.0 if one.terminated[-1, 0] else value[-1]
        for t in reversed(range(len(one.action))):
            rest = float(one.reward[t, 0]) + 0.9 * rest
            errors.append((value[t] - rest) ** 2)
    chosen = [float(p[t, int(one.action[t, 0])]) for one, p in zip(batches, log_probs, strict=True) for t in range(len(p))]
    assert params.shape == (7, 3)
    assert loss.item() == pytest.approx(-np.mean(chosen) + 0.3 * np.mean(errors), rel=1e-5)


@pytest.mark.parametrize(
    ("algo", "action"),
    [
        *(("ppo", action) for action in ACTIONS),
        ("reinforce", DISCRETE),
        *((algo, CONTINUOUS) for algo in ("sac", "td3", "tqc", "crossq", "xqc")),
    ],
    ids=lambda value: value if isinstance(value, str) else getattr(value, "kind", ""),
)
def test_actions_of_every_kind_are_learned(algo: str, action: ActionSpec) -> None:
    algorithm = made(algo, action, clone_epochs=80)
    found = cloned(algorithm, episodes_of(action))
    assert set(found) == {"clone/loss", "clone/mean_absolute_error" if action.kind == "box" else "clone/accuracy"}
    if action.kind == "box":
        assert found["clone/mean_absolute_error"] < 0.2, "0.48 without an observation"
    else:
        assert found["clone/accuracy"] > 0.9


def test_the_density_of_a_squashed_action_is_the_one_that_workers_compute() -> None:
    generator = np.random.default_rng(0)
    params = generator.normal(0, 0.5, (50, 5)).astype(np.float32)
    params[:, -1] = 0  # no warm-up
    numpy_distribution = SquashedGaussian((2,))
    noise = numpy_distribution.noise(generator, (50,))
    action = numpy_distribution.sample(params, noise)
    inside = (abs(action) < 0.99).all(-1)
    assert inside.sum() > 20
    spec = PolicySpec((BOX,), CONTINUOUS, (4,), head="squashed")
    found = policy_log_prob(spec, torch.from_numpy(params[:, :4]), torch.from_numpy(action))
    np.testing.assert_allclose(found.numpy()[inside], numpy_distribution.log_prob(params, action, noise)[inside], atol=1e-3)


def test_images_are_looked_at() -> None:
    ppo: PPO = made("ppo", DISCRETE, image=True, clone_epochs=16)
    assert cloned(ppo, episodes_of(DISCRETE, image=True))["clone/accuracy"] > 0.9


def test_the_critic_learns_the_returns() -> None:
    """The rewards of these episodes are 1, and each is terminated: the return is the number of steps that are left."""
    ppo: PPO = made("ppo", DISCRETE, clone_epochs=300, normalize_rewards=False, gamma=1.0, normalize_observations=False)
    one = episode(0, 4, DISCRETE)
    one = msgspec.structs.replace(one, reward=np.ones_like(one.reward))
    cloned(ppo, [one])
    with torch.no_grad():
        values = ppo.net.value(torch.from_numpy(one.obs[0][:-1, 0])).tolist()
    assert values == pytest.approx([4, 3, 2, 1], abs=0.5)


@pytest.mark.parametrize("gamma", [0.9, 1.0])
def test_before_the_first_step_the_values_are_right_on_average(gamma: float) -> None:
    """Also where the value of the last observation counts. The mean return is about 40 with γ = 1, which is far from 0."""
    ppo: PPO = made("ppo", DISCRETE, normalize_rewards=False, gamma=gamma)
    batches = episodes_of(DISCRETE)
    rows = Demonstrations.of(batches, np.asarray, gamma)
    before = ppo.net.flat.clone()
    center_critic(ppo, [rows.select(np.arange(100)), rows.select(np.arange(100, len(rows.at)))])
    with torch.no_grad():
        value = ppo.net.value(*ppo.inputs(rows.obs(rows.at))).double().numpy()
        last_value = ppo.net.value(*ppo.inputs(rows.obs(rows.last))).double().numpy()
    target = rows.returns + rows.discount * last_value
    assert target.mean() > 8
    assert value.mean() == pytest.approx(target.mean(), rel=1e-5)
    assert torch.count_nonzero(ppo.net.flat != before) == 1, "a bias alone"


def test_values_without_a_right_level_stay() -> None:
    """With γ = 1, the value of an episode that never ends depends on itself alone."""
    ppo: PPO = made("ppo", DISCRETE, normalize_rewards=False, gamma=1.0)
    before = ppo.net.flat.clone()
    center_critic(ppo, [Demonstrations.of([episode(0, 9, DISCRETE, terminated=False)], np.asarray, 1.0)])
    assert torch.equal(ppo.net.flat, before)


def test_large_returns_saturate_no_unit_of_the_critic() -> None:
    """Rewards of 100 for ever, and γ = 0.9: each value is 1,000. The weights learn it in three epochs, and hardly move."""
    ppo: PPO = made("ppo", DISCRETE, clone_epochs=3, normalize_rewards=False, gamma=0.9)
    batches = [episode(i, 60, DISCRETE, terminated=False) for i in range(4)]
    batches = [msgspec.structs.replace(one, reward=np.full_like(one.reward, 100)) for one in batches]
    before = ppo.net.parameters["critic.0.weight"].detach().clone()
    cloned(ppo, batches)
    with torch.no_grad():
        values = ppo.net.value(*ppo.inputs([batches[0].obs[0][:-1, 0]])).numpy()
    assert values == pytest.approx(np.full(60, 1_000), rel=0.01)
    assert (ppo.net.parameters["critic.0.weight"] - before).abs().max() < 0.05


@pytest.mark.parametrize("clone_epochs", [0, 1])
def test_the_advantages_of_a_cloned_policy_are_not_standardized(clone_epochs: int) -> None:
    """Also after the algorithm was saved and loaded."""
    ppo, loaded = (made("ppo", DISCRETE, clone_epochs=clone_epochs) for _ in range(2))
    assert ppo.config.normalize_advantage
    if clone_epochs:
        cloned(ppo, episodes_of(DISCRETE))
    loaded.load_state_dict(ppo.state_dict())
    raw = torch.tensor([0.001, 0.002, 0.003])
    rows = Minibatch(
        torch.zeros(3, 3), (), torch.zeros(3, dtype=torch.int64), torch.zeros(3), raw, torch.zeros(3), None, None
    )
    for each in (ppo, loaded):
        found = each.evaluate(rows).advantage
        assert found.tolist() == pytest.approx(raw.tolist() if clone_epochs else [-1, 0, 1], rel=1e-3)


def test_each_epoch_uses_each_step_once_and_in_an_order_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    ppo: PPO = made("ppo", DISCRETE, clone_epochs=2, batch_size=1_000)
    seen: list[Array] = []

    def noted(algorithm: PPO, rows: Demonstrations) -> Any:
        seen.append(rows.at)
        return cloning_loss(algorithm, rows)

    monkeypatch.setattr(cloning, "cloning_loss", noted)
    cloned(ppo, episodes_of(DISCRETE))
    assert {len(rows) for rows in seen} == {63, 64}, "not the minibatches of updates"
    first, second = np.concatenate(seen[:4]), np.concatenate(seen[4:8])
    assert sorted(first) == sorted(second) == Demonstrations.of(episodes_of(DISCRETE), np.asarray, 0.9).at.tolist()
    assert (first != second).any()


def test_the_statistics_of_observations_are_those_of_the_demonstrations() -> None:
    ppo: PPO = made("ppo", DISCRETE, clone_epochs=1)
    cloned(ppo, episodes_of(DISCRETE))
    x = np.concatenate([one.obs[0][:-1, 0] for one in episodes_of(DISCRETE)])
    np.testing.assert_allclose(ppo.weights()[1], np.concatenate((x.mean(0), x.std(0))), rtol=1e-5)


@pytest.mark.parametrize(
    ("algo", "action"), [("ppo", DISCRETE), *((algo, CONTINUOUS) for algo in ("a2c", "sac", "tqc", "xqc"))]
)
def test_cloning_that_was_interrupted_goes_on_with_the_same_bits(algo: str, action: ActionSpec) -> None:
    whole, stopped, resumed = (made(algo, action, clone_epochs=3) for _ in range(3))
    episodes = episodes_of(action)

    def pulse() -> None:
        if stopped.pretraining_steps == 2:
            raise KeyboardInterrupt

    cloned(whole, episodes)
    with pytest.raises(KeyboardInterrupt):
        cloned(stopped, episodes, pulse)
    resumed.add_prior(GivenPrior(episodes))
    resumed.load_state_dict(stopped.state_dict())
    clone(resumed, episodes, lambda: None)
    assert whole.pretraining_steps == resumed.pretraining_steps > 2
    assert torch.equal(whole.net.flat, resumed.net.flat)
    untrained = made(algo, action, clone_epochs=3)
    assert not torch.equal(whole.net.flat, untrained.net.flat)


@pytest.mark.parametrize("algo", ["sac", "td3"])
@pytest.mark.parametrize("taken", [10, 20])
def test_prior_steps_that_were_interrupted_go_on_with_the_same_bits(algo: str, taken: int) -> None:
    """The target of TD3's actor lags behind the actor, so it must not become a copy of the actor again."""
    settings: dict[str, Any] = {"clone_epochs": 1, "prior_steps": 20, "prior_share": 0.5, "replay_size": 1000}
    whole, resumed = (made(algo, CONTINUOUS, **settings) for _ in range(2))
    episodes = episodes_of(CONTINUOUS)
    saved: dict[str, Any] = {}

    def pulse() -> None:
        if whole.prior_gradient_steps == taken:
            saved.update(deepcopy(whole.state_dict()))

    assert cloned(whole, episodes)
    whole.learn_from_prior(pulse)
    resumed.add_prior(GivenPrior(episodes))
    resumed.load_state_dict(saved)
    assert clone(resumed, episodes, lambda: None) == {}
    resumed.learn_from_prior(lambda: None)
    for name in ("parameters", "target"):
        assert torch.equal(whole.state_dict()[name], resumed.state_dict()[name])


def test_weights_of_units_of_xqc_have_norm_1_after_each_step() -> None:
    """Else the policy would be another one when its weights are scaled at the end."""
    algorithm = made("xqc", CONTINUOUS, clone_epochs=1)

    def pulse() -> None:
        (layers,) = plain_formula.layers(algorithm.net.actor_body.shape, algorithm.net.actor)
        for layer in layers:
            norms = torch.linalg.vector_norm(layer.weight, dim=1)
            torch.testing.assert_close(norms, torch.ones_like(norms))

    cloned(algorithm, episodes_of(CONTINUOUS), pulse)
    assert algorithm.pretraining_steps == 4


def test_a_step_with_a_loss_that_is_not_finite_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    ppo: PPO = made("ppo", DISCRETE, clone_epochs=1, normalize_rewards=False)
    before: list[torch.Tensor] = []

    def endless(algorithm: PPO, rows: Demonstrations) -> Any:
        before.append(algorithm.net.flat.clone())
        found, params = cloning_loss(algorithm, rows)
        return found * float("inf"), params

    monkeypatch.setattr(cloning, "cloning_loss", endless)
    with pytest.raises(RunError, match="clone/loss: expected finite"):
        cloned(ppo, episodes_of(DISCRETE))
    assert len(before) == 1
    assert torch.equal(ppo.net.flat, before[0])


def test_an_algorithm_without_a_policy_to_clone_is_named() -> None:
    with pytest.raises(UsageError, match=r"^clone_epochs: expected an ActorCritic or a Continuous to clone, got DQN$"):
        clone(made("dqn", DISCRETE), episodes_of(DISCRETE), lambda: None)
