"""Updates that several learner processes share: the same bits for any number of them, and the loss of one process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
import torch

from millrace.learner.algorithm_check.same_bits import first_difference
from millrace.learner.algorithms import algorithm_class
from millrace.learner.algorithms.a2c import A2C
from millrace.learner.algorithms.actor_critic import ActorCritic, Estimates
from millrace.learner.algorithms.minibatches import Minibatch
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.learner.config.layers import resolve
from millrace.learner.shards.division import Division
from millrace.learner.shards.learners import Learners
from millrace.learner.shards.messages import FromRankZero, Learn, StillThere
from millrace.learner.shards.reports import MOST_BYTES, Report
from millrace.learner.shards.sharded import COMPARE_EVERY, Sharded, new_sharded, sharded
from millrace.protocol.arrays import Array
from millrace.protocol.errors import LearnerLost, RunError, UsageError
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec
from tests.support.in_process.learner_threads import in_threads
from tests.support.numbers.batches import DISCRETE, GAUSSIAN, IMAGE, MIXED, batch, no_pulse, normal, recurrent, shared
from tests.support.numbers.rounding import assert_within
from tests.support.numbers.steps import only_step
from tests.support.variants import variants

SHARDS = 4
SETTINGS: dict[str, dict[str, Any]] = {
    "ppo": {"batch_size": 50, "n_epochs": 2, "normalize_rewards": True},
    "a2c": {"normalize_advantage": True},
    "impala": {"minibatches": 3, "n_epochs": 2},
    "reinforce": {},
}
POLICIES = {
    "discrete": normal(DISCRETE),
    "box": GAUSSIAN,
    "mixed": normal(MIXED),
    "shared": shared(DISCRETE),
    "lstm": recurrent(normal(DISCRETE), "lstm"),
    "gru": recurrent(GAUSSIAN, "gru"),
    "images": IMAGE,
}


class Counting(A2C):
    """Has a state of its own, which it counts."""

    total = 0.0

    def count(self, batch: Batch) -> None:
        super().count(batch)
        self.total += float(batch.reward.sum())

    def other_state(self) -> dict[str, Any]:
        return super().other_state() | {"total": self.total}

    def load_other_state(self, state: dict[str, Any]) -> None:
        super().load_other_state(state)
        self.total = state["total"]


class Looking(A2C):
    """Its estimate looks at the observations of the batch."""

    def estimate(self, batch: Batch, *rest: Any) -> Estimates:
        return super().estimate(msgspec.structs.replace(batch, reward=batch.obs[0][:-1, :, 0]), *rest)


class TwoOptimizers(A2C):
    """Has another optimizer."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.optimizers["other"] = self.optimizers["optimizer"]


OWN: dict[str, Any] = {"counting": Counting, "looking": Looking}


def make(name: str, spec: PolicySpec, learners: Learners | None, seed: int = 0, **settings: Any) -> ActorCritic:
    config = msgspec.convert(settings or SETTINGS.get(name, {}), HYPERPARAMETERS.get(name, A2C.Config))
    cls: Any = OWN.get(name) or algorithm_class(name)
    if learners is None:
        whole: ActorCritic = cls(config, spec, total_steps=10_000, seed=seed)
        return whole
    with_shards: Any = sharded(cls, SHARDS)
    algorithm: Sharded = with_shards(config, spec, total_steps=10_000, seed=seed)
    algorithm.learners = learners
    return algorithm


def wide(algorithm: ActorCritic, seed: int) -> Batch:
    """A batch of twelve lanes."""
    one, other = batch(algorithm, seed), batch(algorithm, seed + 1000)

    def side_by_side(a: Array, b: Array) -> Array:
        return np.concatenate([a, b], axis=1)

    arrays = {
        name: side_by_side(getattr(one, name), getattr(other, name))
        for name in ("action", "log_prob", "reward", "terminated", "truncated", "valid")
    }
    return msgspec.structs.replace(
        one,
        **arrays,
        obs=tuple(map(side_by_side, one.obs, other.obs)),
        state=np.concatenate([one.state, other.state]),
        lane=np.arange(12),
        fresh=np.zeros(12, bool),
        columns_per_rollout=1,
    )


class Trained(NamedTuple):
    """What a process has after a run."""

    state: dict[str, Any]
    digest: str
    metrics: list[dict[str, float]]
    gradient: Array


