"""The loss that one reads is the loss that trains, and the papers': whoever edits its value gets another run."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from torch import Tensor

from millrace.learner.algorithm_check.same_bits import first_difference
from millrace.learner.algorithms import algorithm_class, dqn, losses
from millrace.learner.algorithms.replay.off_policy import CriticLoss
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from tests.support.numbers.batches import DISCRETE, GAUSSIAN, batch, no_pulse

SETTINGS: dict[str, dict[str, Any]] = {
    # Adam's first moment shows a factor of the gradient that its step hides; a longest norm would hide it there, too.
    "ppo": {"n_epochs": 2, "ent_coef": 0.1, "max_grad_norm": 1e9, "learning_rate": 3e-3, "clip_range": 0.05},
    "a2c": {"optimizer": "adam", "max_grad_norm": 1e9},
    "impala": {"ent_coef": 0.1},
    "reinforce": {},
    "dqn": {"gradient_steps": 3},
    "rainbow": {"gradient_steps": 3},
    "sac": {"updates_per_step": 0.1},
    "td3": {"updates_per_step": 0.1},
    "tqc": {"updates_per_step": 0.1},
    "crossq": {"updates_per_step": 0.1, "critic_net": (16,)},
}
CONTINUOUS = ("sac", "td3", "tqc", "crossq")
OFF_POLICY = {"net": (16,), "learning_starts": 0, "batch_size": 32, "replay_size": 1000}


def made(name: str, **settings: Any) -> Any:
    off_policy = OFF_POLICY if name in ("dqn", "rainbow", *CONTINUOUS) else {}
    config = msgspec.convert({**off_policy, **SETTINGS[name], **settings}, HYPERPARAMETERS[name])
    spec, kind = GAUSSIAN if name in CONTINUOUS else DISCRETE, algorithm_class(name)
    return kind(config, kind.policy_spec(config, spec.observation, spec.action), total_steps=10_000, seed=0)


def learned(name: str, **settings: Any) -> tuple[Any, list[dict[str, float]]]:
    """An algorithm after two updates, and their metrics. The batches are the same, whatever it learned."""
    algorithm, acting = made(name, **settings), made("td3" if name in CONTINUOUS else name)
    return algorithm, [algorithm.update(batch(acting, seed, seed == 0), no_pulse) for seed in range(2)]


# -------------------------------------------------------------------- the losses of algorithms


def times_zero(found: Any) -> Any:
    """What a loss returned, with 0 times its value."""
    match found:
        case Tensor():
            return 0 * found
        case CriticLoss():
            return found._replace(loss=0 * found.loss)
    loss, other = found
    return 0 * loss, other


@pytest.mark.parametrize(
    ("name", "loss", "part"),
    [
        *((name, "loss", "net.flat") for name in ("ppo", "a2c", "impala", "reinforce", "dqn", "rainbow")),
        ("sac", "critic_loss", "net.critics"),
        ("sac", "actor_loss", "net.actor"),
        ("sac", "temperature_loss", "log_temperature"),
        ("td3", "critic_loss", "net.critics"),
        ("td3", "actor_loss", "net.actor"),
        ("tqc", "critic_loss", "net.critics"),
        ("tqc", "actor_loss", "net.actor"),
        ("crossq", "critic_loss", "net.critics"),
        ("crossq", "actor_loss", "net.actor"),
    ],
)
def test_zero_times_a_loss_leaves_its_weights_where_they_are_and_no_others(
    name: str, loss: str, part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def parts(algorithm: Any) -> dict[str, Tensor]:
        if name not in CONTINUOUS:
            return {"net.flat": algorithm.net.flat}
        temperature = {"log_temperature": algorithm.log_temperature} if name != "td3" else {}
        return {"net.actor": algorithm.net.actor, "net.critics": algorithm.net.critics, **temperature}

    kind = algorithm_class(name)
    writes = next(each for each in kind.__mro__ if loss in vars(each))
    written = vars(writes)[loss]
    monkeypatch.setattr(writes, loss, lambda *arguments: times_zero(written(*arguments)))
    before, (after, _) = made(name), learned(name)
    stays = {name: torch.equal(own, parts(after)[name]) for name, own in parts(before).items()}
    assert stays == {each: each == part for each in stays}


# -------------------------------------------------------------------- the functions of losses.py

USED_BY: dict[str, tuple[str, dict[str, Any]]] = {
    "standardized": ("ppo", {}),
    "clipped_surrogate": ("ppo", {}),
    "policy_gradient": ("a2c", {}),
    "value_loss": ("ppo", {}),
    "clipped_value_loss": ("ppo", {"clip_range_vf": 0.2}),
    "entropy_loss": ("ppo", {"ent_coef": 10.0}),
    "huber_loss": ("dqn", {"loss": "huber"}),
    "squared_loss": ("dqn", {"loss": "squared"}),
}
LOGGED_BY: dict[str, tuple[str, str]] = {  # the algorithm, and the metric
    "approx_kl": ("ppo", "approx_kl"),
    "clip_fraction": ("ppo", "clip_fraction"),
    "explained_variance": ("a2c", "explained_variance"),
}


def edit(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put `return 2 * …` for each `return …` of a function of losses.py, as in its text."""
    tree = ast.parse(Path(losses.__file__).read_text())
    (function,) = (each for each in tree.body if isinstance(each, ast.FunctionDef) and each.name == name)
    for node in ast.walk(function):
        if isinstance(node, ast.Return) and node.value is not None:
            node.value = ast.BinOp(ast.Constant(2), ast.Mult(), node.value)
    edited: dict[str, Any] = {"__name__": losses.__name__}
    exec(compile(ast.fix_missing_locations(tree), losses.__file__, "exec"), edited)
    for kind, loss in dqn.LOSSES.items():
        if loss is getattr(losses, name):
            monkeypatch.setitem(dqn.LOSSES, kind, edited[name])
    monkeypatch.setattr(losses, name, edited[name])


