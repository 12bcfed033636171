"""TQC, CrossQ and XQC: losses in numpy, gradients by autograd of plain formulas, and what each step moves."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from msgspec.structs import replace
from torch import Tensor

from millrace.learner.algorithms.bodies.stacked_mlps import StackedMLPs, initial
from millrace.learner.algorithms.bounded_returns import BoundedReturns
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.protocol.arrays import Doubles
from millrace.protocol.errors import UsageError
from millrace.protocol.random_streams import Purpose, torch_seed
from tests.learner.algorithms.bodies import plain_formula as plain
from tests.learner.algorithms.test_continuous import batch, made, sample_of

B = 6
SETTINGS: dict[str, dict[str, Any]] = {
    "tqc": {"net": (8, 7), "critics": 3, "quantiles": 4, "dropped_quantiles": 1},
    "crossq": {"net": (8, 7), "critic_net": (9, 6), "policy_delay": 1},
    "xqc": {"net": (8, 7), "critic_net": (9, 6), "policy_delay": 1, "atoms": 7},
}
ALL = pytest.mark.parametrize("algo", list(SETTINGS))
NORMALIZED = pytest.mark.parametrize("algo", ["crossq", "xqc"])
ROUNDING: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-11}

pytestmark = pytest.mark.usefixtures("_float64")


class Case(NamedTuple):
    """An algorithm whose numbers are neither 0 nor 1, rows with weights, and noise for one action a row, twice."""

    algorithm: Any
    rows: Transitions
    noise: Tensor
    """[2, B, D′]: of the first actions that are sampled, and of the second"""

    @property
    def alpha(self) -> float:
        return float(self.algorithm.temperature)

    def action(self, x: Tensor, noise: Tensor, normalize: Any = plain.evaluated, actor: Tensor | None = None) -> Any:
        """Actions [B, D′] = tanh(u), and log π [B]: the normal density of u, less Σ log(1 − tanh² u) = −2 Σ log cosh u."""
        net = self.algorithm.net
        shape = net.actor_body.shape
        statistics = net.statistics[: sum(2 * size for size in shape.sizes[:-1])].clone()
        (params,) = plain.outputs(shape, net.actor if actor is None else actor, x, normalize, statistics)
        mean, log_std = params[:, :2], params[:, 2:].clamp(-20, 2)
        u = mean + log_std.exp() * noise
        density = -0.5 * noise**2 - log_std - 0.5 * np.log(2 * np.pi)
        return u.tanh(), (density + 2 * u.cosh().log()).sum(-1)

    def critics(self, x: Tensor, action: Tensor, normalize: Any, critics: Tensor | None = None) -> Tensor:
        """Outputs [K, B, O] of the critics."""
        net = self.algorithm.net
        actors = sum(2 * size for size in net.actor_body.shape.sizes[:-1])
        flat, joint = net.critics if critics is None else critics, torch.cat((x, action), -1)
        return plain.outputs(net.critic_bodies.shape, flat, joint, normalize, net.statistics[actors:].clone())


def case(algo: str, **settings: Any) -> Case:
    algorithm = made(algo, **SETTINGS[algo] | settings)
    generator = torch.Generator().manual_seed(1)
    for net in (algorithm.net, *([algorithm.target] if algo != "crossq" else [])):
        net.flat.add_(torch.randn(len(net.flat), generator=generator), alpha=0.2)
        net.statistics.add_(torch.rand(len(net.statistics), generator=generator), alpha=0.5)
    algorithm.log_temperature.fill_(-1.2)
    numbers = np.random.default_rng(3)
    rows = algorithm.transitions(sample_of(numbers, B)._replace(weight=numbers.uniform(0.2, 1, B).astype(np.float32)))
    assert len(set(rows.discount.tolist())) == 2, "some rows end an episode, and some do not"
    noise = torch.randn(2, B, 2, generator=generator)
    given = list(noise)
    algorithm.noise = lambda size: given.pop(0)
    return Case(algorithm, rows, noise)


def array(tensor: Tensor) -> Doubles:
    found: Doubles = tensor.detach().numpy()
    return found


def gradient(loss: Tensor, flat: Tensor) -> Tensor:
    """What a loss of ours writes into the gradient of a flat tensor."""
    assert flat.grad is not None
    flat.grad.zero_()
    loss.backward()  # type: ignore[no-untyped-call]
    return flat.grad.clone()


def by_autograd(loss: Any, flat: Tensor) -> Tensor:
    """The gradient of `loss(flat)`."""
    leaf = flat.clone().requires_grad_()
    (found,) = torch.autograd.grad(loss(leaf), leaf)
    return found


# -------------------------------------------------------------------- TQC


def targets_of_tqc(given: Case) -> Doubles:
    """[B, J] y = r + γ (z − α log π), of the K (M − d) lowest of all quantiles of the target critics."""
    rows = given.rows
    action, log_prob = given.action(rows.next_x, given.noise[0])
    quantiles = array(given.critics(rows.next_x, action, plain.of_minibatch, given.algorithm.target.critics))
    lowest = np.sort(quantiles.transpose(1, 0, 2).reshape(B, 12), -1)[:, :9]
    value = lowest - given.alpha * array(log_prob)[:, None]
    return np.asarray(array(rows.reward)[:, None] + array(rows.discount)[:, None] * value)


def test_targets_of_tqc_are_those_of_the_formula() -> None:
    given = case("tqc")
    np.testing.assert_allclose(array(given.algorithm.targets(given.rows)), targets_of_tqc(given), **ROUNDING)


def tqc_loss(given: Case, critics: Tensor) -> Tensor:
    """Mean over rows, critics, quantiles i and targets j of w |τᵢ − [u < 0]| · Huber(u), as autograd differentiates it."""
    quantiles = given.critics(given.rows.x, given.rows.action, plain.of_minibatch, critics)
    u = torch.from_numpy(targets_of_tqc(given))[None, :, None, :] - quantiles[..., None]
    tau = torch.tensor([0.125, 0.375, 0.625, 0.875])[:, None]
    huber = torch.where(u.abs() <= 1, 0.5 * u**2, u.abs() - 0.5)
    return (given.rows.weight[:, None, None] * (tau - (u < 0).double()).abs() * huber).mean()


def test_the_critic_loss_of_tqc_and_its_gradient_are_those_of_the_formula() -> None:
    given = case("tqc")
    expected = tqc_loss(given, given.algorithm.net.critics)
    by_critics = by_autograd(lambda critics: tqc_loss(given, critics), given.algorithm.net.critics)
    found = given.algorithm.critic_loss(given.rows).loss
    torch.testing.assert_close(found.detach(), expected, **ROUNDING)
    torch.testing.assert_close(gradient(found, given.algorithm.net.critics), by_critics, **ROUNDING)


def test_targets_of_tqc_keep_at_least_one_quantile() -> None:
    with pytest.raises(UsageError, match="dropped_quantiles: expected fewer than quantiles, 4, got 4"):
        made("tqc", quantiles=4, dropped_quantiles=4)


# -------------------------------------------------------------------- CrossQ


def values_and_targets_of_crossq(given: Case, critics: Tensor, normalize: Any = plain.of_minibatch) -> tuple[Tensor, Tensor]:
    """Q(s, a) [2, B] and y [B]: one pass of [s; s′], whose second half gives the constant y."""
    rows = given.rows
    action, log_prob = given.action(rows.next_x, given.noise[0])
    x, actions = torch.cat((rows.x, rows.next_x)), torch.cat((rows.action, action))
    q = given.critics(x, actions, normalize, critics)[..., 0]
    value = np.minimum(*array(q[:, B:])) - given.alpha * array(log_prob)
    return q[:, :B], torch.from_numpy(array(rows.reward) + array(rows.discount) * value)


def crossq_loss(given: Case, critics: Tensor, normalize: Any = plain.of_minibatch) -> Tensor:
    """½ Σ E[w (Q(s, a) − y)²] over both critics."""
    weight, (q, y) = given.rows.weight, values_and_targets_of_crossq(given, critics, normalize)
    return 0.5 * (weight * (q[0] - y) ** 2).mean() + 0.5 * (weight * (q[1] - y) ** 2).mean()


@pytest.mark.parametrize("renormalizes", [False, True])
def test_the_critic_loss_of_crossq_is_that_of_the_formula(renormalizes: bool) -> None:
    given = case("crossq", renormalize_after=0 if renormalizes else 100)
    expected = crossq_loss(given, given.algorithm.net.critics, plain.renormalized if renormalizes else plain.of_minibatch)
    torch.testing.assert_close(given.algorithm.critic_loss(given.rows).loss.detach(), expected, **ROUNDING)


@pytest.mark.parametrize("renormalizes", [False, True])
def test_the_target_of_crossq_is_constant_but_the_statistics_to_which_it_contributes_are_not(renormalizes: bool) -> None:
    """The gradient is that of the formula, whose pass of [s; s′] is one graph."""
    given = case("crossq", renormalize_after=0 if renormalizes else 100)
    normalize = plain.renormalized if renormalizes else plain.of_minibatch
    expected = by_autograd(lambda critics: crossq_loss(given, critics, normalize), given.algorithm.net.critics)
    found = gradient(given.algorithm.critic_loss(given.rows).loss, given.algorithm.net.critics)
    torch.testing.assert_close(found, expected, **ROUNDING)


def test_crossq_has_no_targets() -> None:
    algorithm = made("crossq", **SETTINGS["crossq"])
    assert algorithm.target is algorithm.net
    assert set(algorithm.tensors) == {"parameters", "statistics", "log_temperature"}
    assert "target" not in algorithm.state_dict()


@pytest.mark.parametrize("after", [0, 2])
def test_crossq_renormalizes_after_so_many_gradient_steps(after: int, monkeypatch: pytest.MonkeyPatch) -> None:
    algorithm = case("crossq", renormalize_after=after, policy_delay=2).algorithm
    noise, numbers, seen = torch.zeros(B, 2), np.random.default_rng(0), list[bool]()
    algorithm.noise = lambda size: noise
    trained = StackedMLPs.trained

    def noted(self: StackedMLPs, x: Tensor, *, renormalizes: bool) -> Tensor:
        seen.append(renormalizes)
        return trained(self, x, renormalizes=renormalizes)

    monkeypatch.setattr(StackedMLPs, "trained", noted)
    for _ in range(4):
        algorithm.step(algorithm.transitions(sample_of(numbers, B)))
    critic, actor = [step >= after for step in range(4)], [step >= after for step in (1, 3)]
    assert seen == [critic[0], critic[1], actor[0], critic[2], critic[3], actor[1]]


# -------------------------------------------------------------------- XQC


def atoms_of(given: Case) -> Doubles:
    return np.linspace(-5, 5, given.algorithm.config.atoms)


def softmax(logits: Doubles) -> Doubles:
    found: Doubles = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
    return found


def next_of_xqc(given: Case) -> tuple[Tensor, Tensor, Doubles, Doubles]:
    """The joint rows; log π of the next actions; and of both target critics the probabilities [2, B, O] of next returns."""
    rows = given.rows
    action, log_prob = given.action(rows.next_x, given.noise[0])
    x, actions = torch.cat((rows.x, rows.next_x)), torch.cat((rows.action, action))
    logits = given.critics(x, actions, plain.of_minibatch, given.algorithm.target.critics)
    return x, actions, array(log_prob), softmax(array(logits[:, B:]))


def target_of_xqc(given: Case) -> Doubles:
    """[B, O]: of the critic that expects less, each atom's return divided between the two atoms beside it, in a loop."""
    rows, atoms = given.rows, atoms_of(given)
    _, _, log_prob, both = next_of_xqc(given)
    step, found = atoms[1] - atoms[0], np.zeros((B, len(atoms)))
    for b in range(B):
        probabilities = min(both[:, b], key=lambda row: float(row @ atoms))
        for atom, probability in zip(atoms, probabilities, strict=True):
            value = float(rows.reward[b]) + float(rows.discount[b]) * (atom - given.alpha * log_prob[b])
            at = (np.clip(value, -5, 5) + 5) / step
            for i in range(len(atoms)):
                found[b, i] += probability * max(0.0, 1 - abs(at - i))
    return found