def train(
    learners: Learners,
    name: str,
    spec: PolicySpec,
    batches: Sequence[Batch],
    *,
    pulse: Callable[[], None] = no_pulse,
    change: Callable[[ActorCritic], None] | None = None,
    after: Callable[[ActorCritic], None] | None = None,
    **settings: Any,
) -> Trained:
    """One process of a run. `change` is called with the algorithm before the first update, `after` after the first."""
    algorithm = make(name, spec, learners, seed=learners.division.rank, **settings)
    assert isinstance(algorithm, Sharded)
    metrics = []
    if change is not None:
        change(algorithm)
    for number, each in enumerate([*batches, None]):
        if not learners.leads:
            heard = learners.hear()
            if isinstance(heard, Learn):
                algorithm.follow(heard)
        elif each is not None:
            metrics += [algorithm.update(each, pulse)]
        else:
            learners.end("")
        if number == 0 and after is not None:
            after(algorithm)
    return Trained(algorithm.state_dict(), algorithm.digest(), metrics, algorithm.net.flat_grad.numpy().copy())


def of_run(name: str, spec: PolicySpec, batches: Sequence[Batch], processes: int, **settings: Any) -> list[Trained]:
    """What each process has after the batches."""
    results = in_threads(SHARDS, processes, lambda learners: train(learners, name, spec, batches, **settings))
    trained = [each for each in results if isinstance(each, Trained)]
    assert len(trained) == processes, results
    return trained


@pytest.mark.parametrize(
    ("name", "policy"),
    variants(
        [
            *(("ppo", policy) for policy in POLICIES),
            ("a2c", "images"),
            ("impala", "discrete"),
            ("impala", "lstm"),
            ("reinforce", "gru"),
            ("counting", "discrete"),
        ],
        default=[
            ("ppo", "lstm"),
            ("a2c", "images"),
            ("impala", "discrete"),
            ("reinforce", "gru"),
            ("counting", "discrete"),
        ],
    ),
)
def test_the_bits_do_not_depend_on_the_number_of_processes(name: str, policy: str) -> None:
    spec = POLICIES[policy]
    batches = [wide(make(name, spec, None), seed) for seed in range(3)]
    alone, *_ = of_run(name, spec, batches, 1)
    for processes in (2, 4):
        first, *others = of_run(name, spec, batches, processes)
        assert first_difference(alone.state, first.state) is None
        assert alone.metrics == first.metrics
        assert {each.digest for each in others} == {alone.digest}


