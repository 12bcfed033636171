"""`millrace.OwnPolicy` over `millrace.RolloutService`: the same bits for any number of workers, and every error named."""

from __future__ import annotations

import dataclasses
import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import millrace
from tests.support.users_code.own_policies import ARRAYS, EXTRAS, Broken, Linear

SMALL: dict[str, Any] = {"envs": 8, "lanes": 4, "rollout_steps": 16, "transport": "inproc"}
WEIGHTS = {"w": np.random.default_rng(0).normal(0, 0.3, (4, 2)), "b": np.zeros(2)}
OWN = millrace.OwnPolicy(Linear, ARRAYS, EXTRAS, state_size=1)


def batches(count: int = 3, policy: millrace.OwnPolicy = OWN, **settings: Any) -> list[millrace.RolloutBatch]:
    """Batches of a policy whose weights change with each version."""
    found = []
    with millrace.RolloutService("CartPole-v1", policy, **{**SMALL, "workers": 1, **settings}) as service:
        weights = WEIGHTS
        service.publish(weights)
        for batch in itertools.islice(service, count):
            found.append(batch)
            weights = {name: array * 1.1 for name, array in weights.items()}
            service.publish(weights)
    return found


def as_bytes(batch: millrace.RolloutBatch) -> dict[str, bytes]:
    names = ("obs", "action", "log_prob", "reward", "terminated", "truncated", "valid", "state", "lane", "version", "fresh")
    return {name: getattr(batch, name).tobytes() for name in names} | {
        name: array.tobytes() for name, array in batch.extras.items()
    }


def test_one_two_and_four_workers_and_every_transport_give_the_same_bits() -> None:
    reference = [as_bytes(batch) for batch in batches()]
    assert reference[0] != reference[1]
    named = millrace.OwnPolicy("tests.support.users_code.own_policies:Linear", ARRAYS, EXTRAS, state_size=1)
    for settings in ({"workers": 2}, {"workers": 4}, {"workers": 2, "transport": "ipc"}, {"policy": named}):
        assert [as_bytes(batch) for batch in batches(**settings)] == reference


def test_a_batch_has_the_extras_by_name() -> None:
    (batch,) = batches(1)
    assert batch.extras.keys() == {"logits", "side"}
    assert batch.extras["logits"].shape == (16, 8, 2)
    assert batch.extras["side"].dtype == np.uint8
    assert batch.log_prob.shape == (16, 8)
    expected = batch.obs[:-1] @ WEIGHTS["w"].astype(np.float32)
    assert np.allclose(batch.extras["logits"], expected, atol=1e-6)
    assert batch.extras["logits"].flags.writeable
    (silent,) = batches(1, millrace.OwnPolicy(lambda: Quiet(), ARRAYS))
    assert silent.log_prob is None
    assert silent.extras == {}


class Quiet(Linear):
    """Returns the action alone."""

    def act(self, obs: Any, state: Any, rng: Any) -> Any:
        return super().act(obs, state, rng)[0], None, {}


def test_it_is_evaluated_saved_and_restored(tmp_path: Path) -> None:
    file = tmp_path / "state.npz"
    results = []
    for workers in (1, 2):
        with millrace.RolloutService("CartPole-v1", OWN, workers=workers, **SMALL) as service:
            service.publish(WEIGHTS)
            results.append(service.evaluate(6))
            service.save(file, **WEIGHTS)
    assert results[0] == results[1]
    assert results[0].episodes == 6
    with millrace.RolloutService("CartPole-v1", OWN, workers=1, restore=file, **SMALL) as service:
        service.publish(service.restored)
        assert service.gather().version.tolist() == [0] * 8
    other = millrace.OwnPolicy(Linear, {**ARRAYS, "more": (1,)}, EXTRAS, state_size=1)
    with pytest.raises(millrace.CheckpointError, match="expected the policy it was saved with"):
        millrace.RolloutService("CartPole-v1", other, workers=1, restore=file, **SMALL)


def test_the_layout_is_the_declared_one() -> None:
    with millrace.RolloutService("CartPole-v1", OWN, workers=1, **SMALL) as service:
        layout = [(piece.name, piece.shape, piece.offset) for piece in service.policy.layout]
        assert layout == [("w", (4, 2), 0), ("b", (2,), 8)]
        service.publish(np.zeros(10, np.float32))
        for wrong, message in (
            (np.zeros(9), "expected a vector of 10 numbers"),
            ({"w": np.zeros((4, 2))}, "b is missing"),
            ({"w": np.zeros((2, 4)), "b": np.zeros(2)}, r"w: expected shape \[4, 2\], got \[2, 4\]"),
        ):
            with pytest.raises(millrace.UsageError, match=message):
                service.publish(wrong)
        with pytest.raises(millrace.UsageError, match="expected your own initial values"):
            service.policy.initial()