def xqc_loss(given: Case, critics: Tensor) -> Tensor:
    """Σ E[w · −Σ target log p] over both critics, of a joint pass of [s; s′]."""
    x, actions, _, _ = next_of_xqc(given)
    logits = given.critics(x, actions, plain.of_minibatch, critics)[:, :B]
    log_p = logits - logits.exp().sum(-1, keepdim=True).log()
    return -(given.rows.weight * (torch.from_numpy(target_of_xqc(given)) * log_p).sum(-1)).mean(1).sum()


def test_the_critic_loss_of_xqc_and_its_gradient_are_those_of_the_formula() -> None:
    given = case("xqc")
    _, _, _, both = next_of_xqc(given)
    assert set((both @ atoms_of(given)).argmin(0)) == {0, 1}, "each of the two critics expects less of some rows"
    expected = xqc_loss(given, given.algorithm.net.critics)
    by_critics = by_autograd(lambda critics: xqc_loss(given, critics), given.algorithm.net.critics)
    found = given.algorithm.critic_loss(given.rows).loss
    torch.testing.assert_close(found.detach(), expected, **ROUNDING)
    torch.testing.assert_close(gradient(found, given.algorithm.net.critics), by_critics, **ROUNDING)


def test_xqc_learns_from_rewards_whose_values_are_within_the_bound_of_the_categories() -> None:
    algorithm, plainly, expected = (
        made("xqc", return_bound=0.5, n_step=3),  # the scale is that of returns of single steps, whose discount is 0.99
        made("xqc", normalize_rewards=False),
        BoundedReturns(0.99, 0.5),
    )
    rows = batch(0)
    for each in (algorithm, plainly, expected):
        each.count(rows)
    assert np.array_equal(algorithm.scaled(rows.reward), expected.scaled(rows.reward))
    assert np.array_equal(plainly.scaled(rows.reward), rows.reward)


