"""Finds mistakes in an algorithm. Each rule of `Algorithm` is one function here, which yields the mistakes that it finds.

A mistake is one line of text. Every rule gets its own objects, created with the same seed, and copies of the same batches,
so one broken rule does not hide another. The rules run in this process, on toy batches, with one PyTorch thread.
"""

from __future__ import annotations

import copy
import io
import math
import random
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import torch

from millrace.learner.algorithm_check.same_bits import first_difference
from millrace.learner.algorithm_check.toy_batches import (
    ACTIONS,
    CHOICES,
    OBSERVATION,
    ToyActor,
    identity_batch,
    noise_batch,
    with_other_invalid_rows,
    with_rewards,
    with_waiting_seats,
)
from millrace.learner.algorithms import Algorithm, algorithm_class
from millrace.learner.algorithms.actor_critic import ActorCritic
from millrace.learner.algorithms.algorithm import wrong_weights
from millrace.learner.config.algorithm_names import name_of, settings_record
from millrace.learner.config.hyperparameters import AlgorithmConfig
from millrace.learner.torch_setup import one_thread
from millrace.learner.written_state import write_state
from millrace.protocol.bounds import one_line
from millrace.protocol.errors import UsageError, first_line
from millrace.protocol.policy.own_encoder import describe_encoder
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec

MOST_STEPS = 64  # rollouts in this check have at most this many steps
MOST_UNITS = 32  # limit on the units of a hidden layer, because the rules don't depend on the size
MOST_AT_RANDOM = 100  # limit on the env steps before the first gradient step, because no rule is about them
MOST_WARM_UP = 24  # limit on updates before the first gradient step, because a replay buffer may have to be filled first
MORE_UPDATES = 3  # number of updates that follow the first gradient step
TOTAL_STEPS = 20_000  # total env steps of the toy run; schedules are computed from it
LEARNING_STEPS = 40_000  # env steps within which the identity environment must be learned
LEARNED = 0.5  # the mean reward to reach, on a scale from 0 (random actions) to 1 (perfect actions)
MEASURED_BATCHES = 5  # number of batches over which the mean reward is measured
SEED = 3

Pulse = Callable[[], None]


class StoppedByPulse(Exception):
    """Raised by the pulses that `_stopping` creates."""


class Subject(NamedTuple):
    """The algorithm under test: its class, settings and policy, and recorded batches."""

    algorithm: type[Algorithm]
    config: AlgorithmConfig
    policy: PolicySpec
    steps: int
    batches: tuple[Batch, ...]
    """The algorithm takes gradient steps on the last `MORE_UPDATES` of them."""

    def new(self, total_steps: int = TOTAL_STEPS) -> Algorithm:
        """Create a new object. The global random generators are in the same state each time."""
        _seed_everything(0)
        return self.algorithm(self.config, self.policy, total_steps=total_steps, seed=SEED)

    def copies(self) -> list[Batch]:
        """Copies of the batches."""
        return copy.deepcopy(list(self.batches))


def mistakes(algorithm: type, settings: dict[str, Any], *, learns: bool) -> Iterator[str]:
    """Yield each mistake found, as one line. If `learns`, also check that the algorithm learns the identity environment."""
    with _undisturbed():
        try:
            subject = _subject(algorithm, settings)
            made = [*weights_have_the_policy_s_shape(subject)]
        except Exception as error:
            yield _raised("it cannot be made", error)
            return
        if made:  # no policy can act with such weights, so there can be no batches for the other rules
            yield from made
            return
        try:
            subject = _with_batches(subject, made)
        except Exception as error:
            yield from made
            yield _raised("update", error)
            return
        yield from made
        for rule in (*RULES, *([learns_the_identity_environment] if learns else [])):
            try:
                yield from rule(subject)
            except Exception as error:
                yield _raised(rule.__name__.replace("_", " "), error)


def _subject(algorithm: type, settings: dict[str, Any]) -> Subject:
    name = name_of(algorithm)
    record = settings_record(name)
    try:
        config = msgspec.convert(_small_defaults(record) | settings, record)
    except msgspec.ValidationError as error:
        raise UsageError(f"settings: {one_line(str(error))}") from error
    made = algorithm_class(name)
    for action in ACTIONS:
        try:
            policy: Any = made.policy_spec(config, OBSERVATION, action)
            break
        except UsageError as error:
            refused = error
    else:
        raise refused
    if not isinstance(policy, PolicySpec):
        raise UsageError(f"policy_spec: expected a PolicySpec, got {type(policy).__name__}")
    if config.encoder is not None:
        encoder = describe_encoder(config.encoder, policy.observation, policy.action)
        policy = msgspec.structs.replace(policy, encoder=encoder)
    return Subject(made, config, policy, min(config.rollout_steps, MOST_STEPS), ())