def test_an_error_in_it_arrives_with_its_traceback() -> None:
    policy = millrace.OwnPolicy(Broken, ARRAYS, EXTRAS, state_size=1, kwargs={"wrong": "act raises"})
    with millrace.RolloutService("CartPole-v1", policy, workers=1, max_env_failures=1, **SMALL) as service:
        service.publish(WEIGHTS)
        with pytest.raises(millrace.PolicyFailed) as raised:
            service.gather()
    assert re.fullmatch(
        r"worker \S+ \(\S+\): policy Broken: act raised ZeroDivisionError: of the user's; "
        r"failure 2 in a row; max_env_failures allows 1 in a row",
        str(raised.value),
    )
    assert raised.value.exit_code == 1
    assert 'raise ZeroDivisionError("of the user\'s")' in raised.value.detail
    assert repr(raised.value.__cause__) == repr(ZeroDivisionError("of the user's"))


def test_an_environment_that_raises_beside_it_is_not_called_a_policy() -> None:
    environment = "tests.support.envs.toy:Raises-v0"
    with millrace.RolloutService(environment, QUIET_TOY, workers=1, max_env_failures=0, **SMALL) as service:
        service.publish({"w": np.zeros(1)})
        with pytest.raises(millrace.EnvironmentFailed, match="its environment raised"):
            service.gather()


class First:
    """Always takes the first action."""

    def load(self, arrays: Any) -> None:
        """Needs no weights."""

    def act(self, obs: Any, state: Any, rng: Any) -> Any:
        return np.zeros(len(state), np.int64), None, {}


QUIET_TOY = millrace.OwnPolicy(First, {"w": (1,)})


def test_a_factory_that_raises_is_named() -> None:
    """The worker has joined before it makes the policy: the error comes from the start, or from the first batch."""
    policy = millrace.OwnPolicy(Broken, ARRAYS, EXTRAS, state_size=1, kwargs={"wrong": "factory raises"})
    with (
        pytest.raises(millrace.PolicyFailed, match="policy Broken: cannot be made: it raised ValueError: no such thing"),
        millrace.RolloutService("CartPole-v1", policy, workers=1, max_env_failures=0, **SMALL) as service,
    ):
        service.publish(WEIGHTS)
        service.gather()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (millrace.OwnPolicy("Policy", ARRAYS), "policy Policy: expected module:factory"),
        (millrace.OwnPolicy(5, ARRAYS), "^policy: factory: expected module:callable or a callable, got 5$"),  # type: ignore[arg-type]
        (millrace.OwnPolicy(Linear, 5), "^policy Linear: arrays: expected a dict, got 5$"),  # type: ignore[arg-type]
        (millrace.OwnPolicy(Linear, ARRAYS, ["a"]), r"^policy Linear: extras: expected a dict, got \['a'\]$"),  # type: ignore[arg-type]
        (millrace.OwnPolicy(Linear, ARRAYS, kwargs=5), "^policy Linear: kwargs: expected a dict, got 5$"),  # type: ignore[arg-type]
        (millrace.OwnPolicy(Linear, {"w": (4, 0)}), "array w: expected a shape"),
        (millrace.OwnPolicy(Linear, {"w": 4}), "array w: expected a shape"),  # type: ignore[dict-item]
        (millrace.OwnPolicy(Linear, ARRAYS, {"a": "float33"}), "extra a: expected a dtype of numbers"),
        (millrace.OwnPolicy(Linear, ARRAYS, {"a": "object"}), "extra a: expected a dtype of numbers"),
        (millrace.OwnPolicy(Linear, ARRAYS, {"log_prob": "float64"}), "extra log_prob: expected float32 for each action"),
        (millrace.OwnPolicy(Linear, ARRAYS, {"reward": "float32"}), "extra reward: expected another name"),
        (millrace.OwnPolicy(Linear, ARRAYS, state_size=-1), "state_size: expected a whole number from 0, got -1"),
        (
            millrace.OwnPolicy(Linear, ARRAYS, kwargs={"sizes": (64, 64)}),  # type: ignore[dict-item]
            r"policy Linear: argument sizes: expected a number .* or False, got tuple \(64, 64\)",
        ),
        (millrace.OwnPolicy(Linear, {3: (4, 2)}), "expected text as the name of an array, got 3"),  # type: ignore[dict-item]
        (millrace.OwnPolicy(Linear, ARRAYS, {3: "float32"}), "the name of an array, got 3"),  # type: ignore[dict-item]
    ],
)
def test_declarations_that_cannot_be_used_are_refused(wrong: millrace.OwnPolicy, message: str) -> None:
    with pytest.raises(millrace.UsageError, match=message):
        millrace.RolloutService("CartPole-v1", wrong, workers=1, **SMALL)


@pytest.mark.parametrize("factory", [OWN.factory, "tests.support.users_code.own_policies:Linear"])
def test_a_factory_does_not_travel_over_tcp_without_keys(factory: Any) -> None:
    own = dataclasses.replace(OWN, factory=factory)
    with pytest.raises(millrace.UsageError, match="a policy's factory is code: it travels over ipc or inproc only"):
        millrace.RolloutService("CartPole-v1", own, workers=1, **{**SMALL, "transport": "tcp"})