@pytest.mark.parametrize(
    ("goal_ends", "discount", "lasts"),
    [(None, 0.99, 100.0), (None, 0.99**3, 1 / (1 - 0.99**3)), (None, 0, 1.0), (0.05, 0.99, 1.0)],
)
def test_with_hindsight_the_reward_of_a_goal_may_last_unless_a_goal_ends_the_episode(
    goal_ends: float | None, discount: float, lasts: float
) -> None:
    algorithm = made("xqc", gamma=0.99, return_bound=5)
    algorithm.config = replace(algorithm.config, hindsight=0.8, goal_ends=goal_ends, n_step=3)
    sample = sample_of(np.random.default_rng(0), 2)._replace(
        reward=np.array([0, 1], np.float32), discount=np.array([0.99**3, discount], np.float32)
    )
    expected = 1 / max(1, lasts / algorithm.config.return_bound)
    assert algorithm.transitions(sample).reward[1].item() == pytest.approx(expected)


def test_the_temperature_of_xqc_begins_in_units_of_scaled_rewards() -> None:
    assert made("xqc").temperature == pytest.approx(0.01)
    assert made("xqc").target_entropy == -1
    assert made("xqc", ent_coef=0.5).temperature == pytest.approx(0.5)
    assert made("xqc", target_entropy=-3.0).target_entropy == -3