def _small_defaults(record: type[AlgorithmConfig]) -> dict[str, Any]:
    """The default settings, with a smaller network and fewer env steps before the first gradient step, to save time."""
    settings: dict[str, Any] = msgspec.to_builtins(record())
    for net in {"net", "critic_net"} & settings.keys():
        settings[net] = [min(size, MOST_UNITS) for size in settings[net]]
    if "learning_starts" in settings:
        settings["learning_starts"] = min(settings["learning_starts"], MOST_AT_RANDOM)
    return settings


def _with_batches(subject: Subject, made: list[str]) -> Subject:
    """The subject with batches that its own policy collected. Appends mistakes about gradient steps to `made`."""
    algorithm = subject.new()
    generator = np.random.default_rng(1)
    batches: list[Batch] = []
    pulses = [0]

    def pulse() -> None:
        pulses[0] += 1

    before = _weights(algorithm)
    goes_on = MOST_WARM_UP
    while goes_on:
        acting = ToyActor(subject.policy, *_weights(algorithm))
        batch = noise_batch(acting, subject.steps, generator, fresh=not batches)
        batches.append(copy.deepcopy(batch))
        algorithm.update(batch, pulse)
        goes_on = min(goes_on - 1, MORE_UPDATES) if pulses[0] else goes_on - 1
    if not pulses[0]:
        made.append(f"update: expected calls of pulse between gradient steps, got none in {len(batches)} updates")
    if first_difference(before, _weights(algorithm)) is None:
        made.append(f"weights: expected others after {len(batches)} updates, got the same")
    return subject._replace(batches=tuple(batches))


# ------------------------------------------------------------------------------------------------------------- the rules


def weights_have_the_policy_s_shape(subject: Subject) -> Iterator[str]:
    """Check that weights are float32, are finite, and have the size that the policy needs."""
    weights: Any = subject.new().weights()
    if wrong := [*wrong_weights(weights, subject.policy)]:
        yield from wrong
        return
    for name, array in zip(("parameters", "buffers"), weights, strict=True):
        if not np.isfinite(array).all():
            yield f"weights: {name}: expected finite numbers, got {array[~np.isfinite(array)][0]}"


def weights_are_copies(subject: Subject) -> Iterator[str]:
    """Check that `weights` returns copies, because weights may still be on the way to workers during the next update."""
    algorithm = subject.new()
    given = algorithm.weights()
    kept = _weights(algorithm)
    for batch in subject.copies():
        algorithm.update(batch, _no_pulse)
    if first_difference(given, kept) is not None:
        yield "weights: expected a copy, got an array that the next update changes"
    kept = _weights(algorithm)
    for array in algorithm.weights():
        array.fill(7)
    if first_difference(algorithm.weights(), kept) is not None:
        yield "weights: expected a copy, got an array of the algorithm's own"


def metrics_are_finite_numbers(subject: Subject) -> Iterator[str]:
    """Check that metrics have names and are finite floats, so that they can be logged."""
    algorithm = subject.new()
    for batch in subject.copies():
        metrics: Any = algorithm.update(batch, _no_pulse)
        if not isinstance(metrics, dict):
            yield f"update: expected a dict of metrics, got {type(metrics).__name__}"
            return
        for name, number in metrics.items():
            if not isinstance(name, str) or isinstance(number, bool) or not isinstance(number, int | float):
                yield f"update: metric {name}: expected a name and a float, got {type(number).__name__}"
                return
            if not math.isfinite(number):
                yield f"update: metric {name}: expected a finite number, got {number}"
                return


def an_update_changes_no_batch(subject: Subject) -> Iterator[str]:
    """Check that an update leaves its batch unchanged, because other code, such as the recorder, uses the batch later."""
    algorithm = subject.new()
    changed = set[str]()
    for batch, kept in zip(subject.copies(), subject.batches, strict=True):
        algorithm.update(batch, _no_pulse)
        for name in batch.__struct_fields__:
            if first_difference(getattr(batch, name), getattr(kept, name)) is not None:
                changed.add(name)
    if changed:
        yield f"update: expected that the batch stays as it is, got another {', '.join(sorted(changed))}"


def rows_that_are_not_valid_change_nothing(subject: Subject) -> Iterator[str]:
    """Check that invalid rows, which are steps that only reset a copy, change neither weights nor metrics."""
    one = subject.new()
    other = subject.new()
    generator = np.random.default_rng(2)
    for batch in subject.copies():
        pairs = (
            one.update(copy.deepcopy(batch), _no_pulse),
            other.update(with_other_invalid_rows(batch, generator), _no_pulse),
        )
        if (where := first_difference(*pairs)) is not None:
            yield f"update: rows that are not valid change the metrics{where}; use only those where batch.valid"
            return
    if first_difference(_weights(one), _weights(other)) is not None:
        yield "update: rows that are not valid change the weights; use only those where batch.valid"


