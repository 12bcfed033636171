"""What every algorithm of ours keeps, with every kind of policy and settings: the rules of `check_algorithm`."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import msgspec
import numpy as np
import pytest

from millrace.learner.algorithm_check.mistakes import RULES, Subject, weights_have_the_policy_s_shape
from millrace.learner.algorithm_check.same_bits import first_difference
from millrace.learner.algorithms import ALGORITHMS, Algorithm, algorithm_class
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.protocol.errors import RunError
from millrace.protocol.specs import PolicySpec
from tests.learner.algorithms.test_action_masks import masked_batch, spec_of
from tests.support.numbers.batches import DISCRETE, GAUSSIAN, IMAGE, MIXED, T, batch, no_pulse, normal, recurrent, shared
from tests.support.variants import variants

ALL: dict[str, Any] = {"normalize_rewards": True, "learning_rate_schedule": "linear"}
EPOCHS: dict[str, dict[str, Any]] = {
    "ppo": {"n_epochs": 2, "batch_size": 64, "clip_range_schedule": "linear"},
    "impala": {"n_epochs": 2, "minibatches": 2},
}
REPLAY: dict[str, Any] = {
    "net": (16,),
    "batch_size": 32,
    "learning_starts": 0,
    "replay_size": 150,  # which the second batch overwrites
}
MORE_REPLAY = ALL | {"priority_alpha": 0.6, "n_step": 3, "normalize_observations": True}
MORE_DQN = {"dueling": True, "target_every": 1, "tau": 0.005, "optimizer": "adamw", "amsgrad": True, "max_grad_norm": 1.0}
ON_POLICY: dict[str, tuple[PolicySpec, dict[str, Any]]] = {
    "discrete": (normal(DISCRETE), {"optimizer": "adam"}),
    "Gaussian": (normal(GAUSSIAN), {"optimizer": "rmsprop"}),
    "images": (shared(IMAGE), {"optimizer": "adam"}),
    "mixed": (MIXED, {"optimizer": "adam"}),
}
STEPS: dict[str, dict[str, Any]] = {
    "dqn": {"gradient_steps": 3},
    "rainbow": {"gradient_steps": 3, "quantiles": 4},
    "sac": {"updates_per_step": 0.03},
    "td3": {"updates_per_step": 0.03},
    "tqc": {"updates_per_step": 0.03},
    "crossq": {"updates_per_step": 0.03, "critic_net": (12, 10), "policy_delay": 2, "renormalize_after": 4},
    "xqc": {"updates_per_step": 0.03, "critic_net": (12, 10), "policy_delay": 2, "atoms": 11},
}
MEMORY_STEPS = 6
MEMORY: dict[str, Any] = {"core": "gru", "core_size": 8, "rollout_steps": MEMORY_STEPS}
CHOICES = ("dqn", "rainbow")
CONTINUOUS = [name for name in STEPS if name not in CHOICES]


def kinds() -> dict[str, tuple[str, PolicySpec, dict[str, Any]]]:
    """The name of an algorithm, its policy, and its settings."""
    found: dict[str, tuple[str, PolicySpec, dict[str, Any]]] = {}
    for name in ("ppo", "a2c", "impala", "reinforce"):
        for kind, (spec, settings) in ON_POLICY.items():
            found[f"{name}, {kind}"] = (name, spec, ALL | EPOCHS.get(name, {}) | ({} if name == "ppo" else settings))
        found[f"{name}, masks"] = (name, spec_of("discrete"), EPOCHS.get(name, {}))
    found["ppo, images, two networks"] = ("ppo", IMAGE, ALL | EPOCHS["ppo"])
    found["ppo, GRU"] = ("ppo", recurrent(normal(DISCRETE), "gru"), EPOCHS["ppo"])
    found["impala, LSTM"] = ("impala", recurrent(GAUSSIAN, "lstm"), EPOCHS["impala"])
    found["ppo, layers that are not small"] = ("ppo", msgspec.structs.replace(shared(GAUSSIAN), net=(257,)), EPOCHS["ppo"])
    for name, steps in STEPS.items():
        spec = DISCRETE if name in CHOICES else GAUSSIAN
        found[name] = (name, spec, REPLAY | steps)
        found[f"{name}, everything"] = (name, spec, REPLAY | MORE_REPLAY | steps | (MORE_DQN if name in CHOICES else {}))
    found["rainbow, not normalized"] = ("rainbow", DISCRETE, REPLAY | STEPS["rainbow"] | {"batch_norm": False})
    for name in CONTINUOUS:
        found[f"{name}, images"] = (name, msgspec.structs.replace(IMAGE, action=GAUSSIAN.action), REPLAY | STEPS[name])
    for name in CONTINUOUS:
        found[f"{name}, GRU"] = (name, GAUSSIAN, REPLAY | STEPS[name] | MEMORY | {"updates_per_step": 0.1})
    of_dqn = REPLAY | STEPS["dqn"] | MEMORY
    found["dqn, GRU"] = ("dqn", DISCRETE, of_dqn)
    found["dqn, LSTM, everything"] = ("dqn", DISCRETE, of_dqn | MORE_REPLAY | MORE_DQN | {"core": "lstm"})
    found["dqn, GRU, masks"] = ("dqn", spec_of("discrete"), of_dqn | MORE_REPLAY | {"rollout_steps": T})
    for name in CHOICES:
        found[f"{name}, images"] = (name, IMAGE, REPLAY | MORE_REPLAY | STEPS[name])
        found[f"{name}, masks"] = (name, spec_of("discrete"), REPLAY | MORE_REPLAY | STEPS[name])
    return found


def subject_of(name: str, spec: PolicySpec, settings: dict[str, Any], masks: bool = False) -> Subject:
    """The algorithm, and four batches that its first weights acted on."""
    kind, config = algorithm_class(name), msgspec.convert(settings, HYPERPARAMETERS[name])
    policy = kind.policy_spec(config, spec.observation, spec.action) if name in STEPS else spec
    steps = T if policy.core is None or masks else MEMORY_STEPS  # each is many small steps of the core
    if len(spec.observation) > 1 and name not in STEPS:
        steps = T // 2  # images
    subject = Subject(kind, config, policy, steps, ())
    acting: Any = subject.new()
    rows = (masked_batch(acting, seed) if masks else batch(acting, seed, seed == 0, steps) for seed in range(4))
    return subject._replace(batches=tuple(rows))


ONE_KIND = (
    "ppo, mixed",
    "a2c, Gaussian",
    "impala, LSTM",
    "reinforce, masks",
    "dqn, everything",
    "dqn, LSTM, everything",
    "sac, GRU",
    "rainbow, masks",
    *CONTINUOUS,
)


@pytest.mark.parametrize("kind", variants(kinds(), default=ONE_KIND))
def test_it_keeps_the_rules(kind: str) -> None:
    subject = subject_of(*kinds()[kind], masks="masks" in kind)
    assert [line for rule in (weights_have_the_policy_s_shape, *RULES) for line in rule(subject)] == []
    algorithm = subject.new()
    for rows in subject.copies():
        before = algorithm.weights()
        algorithm.update(rows, no_pulse)
        assert first_difference(before[0], algorithm.weights()[0]) is not None  # else this test shows nothing


def small(name: str, seed: int = 0, **settings: Any) -> Algorithm:
    spec = GAUSSIAN if name in CONTINUOUS else DISCRETE
    subject = subject_of(name, spec, (REPLAY | STEPS[name] if name in STEPS else {}) | settings)
    return subject.algorithm(subject.config, subject.policy, total_steps=10_000, seed=seed)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_another_seed_gives_other_weights(name: str) -> None:
    one, other = (small(name, seed).weights()[0] for seed in (0, 1))
    assert not np.array_equal(one, other)


@pytest.mark.parametrize(
    ("name", "broken"),
    [
        *((name, "reward") for name in ALGORITHMS),
        *((name, "obs") for name in ("ppo", "a2c", "impala", "reinforce")),
        ("ppo", "log_prob"),
    ],
)
def test_a_loss_that_is_not_finite_is_named_and_stops_before_the_weights(name: str, broken: str) -> None:
    algorithm: Any = small(name, normalize_rewards=False)  # scaled rewards are clipped
    algorithm.update(batch(algorithm, 0), no_pulse)
    before, rows = algorithm.net.flat.clone(), batch(algorithm, 1)
    array = rows.obs[0] if broken == "obs" else getattr(rows, broken)
    array[:] = {"reward": np.inf, "obs": np.nan, "log_prob": -np.inf}[broken]
    expected = r"update \d: \w+: expected finite, got .*this step was not taken; try a lower"
    with pytest.raises(RunError, match=expected), np.errstate(all="ignore"):
        algorithm.update(rows, no_pulse)
    assert first_difference(algorithm.net.flat, before) is None


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_env_step_counts_also_where_all_seats_wait(name: str) -> None:
    """Schedules depend on it. In a game of two, one copy and one step a rollout, every second batch has no whole row."""
    algorithm: Any = small(name)
    whole = batch(algorithm, 0)
    resets = np.zeros((T + 1, whole.valid.shape[1]), bool)
    waits = np.zeros_like(whole.valid)
    algorithm.update(msgspec.structs.replace(whole, valid=waits, terminated=waits, truncated=waits, resets=resets), no_pulse)
    assert algorithm.env_steps == whole.valid.size


@pytest.mark.parametrize("name", ALGORITHMS)
def test_weights_that_a_step_makes_infinite_are_noticed(name: str) -> None:
    """The loss and the gradient are finite, but the step is not. The next step notices, or `is_finite` after the update."""
    largest = 1e38 if name in ("a2c", "impala") else 1e300  # RMSprop takes no number that is too large for float32
    algorithm: Any = small(name, learning_rate=largest)
    before, rows = algorithm.state_dict(), batch(algorithm, 0)
    assert algorithm.is_finite()
    with suppress(RunError), np.errstate(all="ignore"):
        algorithm.update(rows, no_pulse)
    assert not algorithm.is_finite()
    algorithm.load_state_dict(before)
    assert algorithm.is_finite()