def test_weights_of_units_of_xqc_have_norm_1_after_each_step() -> None:
    algorithm = made("xqc", **SETTINGS["xqc"])
    numbers = np.random.default_rng(0)
    for _ in range(3):
        for shape, flat in (
            (algorithm.net.actor_body.shape, algorithm.net.actor),
            (algorithm.net.critic_bodies.shape, algorithm.net.critics),
        ):
            for layer in plain.every_layer(shape, flat):
                torch.testing.assert_close(layer.weight.square().sum(1), torch.ones(len(layer.weight)), **ROUNDING)
        algorithm.step(algorithm.transitions(sample_of(numbers, B)))


# -------------------------------------------------------------------- errors, which become priorities


def values_and_targets(given: Case) -> tuple[Doubles, Doubles]:
    """The expected values of all critics, [K, B], and those of their targets, [B]."""
    critics, rows = given.algorithm.net.critics, given.rows
    match type(given.algorithm).__name__:
        case "TQC":
            quantiles = given.critics(rows.x, rows.action, plain.of_minibatch, critics)
            return array(quantiles.mean(-1)), targets_of_tqc(given).mean(-1)
        case "CrossQ":
            values, y = values_and_targets_of_crossq(given, critics)
            return array(values), array(y)
        case _:
            x, actions, _, _ = next_of_xqc(given)
            logits = given.critics(x, actions, plain.of_minibatch, critics)[:, :B]
            return softmax(array(logits)) @ atoms_of(given), target_of_xqc(given) @ atoms_of(given)


@ALL
def test_errors_of_critics_that_are_wrong_in_opposite_directions_do_not_cancel(algo: str) -> None:
    given = case(algo)
    values, targets = values_and_targets(given)
    errors = values - targets
    assert ((errors < 0).any(0) & (errors > 0).any(0)).any()
    found = given.algorithm.critic_loss(given.rows).error
    np.testing.assert_allclose(array(found), abs(errors).mean(0), **ROUNDING)


# -------------------------------------------------------------------- the actor


@pytest.mark.parametrize("algo", ["tqc", "crossq"])
def test_means_and_deviations_of_actions_begin_almost_alike_for_all_observations(algo: str) -> None:
    """The weights of each output of the actor have norm 0.01."""
    algorithm = made(algo, **SETTINGS[algo])
    (layers,) = plain.layers(algorithm.net.actor_body.shape, algorithm.net.actor)
    torch.testing.assert_close(layers[-1].weight.square().sum(1).sqrt(), torch.full((4,), 0.01), **ROUNDING)