def test_every_function_is_used_by_an_algorithm() -> None:
    public = {name for name, each in inspect.getmembers(losses, inspect.isfunction) if each.__module__ == losses.__name__}
    assert {name for name in public if not name.startswith("_")} == {*USED_BY, *LOGGED_BY}


@pytest.mark.parametrize("function", USED_BY)
def test_a_formula_that_is_edited_gives_other_gradients(function: str, monkeypatch: pytest.MonkeyPatch) -> None:
    name, settings = USED_BY[function]
    assert first_difference(*(learned(name, **settings)[0].state_dict() for _ in range(2))) is None
    before = moment(name, settings)
    edit(function, monkeypatch)
    assert (moment(name, settings) - before).norm() > 0.01 * before.norm()


def moment(name: str, settings: dict[str, Any]) -> Tensor:
    """Adam's mean of the gradients of all steps of a run."""
    found: Tensor = learned(name, **settings)[0].state_dict()["optimizer"]["state"][0]["exp_avg"]
    return found


@pytest.mark.parametrize("function", LOGGED_BY)
def test_a_number_that_is_edited_is_another_one_in_the_metrics(function: str, monkeypatch: pytest.MonkeyPatch) -> None:
    name, metric = LOGGED_BY[function]
    before = [metrics[f"train/{metric}"] for metrics in learned(name)[1]]
    edit(function, monkeypatch)
    after = [metrics[f"train/{metric}"] for metrics in learned(name)[1]]
    assert before != [0, 0]
    assert after == [2 * number for number in before]


# -------------------------------------------------------------------- the papers' numbers


def test_surrogate_is_the_papers() -> None:
    ratio, advantage = torch.tensor([0.5, 0.5, 1.5, 1.5, 1.1]), torch.tensor([1.0, -1.0, 1.0, -1.0, 2.0])
    loss = losses.clipped_surrogate(ratio.log(), advantage, 0.2)
    torch.testing.assert_close(loss, -torch.tensor([0.5, -0.8, 1.2, -1.5, 2.2]).mean())
    assert losses.clip_fraction(ratio.log(), 0.2).item() == pytest.approx(0.8)


def test_a_clipped_value_earns_nothing_by_moving_further() -> None:
    """Before 0, clipped to ±1, target 5: at 0.5 it is drawn on, at 2 it has gone far enough, at −2 it is drawn back."""
    value, target = torch.tensor([0.5, 2.0, -2.0]), torch.tensor([5.0, 5.0, 5.0])
    loss = losses.clipped_value_loss(value.requires_grad_(), target, torch.zeros(3), 1.0)
    (gradient,) = torch.autograd.grad(loss, value)
    torch.testing.assert_close(loss.detach(), torch.tensor([4.5**2, 4.0**2, 7.0**2]).mean())
    torch.testing.assert_close(gradient, torch.tensor([-9.0, 0.0, -14.0]) / 3)


def test_explained_variance() -> None:
    target = np.array([1.0, 2.0, 3.0], np.float32)
    assert losses.explained_variance(target, target) == 1
    assert losses.explained_variance(np.zeros(3, np.float32), target) == 0
    assert losses.explained_variance(-target, target) == pytest.approx(-3)
    assert np.isnan(losses.explained_variance(target, np.ones(3, np.float32)))


def test_approx_kl_is_zero_where_nothing_moved_and_never_negative() -> None:
    log_ratio = torch.linspace(-1, 1, 9)
    assert losses.approx_kl(torch.zeros(3)) == 0
    assert all(losses.approx_kl(x[None]) >= 0 for x in log_ratio)
    torch.testing.assert_close(losses.approx_kl(log_ratio), (log_ratio.exp() - 1 - log_ratio).mean())


def test_standardized_advantages_have_mean_0_and_std_1() -> None:
    found = losses.standardized(torch.tensor([1.0, 5.0, 9.0]))
    torch.testing.assert_close(found, torch.tensor([-1.0, 0.0, 1.0]))
    assert losses.standardized(torch.tensor([3.0])).tolist() == [3.0]