def what_is_carried_passes_through_rows_that_are_not_valid(subject: Subject) -> Iterator[str]:
    """Check that an actor-critic's metrics don't change if seats wait for some rows between two of their actions.

    Algorithms with a replay buffer are not checked, because additional rows may change which rows they sample.
    """
    if not issubclass(subject.algorithm, ActorCritic):
        return
    batch = subject.copies()[-1]
    measured, expected = (subject.new().update(each, _no_pulse) for each in (with_waiting_seats(batch), batch))
    for name, number in expected.items():
        if not math.isclose(got := measured.get(name, math.nan), number, rel_tol=0.02, abs_tol=0.02):
            yield (
                f"update: rows of a seat that waits change the metric {name} from {number:.4g} to {got:.4g}; take the "
                "functions of millrace.learner.algorithms.returns, with EpisodeEnds.of(batch)"
            )
            return


def the_same_seed_and_batches_give_the_same_bits(subject: Subject) -> Iterator[str]:
    """Check that results are reproducible, whatever state the global generators of torch, numpy and Python are in."""
    results = [_learned(subject, global_seed) for global_seed in (0, 0, 1)]
    if first_difference(results[0], results[1]) is not None:
        yield "update: the same seed and batches give other weights or metrics each time; all random numbers must be seeded"
    elif first_difference(results[0], results[2]) is not None:
        yield "update: it depends on global random numbers (torch, numpy or random); use a generator with the seed"


def a_saved_state_goes_on_as_if_nothing_had_happened(subject: Subject) -> Iterator[str]:
    """Check that a new object that loads a saved state continues to learn exactly as the saved object does, bit for bit."""
    *first, second, third = subject.copies()
    saved = subject.new()
    restored = subject.new()
    for batch in first:
        saved.update(batch, _no_pulse)
    state = saved.state_dict()
    kept = copy.deepcopy(state)
    file = io.BytesIO()
    write_state(file, state, state, "state_dict")
    file.seek(0)
    loaded = torch.load(file, weights_only=True)
    restored.load_state_dict(loaded)
    if (where := first_difference(_weights(saved), _weights(restored))) is not None:
        yield "load_state_dict: expected the weights that were saved, got others"
        return
    if (where := first_difference(kept, restored.state_dict())) is not None:
        yield f"load_state_dict: expected the state that was saved, got another state_dict(){where}"
    for batch in (second, third):
        one, other = (each.update(copy.deepcopy(batch), _no_pulse) for each in (saved, restored))
        if (where := first_difference(one, other)) is not None or first_difference(
            _weights(saved), _weights(restored)
        ) is not None:
            what = f"metrics{where}" if where else "weights"
            yield (
                f"state_dict: after a load the next update gives other {what}; it lacks something that an update changes "
                "(optimizer, random generator, schedule, running statistics)"
            )
            break
    if (where := first_difference(state, kept)) is not None:
        yield f"state_dict{where}: expected a copy, got something that the next update changes"
    file.seek(0)
    if (where := first_difference(loaded, torch.load(file, weights_only=True))) is not None:
        yield f"load_state_dict: expected that it copies the state, got one whose next update changes state{where}"


def an_update_can_be_taken_back(subject: Subject) -> Iterator[str]:
    """Check `roll_back` after a complete update and after one that stopped in the middle. Also check the next update."""
    *first, second, third = subject.copies()
    disturbed = subject.new()
    undisturbed = subject.new()
    for batch in first:
        disturbed.update(copy.deepcopy(batch), _no_pulse)
        undisturbed.update(batch, _no_pulse)
    before = copy.deepcopy(disturbed.state_dict())
    weights = _weights(disturbed)
    disturbed.remember()
    for stop in (False, True, False):
        pulse = _stopping() if stop else _no_pulse
        try:
            disturbed.update(copy.deepcopy(third), pulse)
        except StoppedByPulse:
            pass
        else:
            if stop:
                yield "update: expected that it lets pass what pulse raises, got none"
        disturbed.roll_back()
        when = "an update that stopped in the middle" if stop else "an update"
        if (where := first_difference(before, disturbed.state_dict())) is not None:
            yield f"roll_back: after {when}, expected the state that was remembered, got another state_dict(){where}"
            return
        if first_difference(weights, _weights(disturbed)) is not None:
            yield f"roll_back: after {when}, expected the weights that were remembered, got others"
            return
    one, other = (each.update(copy.deepcopy(second), _no_pulse) for each in (disturbed, undisturbed))
    where = first_difference(one, other)
    if where is not None or first_difference(_weights(disturbed), _weights(undisturbed)) is not None:
        yield "roll_back: the next update differs from one before which nothing was taken back"