def test_a_batch_arrives_with_its_masks_its_resets_and_its_extras() -> None:
    algorithm = make("ppo", IMAGE, None)
    rows = wide(algorithm, 0)
    T, N = rows.valid.shape
    random = np.random.default_rng(1)
    rows = msgspec.structs.replace(
        rows,
        mask=random.random((T + 1, N, 4)) < 0.5,
        resets=random.random((T + 1, N // 2)) < 0.5,
        extras=(random.random((T, N, 2)), random.integers(0, 9, (T, N), np.uint8)),
    )
    sent = Learn(rows, algorithm.statistics, None, "")

    def body(learners: Learners) -> FromRankZero:
        if learners.leads:
            learners.tell(1, sent)
        return sent if learners.leads else learners.hear()

    _, heard = in_threads(SHARDS, 2, body)
    assert isinstance(heard, Learn)
    assert first_difference(msgspec.structs.asdict(rows), msgspec.structs.asdict(heard.batch)) is None


ONE_STEP: dict[str, dict[str, Any]] = {
    "ppo": {"batch_size": 10_000, "n_epochs": 1},
    "a2c": {"normalize_advantage": True},
    "impala": {"minibatches": 1, "n_epochs": 1},
    "reinforce": {},
}


@pytest.mark.parametrize(
    ("name", "policy"),
    [("ppo", "lstm"), ("a2c", "box"), ("a2c", "images"), ("impala", "discrete"), ("reinforce", "discrete")],
)
def test_the_gradient_is_that_of_one_process(name: str, policy: str) -> None:
    settings = {"max_grad_norm": 1e9} | ONE_STEP[name]
    whole = make(name, POLICIES[policy], None, **settings)
    algorithm = make(name, POLICIES[policy], Learners(Division(SHARDS, 1, 0)), **settings)
    rows = wide(whole, 0)
    step = only_step(whole, rows)
    metrics = algorithm.update(rows, no_pulse)
    step.assert_is(algorithm.net.flat_grad.numpy())
    assert metrics.keys() == step.metrics.keys()


def without_ends(rows: Batch, lanes: Sequence[int]) -> Batch:
    """The batch, in which no episode of these lanes ends."""
    changed = {name: getattr(rows, name).copy() for name in ("terminated", "truncated", "valid")}
    for name, array in changed.items():
        array[:, lanes] = name == "valid"
    return msgspec.structs.replace(rows, **changed)


@pytest.mark.parametrize("policy", ["discrete", "lstm"])
def test_a_shard_without_rows_adds_nothing(policy: str) -> None:
    spec = POLICIES[policy]
    whole = make("reinforce", spec, None, max_grad_norm=1e9)
    rows = without_ends(wide(whole, 0), [1, 5, 9, 2, 6, 10])  # REINFORCE drops all rows of shards 1 and 2
    step = only_step(whole, rows)
    for processes in (1, 2, 4):
        trained = of_run("reinforce", spec, [rows], processes, max_grad_norm=1e9)
        step.assert_is(trained[0].gradient)


def test_the_parts_of_an_epoch_are_all_valid_rows_once() -> None:
    algorithm = make("ppo", normal(DISCRETE), Learners(Division(SHARDS, 1, 0)), batch_size=40, n_epochs=1)
    rows = wide(algorithm, 0)
    minibatches = watched_parts(algorithm)
    algorithm.update(rows, no_pulse)
    sizes = [sum(len(part.action) for part in parts) for parts in minibatches]
    assert sum(sizes) == np.count_nonzero(rows.valid)
    assert max(sizes) <= 40
    seen = torch.cat([part.log_prob for parts in minibatches for part in parts])
    assert sorted(seen.tolist()) == sorted(rows.log_prob[rows.valid].tolist())


def test_advantages_are_standardized_over_all_parts_of_a_minibatch() -> None:
    algorithm = make("ppo", DISCRETE, Learners(Division(SHARDS, 1, 0)), batch_size=40, n_epochs=1)
    minibatches = watched_parts(algorithm)
    algorithm.update(wide(algorithm, 0), no_pulse)
    for parts in minibatches:
        raw = torch.cat([part.advantage for part in parts]).double()
        scaled = torch.cat([part.standardized for part in parts if part.standardized is not None]).double()
        expected = (raw - raw.mean()) / raw.std()
        assert_within(scaled.numpy(), expected.numpy(), 1e-5 * (1 + abs(expected.numpy())))


def watched_parts(algorithm: ActorCritic) -> list[Sequence[Minibatch]]:
    minibatches: list[Sequence[Minibatch]] = []
    gradient = algorithm.gradient

    def recorded(minibatch: Sequence[Minibatch]) -> dict[str, float]:
        minibatches.append(minibatch)
        return gradient(minibatch)

    algorithm.gradient = recorded  # type: ignore[method-assign]
    return minibatches


# ---------------------------------------------------------------- what goes wrong


def no_loss(rows: object) -> Any:
    raise ValueError("no loss today")


def results_of(processes: int, body: Any) -> list[Any]:
    return in_threads(SHARDS, processes, body)


def test_all_processes_learn_what_went_wrong_in_one() -> None:
    batches = [wide(make("ppo", DISCRETE, None), 0)]

    def body(learners: Learners) -> Any:
        return train(learners, "ppo", DISCRETE, batches, change=fails if learners.division.rank == 1 else None)

    def fails(algorithm: ActorCritic) -> None:
        algorithm.loss = no_loss  # type: ignore[method-assign]

    leading, failed = results_of(2, body)
    assert isinstance(failed, ValueError)
    assert isinstance(leading, RunError)
    assert str(leading) == "learner: rank 1: no loss today"


def test_what_a_pulse_raises_ends_the_update_of_all_processes() -> None:
    batches = [wide(make("ppo", DISCRETE, None), 0)]

    def interrupted() -> None:
        raise KeyboardInterrupt

    def body(learners: Learners) -> Any:
        return train(learners, "ppo", DISCRETE, batches, pulse=interrupted)

    leading, other = results_of(2, body)
    assert isinstance(leading, KeyboardInterrupt)
    assert isinstance(other, RunError)
    assert str(other) == "learner: rank 0: KeyboardInterrupt"


def test_weights_that_differ_are_found() -> None:
    batches = [wide(make("a2c", DISCRETE, None), seed) for seed in range(COMPARE_EVERY + 2)]

    def body(learners: Learners) -> Any:
        return train(learners, "a2c", DISCRETE, batches, after=differ if learners.division.rank == 1 else None)

    def differ(algorithm: ActorCritic) -> None:
        algorithm.net.flat[0] += 1e-6

    leading, other = results_of(2, body)
    assert str(leading) == str(other)
    assert str(leading).startswith(f"learner: rank 1: its state differs from that of rank 0 after update {COMPARE_EVERY}")


def test_an_own_state_that_a_loss_changes_in_one_process_is_found() -> None:
    batches = [wide(make("counting", DISCRETE, None), seed) for seed in range(COMPARE_EVERY + 2)]

    def body(learners: Learners) -> Any:
        return train(learners, "counting", DISCRETE, batches, after=differ if learners.division.rank == 1 else None)

    def differ(algorithm: ActorCritic) -> None:
        assert isinstance(algorithm, Counting)
        algorithm.total += 1

    for each in results_of(2, body):
        assert "rank 1: its state differs" in str(each)


@pytest.mark.parametrize("processes", [1, 2])
def test_an_estimate_that_looks_at_observations_fails_for_any_number_of_processes(processes: int) -> None:
    batches = [wide(make("a2c", DISCRETE, None), 0)]
    for each in results_of(processes, lambda learners: train(learners, "looking", DISCRETE, batches)):
        assert isinstance(each, IndexError)


def test_all_processes_learn_that_one_logs_too_much() -> None:
    batches = [wide(make("ppo", DISCRETE, None), 0)]

    def logs_much(algorithm: ActorCritic) -> None:
        loss = algorithm.loss
        much = {f"number {each}": 0.0 for each in range(1000)}
        algorithm.loss = lambda rows: (loss(rows)[0], much)  # type: ignore[method-assign]

    def body(learners: Learners) -> Any:
        return train(learners, "ppo", DISCRETE, batches, change=logs_much if learners.division.rank == 1 else None)

    leading, other = results_of(2, body)
    assert isinstance(other, UsageError)
    assert str(leading).startswith("learner: rank 1: shards: a loss logs 1001 numbers, ")


def test_an_error_is_told_whatever_characters_it_has() -> None:
    error = "\ud800" + "\U0001f600" * MOST_BYTES
    assert Report.of(Report(0, error=error).encoded()).error.startswith("?\U0001f600")


class OneIsGone(Learners):
    """Of three processes, rank 2 is gone."""

    def __init__(self) -> None:
        super().__init__(Division(3, 3, 0), reply_s=0.0)
        self.told: list[FromRankZero] = []

    def tell(self, rank: int, message: FromRankZero) -> None:
        if rank == 2:
            raise LearnerLost("rank 2 is gone")
        self.told.append(message)


def test_after_a_message_that_not_all_get_no_other_follows() -> None:
    """Rank 1 may be in a collective then, where a message would make gloo end the process."""
    learners = OneIsGone()
    with pytest.raises(LearnerLost):
        learners.still_waits()
    learners.still_waits()
    learners.end("the run has ended")
    assert learners.told == [StillThere()]


def test_after_a_batch_that_not_all_get_no_message_follows() -> None:
    learners = OneIsGone()
    algorithm = make("a2c", DISCRETE, learners)
    algorithm.learners.division = Division(SHARDS, 4, 0)  # type: ignore[attr-defined]
    with pytest.raises(LearnerLost):
        algorithm.update(wide(algorithm, 0), no_pulse)
    learners.still_waits()
    learners.end("the run has ended")
    assert [type(each) for each in learners.told] == [Learn]


def test_an_algorithm_with_two_optimizers_is_refused() -> None:
    config = resolve("CartPole-v1", algo=f"{__name__}:TwoOptimizers", shards=2, lanes=2, envs=2)
    with pytest.raises(UsageError, match=r"^shards 2: TwoOptimizers: expected one optimizer, .* got optimizer, other; "):
        new_sharded(config, DISCRETE, "cpu", Learners(Division(2, 1, 0)))


def test_others_get_the_state_that_was_loaded() -> None:
    batches = [wide(make("ppo", DISCRETE, None), seed) for seed in range(2)]

    def body(learners: Learners) -> Any:
        return train(learners, "ppo", DISCRETE, batches, after=rolled_back if learners.leads else None)

    def rolled_back(algorithm: ActorCritic) -> None:
        algorithm.load_state_dict(algorithm.state_dict() | {"parameters": torch.zeros_like(algorithm.net.flat)})

    leading, other = results_of(2, body)
    assert leading.digest == other.digest


def test_an_update_of_waiting_seats_alone_is_counted_by_all() -> None:
    rows = wide(make("ppo", DISCRETE, None), 0)
    waits = msgspec.structs.replace(rows, valid=np.zeros_like(rows.valid))
    for trained in of_run("ppo", DISCRETE, [waits, rows], 2):
        assert trained.state["version"] == 1


@pytest.mark.parametrize("name", ["dqn", "sac"])
def test_algorithms_with_a_replay_buffer_are_refused(name: str) -> None:
    with pytest.raises(UsageError, match=r"^shards 4: \w+ learns in one process; expected ppo, a2c, impala, reinforce or"):
        sharded(algorithm_class(name), 4)
