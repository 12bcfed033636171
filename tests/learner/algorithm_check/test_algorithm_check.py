"""`check_algorithm` finds each planted mistake and says what it is; a sound class and all algorithms of ours pass."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Mapping
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from millrace.algorithms import (
    PPO,
    XQC,
    ActorCritic,
    ActorCriticConfig,
    ActorCriticNetwork,
    AlgorithmConfig,
    Batch,
    Estimates,
    LossInput,
    Observations,
    PolicySpec,
    check_finite,
    features,
    log_prob_and_entropy,
)
from millrace.learner.algorithm_check.same_bits import first_difference
from millrace.learner.algorithms import ALGORITHMS, Algorithm, algorithm_class
from millrace.learner.algorithms.minibatches import ColumnObservations
from millrace.protocol.arrays import Floats
from millrace.protocol.errors import MillraceError, RunError, UsageError
from millrace.protocol.specs import ActionSpec
from millrace.testing import AlgorithmMistakes, check_algorithm
from tests.support.variants import variants

Pulse = Callable[[], None]
Metrics = dict[str, float]
SMALL: dict[str, Any] = {"net": (16,), "n_epochs": 2, "batch_size": 128, "rollout_steps": 32, "learning_rate": 3e-3}


class Sound(ActorCritic):
    """The policy gradient with a value loss, by autograd."""

    class Config(ActorCriticConfig, frozen=True):
        """Settings."""

        bonus: float = 0.0
        """Weight of the squared log-ratio."""

    config: Config

    def loss(self, rows: LossInput) -> tuple[torch.Tensor, Mapping[str, torch.Tensor | float]]:
        ratio = (rows.log_prob_now - rows.log_prob).exp()
        return -(ratio * rows.advantage).mean() + (rows.value - rows.target).square().mean(), {"ratio": ratio.mean()}


class UsesRowsThatAreNotValid(Sound):
    def estimate(self, batch: Batch, observations: Observations, reward: Floats, pulse: Pulse) -> Estimates:
        return super().estimate(batch, observations, reward, pulse)._replace(used=np.ones_like(batch.valid))


class ForgetsItsCoefficient(Sound):
    coefficient = 1.0

    def loss(self, rows: LossInput) -> tuple[torch.Tensor, Mapping[str, torch.Tensor | float]]:
        loss, numbers = super().loss(rows)
        return self.coefficient * loss, numbers

    def update(self, batch: Batch, pulse: Pulse) -> Metrics:
        metrics = super().update(batch, pulse)
        self.coefficient *= 0.7
        return metrics


class HidesWhatIsNotFinite(Sound):
    def update(self, batch: Batch, pulse: Pulse) -> Metrics:
        try:
            return super().update(batch, pulse)
        except RunError:
            return {"train/loss": 0.0}


class IsOtherEachTime(Sound):
    made = itertools.count()

    def loss(self, rows: LossInput) -> tuple[torch.Tensor, Mapping[str, torch.Tensor | float]]:
        loss, numbers = super().loss(rows)
        return loss * (1 + next(self.made) / 100), numbers


class DrawsGlobalNumbers(Sound):
    def loss(self, rows: LossInput) -> tuple[torch.Tensor, Mapping[str, torch.Tensor | float]]:
        loss, numbers = super().loss(rows)
        return loss * torch.rand(()), numbers


class ChangesTheBatch(Sound):
    def observations(self, batch: Batch) -> ColumnObservations:
        np.divide(batch.reward, 10, out=batch.reward)
        return super().observations(batch)


class ForgetsTheOptimizer(Sound):
    def state_dict(self) -> dict[str, Any]:
        return {name: value for name, value in super().state_dict().items() if name != "optimizer"}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state | {"optimizer": self.optimizers["optimizer"].state_dict()})


class RollsBackHalf(Sound):
    def roll_back(self) -> None:
        self.net.flat.copy_(self._remembered["parameters"])


class GivesTheLiveWeights(Sound):
    def weights(self) -> tuple[Floats, Floats]:
        return self.net.flat[: self.net.acting_size].numpy(), super().weights()[1]


class GivesItsOwnStatistics(Sound):
    def weights(self) -> tuple[Floats, Floats]:
        return super().weights()[0], self.statistics


class MeasuresObservationsAfterATermination(Sound):
    def count_update(self, batch: Batch, epochs: int) -> None:
        super().count_update(batch, epochs)
        self.normalizer.update(features(self.policy, batch.obs)[:-1], np.ones_like(batch.valid))
        self.statistics = self.normalizer.buffers()


class GivesOtherTypes(Sound):
    def weights(self) -> tuple[Any, Any]:
        parameters, buffers = super().weights()
        return parameters.astype(np.float64), buffers


class GivesTheCriticToo(Sound):
    def weights(self) -> tuple[Floats, Floats]:
        return self.net.flat.numpy().copy(), super().weights()[1]


class ForgetsThePlaceInItsSchedule(Sound):
    updates = 0

    def set_schedules(self) -> None:
        self.updates += 1
        self.optimizers["optimizer"].param_groups[0]["lr"] = 0.01 / self.updates


class DoesNotPulse(Sound):
    def update(self, batch: Batch, pulse: Pulse) -> Metrics:
        return super().update(batch, lambda: None)


class SwallowsWhatPulseRaises(Sound):
    def update(self, batch: Batch, pulse: Pulse) -> Metrics:
        def quiet() -> None:
            try:
                pulse()
            except Exception:
                return

        return super().update(batch, quiet)


class GivesTensors(Sound):
    def update(self, batch: Batch, pulse: Pulse) -> Any:
        return {name: torch.tensor(value) for name, value in super().update(batch, pulse).items()}


class GivesItsLiveState(Sound):
    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {"parameters": self.net.flat}


class SavesAnArray(Sound):
    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {"more": {"array": np.zeros(3)}}


class SavesCoordinates(Sound):
    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {"visits": {(0, 1): 2}}


class KeepsTheStateItLoads(Sound):
    average: torch.Tensor

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self.average = torch.zeros_like(self.net.flat)

    def update(self, batch: Batch, pulse: Pulse) -> Metrics:
        metrics = super().update(batch, pulse)
        self.average.lerp_(self.net.flat, 0.1)
        return metrics

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {"average": self.average.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.average = state["average"]


class Raises(Sound):
    def loss(self, rows: LossInput) -> tuple[torch.Tensor, Mapping[str, torch.Tensor | float]]:
        raise ValueError("no loss")


class ReturnsOnlyALoss(Sound):
    def loss(self, rows: LossInput) -> Any:
        return super().loss(rows)[0]


class LearnsTheOpposite(Sound):
    def loss(self, rows: LossInput) -> tuple[torch.Tensor, Mapping[str, torch.Tensor | float]]:
        return super().loss(rows._replace(advantage=-rows.advantage))


class ForgetsThatSeatsWait(Sound):
    def estimate(self, batch: Batch, observations: Observations, reward: Floats, pulse: Pulse) -> Estimates:
        return super().estimate(msgspec.structs.replace(batch, resets=None), observations, reward, pulse)


MISTAKES: list[tuple[type, str]] = [
    (ForgetsThatSeatsWait, "update: rows of a seat that waits change the metric train/"),
    (UsesRowsThatAreNotValid, "update: rows that are not valid change the "),
    (ForgetsItsCoefficient, "state_dict: after a load the next update gives other metrics['train/"),
    (HidesWhatIsNotFinite, "update: rewards of NaN: expected an error (check_finite), got metrics"),
    (IsOtherEachTime, "update: the same seed and batches give other weights or metrics each time"),
    (DrawsGlobalNumbers, "update: it depends on global random numbers (torch, numpy or random)"),
    (ChangesTheBatch, "update: expected that the batch stays as it is, got another reward"),
    (ForgetsTheOptimizer, "state_dict: after a load the next update gives other "),
    (RollsBackHalf, "roll_back: after an update, expected the state that was remembered, got another state_dict()['"),
    (GivesTheLiveWeights, "weights: expected a copy, got an array that the next update changes"),
    (GivesItsOwnStatistics, "weights: expected a copy, got an array of the algorithm's own"),
    (MeasuresObservationsAfterATermination, "update: rows that are not valid change the metrics['train/ratio']"),
    (GivesOtherTypes, "weights: parameters: expected float32[148], got float64[148]"),
    (GivesTheCriticToo, "weights: parameters: expected float32[148], got float32[245]"),
    (ForgetsThePlaceInItsSchedule, "state_dict: after a load the next update gives other "),
    (DoesNotPulse, "update: expected calls of pulse between gradient steps, got none in 24 updates"),
    (SwallowsWhatPulseRaises, "update: expected that it lets pass what pulse raises, got none"),
    (GivesTensors, "update: metric train/ratio: expected a name and a float, got Tensor"),
    (GivesItsLiveState, "state_dict['parameters']: expected a copy, got something that the next update changes"),
    (SavesAnArray, "state_dict['more']['array'] (numpy.ndarray): expected tensors and plain data, got "),
    (
        SavesCoordinates,
        "state_dict['visits'] (builtins.dict): expected tensors and plain data, got a key that is neither text",
    ),
    (KeepsTheStateItLoads, "load_state_dict: expected that it copies the state, got one whose next update changes"),
    (Raises, "update: ValueError at test_algorithm_check.py:"),
    (ReturnsOnlyALoss, "ReturnsOnlyALoss.loss: expected a 0-dimensional tensor that depends on"),
]


@pytest.mark.parametrize(("planted", "says"), MISTAKES, ids=lambda value: getattr(value, "__name__", ""))
def test_a_planted_mistake_is_found(planted: type, says: str) -> None:
    with pytest.raises(AlgorithmMistakes) as caught:
        check_algorithm(planted, learns=False, normalize_observations=True, **SMALL | {"rollout_steps": 8})
    assert any(says in line for line in caught.value.mistakes), caught.value.mistakes
    assert str(caught.value).splitlines() == [f"{planted.__name__}: {line}" for line in caught.value.mistakes]
    assert isinstance(caught.value, AssertionError)
    assert isinstance(caught.value, MillraceError)


def test_an_algorithm_that_does_not_learn_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("millrace.learner.algorithm_check.mistakes.LEARNING_STEPS", 4_000)
    with pytest.raises(
        AlgorithmMistakes, match=r"does not learn the identity environment: after 4,\d+ env steps the mean"
    ) as caught:
        check_algorithm(LearnsTheOpposite, **SMALL)
    assert len(caught.value.mistakes) == 1, "all else is right"


def test_a_sound_algorithm_passes_and_nothing_global_changes() -> None:
    torch.manual_seed(5)
    np.random.seed(5)
    threads = torch.get_num_threads()
    check_algorithm(Sound, **SMALL)
    found = torch.rand(1).item(), np.random.random()
    torch.manual_seed(5)
    np.random.seed(5)
    assert found == (torch.rand(1).item(), np.random.random())
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize("settings", [{"core": "gru"}, {"normalize_rewards": True, "normalize_observations": True}])
def test_it_passes_with_other_settings(settings: dict[str, Any]) -> None:
    check_algorithm(Sound, learns=False, **SMALL | {"rollout_steps": 8} | settings)


class OtherLoss(PPO):
    """PPO with a loss that logs nothing."""

    def loss(self, rows: LossInput) -> tuple[torch.Tensor, Mapping[str, torch.Tensor | float]]:
        ratio = (rows.log_prob_now - rows.log_prob).exp()
        return -(ratio * rows.advantage).mean() + (rows.value - rows.target).square().mean(), {}


class OnlyMixed(PPO):
    """Takes no actions but those of a Dict or Tuple."""

    @staticmethod
    def policy_spec(config: Any, observation: Any, action: ActionSpec) -> PolicySpec:
        if not action.parts:
            raise UsageError(f"only mixed: expected a Dict or Tuple, got {action.in_words}")
        return PPO.policy_spec(config, observation, action)


def test_an_algorithm_of_dicts_and_tuples_alone_is_checked_and_learns() -> None:
    check_algorithm(OnlyMixed, **SMALL)


def test_a_subclass_of_ppo_need_not_log_what_ppo_logs() -> None:
    check_algorithm(OtherLoss, learns=False, **SMALL | {"rollout_steps": 8})
    with pytest.raises(AlgorithmMistakes) as caught:
        check_algorithm(OtherLoss, learns=False, target_kl=0.01, **SMALL)
    says = "OtherLoss.loss: target_kl needs approx_kl among the numbers that it logs, got loss, grad_norm; log "
    assert says in str(caught.value)


CONTINUOUS: dict[str, Any] = {"rollout_steps": 8, "learning_rate": 3e-3, "updates_per_step": 0.1}
CHOICES: dict[str, Any] = {
    "rollout_steps": 16, "learning_rate": 3e-3, "learning_starts": 0, "gradient_steps": 8, "epsilon_steps": 2000,
}  # fmt: skip
LEARNS_SOON: dict[str, dict[str, Any]] = {
    **{name: {"rollout_steps": 16, "learning_rate": 0.02} for name in ("a2c", "impala", "reinforce")},
    "ppo": {"rollout_steps": 16, "learning_rate": 0.01, "n_epochs": 4, "batch_size": 128},
    **dict.fromkeys(("dqn", "rainbow"), CHOICES),
    **dict.fromkeys(("sac", "td3", "tqc"), CONTINUOUS),
    **{name: {**CONTINUOUS, "critic_net": (16,), "learning_starts": 100, "policy_delay": 1} for name in ("crossq", "xqc")},
}


@pytest.mark.parametrize("name", variants(ALGORITHMS, default=["ppo", "dqn"]))
def test_the_algorithms_of_ours_pass(name: str) -> None:
    """With one kind of policy. All others: `test_every_algorithm`."""
    check_algorithm(algorithm_class(name), net=(16,), **LEARNS_SOON[name])


class Whole(Algorithm):
    """The second level: REINFORCE without a baseline, which makes the whole update itself."""

    class Config(AlgorithmConfig, frozen=True):
        """Settings."""

        learning_rate: float = 0.01
        """Learning rate."""

    def __init__(self, config: Config, policy: PolicySpec, *, total_steps: int, seed: int, device: str = "cpu") -> None:
        self.config, self.policy = config, policy
        self.net = ActorCriticNetwork(policy, device, seed=seed)
        self.optimizer = torch.optim.Adam([self.net.flat], lr=config.learning_rate)

    def update(self, batch: Batch, pulse: Pulse) -> Metrics:
        valid = batch.valid.ravel()
        x = torch.from_numpy(features(self.policy, batch.obs)[:-1].reshape(valid.size, -1)[valid])
        action = torch.from_numpy(batch.action.reshape(valid.size, *batch.action.shape[2:])[valid])
        reward = torch.from_numpy(batch.reward.ravel()[valid])
        log_prob, _ = log_prob_and_entropy(self.policy.action, self.net.params(x), action)
        loss = -(log_prob * (reward - reward.mean())).mean()
        self.net.flat_grad.zero_()
        loss.backward()  # type: ignore[no-untyped-call]
        metrics = {"loss": loss.item(), "grad_norm": self.net.flat_grad.norm().item()}
        check_finite(metrics, 0, "a lower learning_rate")
        self.optimizer.step()
        pulse()
        pulse()
        return {f"train/{name}": number for name, number in metrics.items()}

    def weights(self) -> tuple[Floats, Floats]:
        return self.net.flat[: self.net.acting_size].cpu().numpy().copy(), np.empty(0, np.float32)

    def state_dict(self) -> dict[str, Any]:
        return {"parameters": self.net.flat.clone(), "optimizer": copy.deepcopy(self.optimizer.state_dict())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.net.flat.copy_(state["parameters"])
        self.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))


def test_a_whole_algorithm_passes_and_rolls_back_by_its_base() -> None:
    check_algorithm(Whole, net=(16,))


class WithAModule(Whole):
    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self.model = torch.nn.Linear(2, 2)
        self.model.requires_grad_(False).weight.fill_(0.5)
        self.model.bias.zero_()

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {"model": copy.deepcopy(self.model.state_dict())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.model.load_state_dict(state["model"])


def test_an_algorithm_may_save_the_state_of_a_module() -> None:
    check_algorithm(WithAModule, learns=False, net=(16,))


class Lacking(Algorithm):
    def update(self, batch: Batch, pulse: Pulse) -> Metrics:
        return {}


def test_what_a_class_lacks_is_one_mistake() -> None:
    with pytest.raises(AlgorithmMistakes, match=r"it lacks __init__, weights, state_dict, load_state_dict; derive it"):
        check_algorithm(Lacking)
    with pytest.raises(AlgorithmMistakes, match=r"settings: Expected `float`, got `str` - at `\$.bonus`"):
        check_algorithm(Sound, bonus="much")


class Unready(XQC):
    """Says which settings it got, and ends the check."""

    def __init__(self, config: Any, *_: Any, **__: Any) -> None:
        raise UsageError(f"got {config.net} {config.critic_net} {config.learning_starts}")


@pytest.mark.parametrize(
    ("settings", "got"),
    [({}, "(32, 32) (32, 32) 100"), ({"net": (40,), "critic_net": (8,), "learning_starts": 300}, "(40,) (8,) 300")],
)
def test_the_check_uses_small_settings_unless_it_is_given_others(settings: dict[str, Any], got: str) -> None:
    """XQC's defaults are 5,000 env steps, more than the check takes, before the first gradient step."""
    with pytest.raises(AlgorithmMistakes) as caught:
        check_algorithm(Unready, **settings)
    assert caught.value.mistakes == [f"got {got}"]


def test_states_are_compared_bit_for_bit() -> None:
    nan = float("nan")
    state = {"a": [torch.tensor([1.0, nan]), 2], "b": (np.zeros(2), "x", nan)}
    assert first_difference(state, copy.deepcopy(state)) is None
    for path, other in (
        ("['a'][0]", {**state, "a": [torch.tensor([1.0, 0.0]), 2]}),
        ("['a'][0]", {**state, "a": [torch.tensor([1.0, nan], dtype=torch.float64), 2]}),
        ("['a'][1]", {**state, "a": [state["a"][0], 2.0]}),
        ("['b'][0]", {**state, "b": (np.array([0.0, -0.0]), "x", nan)}),
        ("", {"a": state["a"]}),
    ):
        assert first_difference(state, other) == path