def numbers_that_are_not_finite_are_raised(subject: Subject) -> Iterator[str]:
    """Check that an update raises if its loss isn't finite.

    If rewards are NaN, any loss is NaN, so the update must raise. If rewards are too large, the loss may be infinite or NaN;
    the update must then raise or give finite numbers.
    """
    for reward in (math.nan, 3e38):
        algorithm = subject.new()
        *first, last = subject.copies()
        for batch in first:
            algorithm.update(batch, _no_pulse)
        try:
            with np.errstate(all="ignore"):
                metrics = algorithm.update(with_rewards(last, reward), _no_pulse)
        except Exception:
            continue
        if math.isnan(reward):
            yield "update: rewards of NaN: expected an error (check_finite), got metrics, as if nothing had happened"
            return
        bad = next((name for name, number in metrics.items() if not math.isfinite(number)), None)
        if bad is not None:
            yield f"update: rewards of {reward:g}: expected an error or finite numbers, got {bad} {metrics[bad]}"
        elif not all(np.isfinite(array).all() for array in _weights(algorithm)):
            yield f"update: rewards of {reward:g}: expected an error or finite numbers, got weights that are not finite"


def learns_the_identity_environment(subject: Subject) -> Iterator[str]:
    """Check that the algorithm learns the identity environment, in which the right action equals the observation.

    Random choices get a quarter of the reward that right choices get.
    """
    algorithm = subject.new(LEARNING_STEPS)
    generator = np.random.default_rng(4)
    env_steps = 0
    rewards = list[float]()
    action = subject.policy.action
    best = 1 if action.choices else 0
    goal = math.nan
    while env_steps < LEARNING_STEPS:
        acting = ToyActor(subject.policy, *_weights(algorithm))
        batch, reward = identity_batch(acting, subject.steps, generator)
        rewards.append(reward)
        if len(rewards) == MEASURED_BATCHES:
            first = float(np.mean(rewards)) if action.numbers else 1 / CHOICES
            goal = first + LEARNED * (best - first)
        if float(np.mean(rewards[-MEASURED_BATCHES:])) >= goal:
            return
        algorithm.update(batch, _no_pulse)
        env_steps += batch.env_steps
    yield (
        f"it does not learn the identity environment: after {env_steps:,} env steps the mean reward is "
        f"{np.mean(rewards[-MEASURED_BATCHES:]):.2f}, expected at least {goal:.2f}"
    )


RULES = (
    weights_are_copies,
    metrics_are_finite_numbers,
    an_update_changes_no_batch,
    rows_that_are_not_valid_change_nothing,
    what_is_carried_passes_through_rows_that_are_not_valid,
    the_same_seed_and_batches_give_the_same_bits,
    a_saved_state_goes_on_as_if_nothing_had_happened,
    an_update_can_be_taken_back,
    numbers_that_are_not_finite_are_raised,
)


# ----------------------------------------------------------------------------------------------------------------- tools


def _no_pulse() -> None:
    pass


def _stopping() -> Pulse:
    """A pulse that raises `StoppedByPulse` when it is called for the second time."""
    calls = [0]

    def pulse() -> None:
        calls[0] += 1
        if calls[0] == 2:
            raise StoppedByPulse

    return pulse


def _weights(algorithm: Algorithm) -> Any:
    """Copies of the weights."""
    return copy.deepcopy(algorithm.weights())


def _learned(subject: Subject, global_seed: int) -> Any:
    """The weights and metrics after learning from all batches."""
    _seed_everything(global_seed)
    algorithm = subject.algorithm(subject.config, subject.policy, total_steps=TOTAL_STEPS, seed=SEED)
    metrics = [algorithm.update(batch, _no_pulse) for batch in subject.copies()]
    return [_weights(algorithm), metrics]


def _seed_everything(seed: int) -> None:
    torch.manual_seed(seed)
    np.random.seed(seed)
    random.seed(seed)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Use one PyTorch thread. Afterwards, restore the number of threads and all global random generators."""
    of_torch = torch.get_rng_state()
    of_numpy = np.random.get_state()
    of_python = random.getstate()
    try:
        with one_thread():
            yield
    finally:
        torch.set_rng_state(of_torch)
        np.random.set_state(of_numpy)
        random.setstate(of_python)


def _raised(what: str, error: Exception) -> str:
    """One line about an exception from user code, with the place where it was raised."""
    if isinstance(error, UsageError):
        return str(error)
    frame = traceback.extract_tb(error.__traceback__)[-1]
    where = f"{Path(frame.filename).name}:{frame.lineno}"
    return f"{what}: {type(error).__name__} at {where}: {one_line(first_line(error))}"