def test_initial_weights_come_from_the_random_stream_of_weights() -> None:
    """The actor's are the first."""
    algorithm = made("tqc", seed=3, **SETTINGS["tqc"])
    generator = torch.Generator().manual_seed(torch_seed(3, Purpose.WEIGHTS))
    assert torch.equal(algorithm.net.actor, initial(algorithm.net.actor_body.shape, generator))


def actor_loss(given: Case, actor: Tensor) -> Tensor:
    """E[α log π − Q]: the actor normalizes by its minibatch, and critics by running statistics."""
    algorithm, x = given.algorithm, given.rows.x
    action, log_prob = given.action(x, given.noise[0], plain.of_minibatch, actor)
    outputs = given.critics(x, action, plain.evaluated)
    match type(algorithm).__name__:
        case "TQC":
            value = outputs.transpose(0, 1).flatten(1).sum(-1) / 12
        case "CrossQ":
            value = torch.minimum(*outputs[..., 0])
        case _:
            value = torch.minimum(*(outputs.softmax(-1) @ torch.from_numpy(atoms_of(given))))
    loss: Tensor = (given.alpha * log_prob - value).mean()
    return loss


@ALL
def test_the_actor_loss_and_its_gradient_are_those_of_the_formula(algo: str) -> None:
    given = case(algo)
    expected = actor_loss(given, given.algorithm.net.actor)
    by_actor = by_autograd(lambda actor: actor_loss(given, actor), given.algorithm.net.actor)
    found, _ = given.algorithm.actor_loss(given.rows.x)
    torch.testing.assert_close(found.detach(), expected, **ROUNDING)
    torch.testing.assert_close(gradient(found, given.algorithm.net.actor), by_actor, **ROUNDING)


@ALL
def test_the_actor_s_loss_gives_the_critics_no_gradient(algo: str) -> None:
    given = case(algo)
    given.algorithm.net.critics.grad.zero_()
    given.algorithm.actor_loss(given.rows.x)[0].backward()
    assert not given.algorithm.net.critics.grad.any()


@NORMALIZED
def test_actor_and_temperature_learn_at_every_kth_step(algo: str) -> None:
    algorithm, numbers = made(algo, **SETTINGS[algo] | {"policy_delay": 3}), np.random.default_rng(0)
    moved = []
    for _ in range(6):
        before = [algorithm.net.critics.clone(), algorithm.net.actor.clone(), algorithm.log_temperature.clone()]
        algorithm.step(algorithm.transitions(sample_of(numbers, B)))
        after = [algorithm.net.critics, algorithm.net.actor, algorithm.log_temperature]
        moved.append([not torch.equal(*both) for both in zip(before, after, strict=True)])
    assert moved == [[True, step in (3, 6), step in (3, 6)] for step in range(1, 7)]


@pytest.mark.parametrize("algo", ["tqc", "xqc"])
def test_targets_move_by_tau_after_each_step_of_the_critics(algo: str) -> None:
    given = case(algo, tau=0.25)
    before = given.algorithm.target.critics.clone()
    given.algorithm.step(given.rows)
    expected = 0.75 * before + 0.25 * given.algorithm.net.critics
    torch.testing.assert_close(given.algorithm.target.critics, expected, **ROUNDING)


# -------------------------------------------------------------------- which passes move which running statistics


class Moved(NamedTuple):
    """Whether running statistics are others than before."""

    actor: bool
    critics: bool


def moved_by(given: Case, call: Any) -> Moved:
    net = given.algorithm.net
    size = sum(2 * size for size in net.actor_body.shape.sizes[:-1])
    before = net.statistics.clone()
    call()
    return Moved(
        not torch.equal(net.statistics[:size], before[:size]), not torch.equal(net.statistics[size:], before[size:])
    )


@NORMALIZED
def test_the_critics_loss_moves_the_statistics_of_the_critics_alone(algo: str) -> None:
    given = case(algo)
    assert moved_by(given, lambda: given.algorithm.critic_loss(given.rows)) == Moved(actor=False, critics=True)


@NORMALIZED
def test_the_actor_s_loss_moves_the_statistics_of_the_actor_alone(algo: str) -> None:
    given = case(algo)
    assert moved_by(given, lambda: given.algorithm.actor_loss(given.rows.x)) == Moved(actor=True, critics=False)


@NORMALIZED
def test_publishing_weights_moves_no_statistics(algo: str) -> None:
    given = case(algo)
    assert moved_by(given, given.algorithm.weights) == Moved(actor=False, critics=False)


def test_statistics_of_the_targets_of_xqc_stay_as_they_began() -> None:
    given = case("xqc")
    before = given.algorithm.target.statistics.clone()
    given.algorithm.step(given.rows)
    assert torch.equal(given.algorithm.target.statistics, before)
