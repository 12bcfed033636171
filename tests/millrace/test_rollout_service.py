"""`millrace.RolloutService`: batches for a learner of one's own, with workers in threads of this process."""

from __future__ import annotations

import io
import itertools
import os
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import millrace
from millrace.cli.status import as_table
from millrace.learner.algorithms.bodies.networks import ActorCriticNetwork
from millrace.policies import PolicyParameters
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import CheckpointError, RunError, UsageError
from millrace.protocol.policy.called_policy import CalledPolicy
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.rollout import stack_rollouts
from millrace.workers.collect.collector import Collector
from tests.support.in_process.collectors import collect, random_weights
from tests.support.users_code.seat_envs import AGENTS

SMALL: dict[str, Any] = {"workers": 1, "envs": 4, "lanes": 2, "transport": "inproc"}


@contextmanager
def service(env: Any = "CartPole-v1", *policy: Any, **settings: Any) -> Iterator[millrace.RolloutService]:
    with millrace.RolloutService(env, *policy, **{"rollout_steps": 8, **SMALL, **settings}) as made:
        yield made


def batches(count: int, **settings: Any) -> list[millrace.RolloutBatch]:
    """Batches of a policy whose weights change with each version."""
    found = []
    with service(**settings) as made:
        parameters = made.policy.initial(seed=3)
        made.publish(parameters)
        for batch in itertools.islice(made, count):
            found.append(batch)
            parameters = parameters * np.float32(1.01)
            made.publish(parameters)
    return found


def same(some: millrace.RolloutBatch, others: millrace.RolloutBatch) -> bool:
    names = ("obs", "action", "log_prob", "reward", "terminated", "truncated", "valid", "lane", "version", "fresh")
    return all(np.array_equal(getattr(some, name), getattr(others, name)) for name in names)


def test_a_batch_has_one_rollout_of_each_lane_under_the_newest_weights() -> None:
    first, second = batches(2)
    assert first.obs.shape == (9, 4, 4)
    assert first.action.shape == (8, 4)
    assert first.lane.tolist() == [0, 0, 1, 1]
    assert first.version.tolist() == [0] * 4
    assert second.version.tolist() == [1] * 4
    assert first.fresh.all()
    assert not second.fresh.any()
    assert np.array_equal(first.obs[-1], second.obs[0])
    assert first.env_steps == np.count_nonzero(first.valid)
    assert first.reward.flags.writeable


def test_batches_do_not_depend_on_workers_or_transport() -> None:
    reference = batches(3)
    for settings in ({"workers": 2}, {"transport": "ipc", "workers": 2}):
        assert all(itertools.starmap(same, zip(reference, batches(3, **settings), strict=True)))
    assert not same(reference[0], batches(1, seed=2)[0])


def test_log_probs_are_those_of_the_parameters_that_were_published() -> None:
    (batch,) = batches(1)
    with service() as made:
        parameters = made.policy.named(made.policy.initial(seed=3))
    h = batch.obs[:-1]
    for layer in ("actor.0", "actor.1"):
        h = np.tanh(h @ parameters[f"{layer}.weight"].T + parameters[f"{layer}.bias"])
    logits = h @ parameters["actor.out.weight"].T + parameters["actor.out.bias"]
    log_probs = logits - np.log(np.exp(logits).sum(-1, keepdims=True))
    expected = np.take_along_axis(log_probs, batch.action[..., None], -1)[..., 0]
    # Two layers of 64 and logits below 1: a few hundred roundings of numbers below 1.
    assert np.abs(expected - batch.log_prob)[batch.valid].max() < 500 * 2**-24


def test_episodes_are_those_of_the_rows() -> None:
    found = batches(6, rollout_steps=32)
    rewards = sum(float(batch.reward[batch.valid].sum()) for batch in found)
    episodes = [episode for batch in found for episode in batch.episodes]
    assert sum(episode.length for episode in episodes) <= sum(batch.env_steps for batch in found)
    assert all(episode.reward == episode.length for episode in episodes)  # CartPole's reward is 1 a step
    assert rewards >= sum(episode.reward for episode in episodes) > 0


def test_a_batch_before_the_first_weights_is_refused() -> None:
    with service() as made, pytest.raises(UsageError, match="call publish"):
        made.gather()


@pytest.mark.parametrize("max_lag", [0, 1, 2])
def test_a_batch_acts_under_the_weights_that_were_the_newest_max_lag_batches_before(max_lag: int) -> None:
    """One publishes any number of times between two batches: not at all, once, or twice."""
    with service(max_lag=max_lag) as made:
        newest, acted = [], []
        for times in (1, 0, 2, 1, 2, 0):
            for _ in range(times):
                made.publish(made.policy.initial())
            newest.append(made.version)
            (version,) = set(made.gather().version.tolist())
            acted.append(version)
        assert acted == [newest[max(0, batch - max_lag)] for batch in range(6)]
        counts = made.ledger()
        assert counts["issued"] == counts["used"] + counts["outstanding"] + counts["lost"]
        assert sum(made.lags().values()) == counts["used"]


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (np.zeros(3, np.float32), "parameters: expected a vector of 4610 numbers"),
        ({"actor.0.weight": np.zeros((64, 4))}, "actor.0.bias is missing"),
        (np.full(4610, np.nan, np.float32), "expected finite numbers"),
        (np.full(4610, 1e300), "expected finite numbers"),
        ([[1.0], [1.0, 2.0]], "parameters: expected real numbers, got an array of object"),
        (["1"] * 4610, "parameters: expected real numbers, got an array of <U1"),
        (np.zeros(4610, complex), "parameters: expected real numbers, got an array of complex128"),
    ],
)
def test_weights_that_cannot_be_used_are_refused_and_cost_nothing(parameters: Any, message: str) -> None:
    with service() as made:
        with pytest.raises(UsageError, match=message):
            made.publish(parameters)
        assert made.version == -1
        made.publish(made.policy.named(made.policy.initial()))
        assert made.gather().version.tolist() == [0] * 4


def test_published_arrays_may_change_afterwards() -> None:
    with service() as made:
        parameters = made.policy.initial(seed=3)
        made.publish(parameters)
        parameters[:] = 0
        assert same(made.gather(), batches(1)[0])


def test_a_status_request_gets_the_figures_of_the_batches() -> None:
    with service("tests.support.envs.toy:Countdown-v0", max_lag=1) as made:
        made.publish(made.policy.initial())
        made.gather()
        made.gather()
        text = as_table(made._hub.status(time.monotonic()))
    assert made.env_steps == 2 * 28
    speed = r"[\d,]+ steps/s"
    line = rf"tests\.support\.envs\.toy:Countdown-v0: 56 env steps, {speed}, return 5\.0, update 0, lag 0\.0\n"
    assert re.match(line, text), text


def test_an_evaluation_does_not_disturb_the_rollouts() -> None:
    with service() as made:
        made.publish(made.policy.initial(seed=3))
        first = made.evaluate(4)
        assert first == made.evaluate(4)
        assert first.episodes == 4
        assert same(made.gather(), batches(1)[0])


def test_an_evaluation_that_cannot_be_made_is_refused() -> None:
    with service() as made:
        made.publish(made.policy.initial())
        for wrong in ({"episodes": 0}, {"episodes": "4"}, {"seed": -1}, {"max_steps": 0.5}):
            (name,) = wrong
            with pytest.raises(UsageError, match=f"evaluate: {name}: expected int"):
                made.evaluate(**wrong)
        assert made.evaluate(episodes=1).episodes == 1


def test_a_service_that_cannot_be_saved_is_one_line(tmp_path: Path) -> None:
    with service() as made:
        made.publish(made.policy.initial())
        with pytest.raises(RunError, match=r"no/state.npz not written: No such file or directory$"):
            made.save(tmp_path / "no" / "state.npz")


def test_a_saved_service_goes_on(tmp_path: Path) -> None:
    file = tmp_path / "state.npz"
    with service() as made:
        made.publish(made.policy.initial(seed=3))
        before = made.gather()
        made.publish(made.policy.initial(seed=4))
        made.save(file, parameters=made.policy.initial(seed=4), step=np.int32(7))
        issued, env_steps = made.ledger()["issued"], made.env_steps
    with service(restore=file) as made:
        assert made.env_steps == env_steps
        assert {name: array.dtype for name, array in made.restored.items()} == {"parameters": np.float32, "step": np.int32}
        assert made.publish(made.restored["parameters"]) == 1
        batch = made.gather()
        assert batch.version.tolist() == [1] * 4
        assert not batch.fresh.any()
        counts = made.ledger()
        assert counts["issued"] > issued
        assert counts["issued"] == counts["used"] + counts["outstanding"] + counts["lost"]
        assert np.array_equal(batch.obs[0], before.obs[-1]), "lanes go on where they were"


def test_a_restored_service_that_is_saved_before_it_publishes_goes_on_like_the_first(tmp_path: Path) -> None:
    file, again = tmp_path / "state.npz", tmp_path / "again.npz"

    def batch_after(restored: millrace.RolloutService) -> millrace.RolloutBatch:
        assert restored.publish(restored.policy.initial(seed=4)) == 1
        return restored.gather()

    with service(max_lag=1) as made:
        made.publish(made.policy.initial(seed=3))
        made.gather()
        made.publish(made.policy.initial(seed=4))
        made.save(file)
    with service(restore=file, max_lag=1) as made:
        made.save(again)
        batch = batch_after(made)
    assert batch.version.tolist() == [0] * 4
    with service(restore=again, max_lag=1) as made:
        assert same(batch_after(made), batch)


def test_a_service_that_was_saved_before_it_published_goes_on(tmp_path: Path) -> None:
    with service() as made:
        made.save(tmp_path / "state.npz")
    with service(restore=tmp_path / "state.npz") as made:
        assert made.version == -1
        assert made.publish(made.policy.initial()) == 0
        assert made.gather().version.tolist() == [0] * 4


@pytest.mark.parametrize(
    ("change", "message"),
    [({"policy": millrace.MLP(32)}, "expected the policy"), ({"env": "Acrobot-v1"}, "expected environment CartPole-v1")],
)
def test_a_saved_service_of_something_else_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with service() as made:
        made.save(tmp_path / "state.npz")
    with pytest.raises(CheckpointError, match=message), service(restore=tmp_path / "state.npz", **change):
        pass


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    file = tmp_path / "state.npz"
    with service() as made:
        made.save(file, a=np.ones(3))
        for name in "millrace", "file", "allow_pickle":
            with pytest.raises(UsageError, match=f"save: {name}: expected an array of numbers, not called "):
                made.save(file, **{name: np.ones(3)})
    whole = file.read_bytes()
    nested = io.BytesIO()
    np.savez(nested, millrace=np.frombuffer(b"\x81\xaanormalizer" + b"\x81\xa1a" * 100_000, np.uint8))
    compressed = io.BytesIO()
    with np.load(file) as saved:
        np.savez_compressed(compressed, **saved)
    for damaged in (b"", whole[: len(whole) // 2], b"rubbish", nested.getvalue(), compressed.getvalue()):
        file.write_bytes(damaged)
        with pytest.raises(CheckpointError, match=r"state\.npz"):
            millrace.RolloutService("CartPole-v1", restore=file, **SMALL)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"version": 2**53}, "Expected `int` <= "),
        ({"env_steps": -1}, "Expected `int` >= 0"),
        ({"rollouts": {"incarnations": [2**53] * 4}}, "Expected `int` <= "),
        ({"rollouts": {"ledger": {"issued": 2**53}}}, "Expected `int` <= "),
        (
            {"rollouts": {"ledger": {"used": 5}}},
            "ledger: expected at least as many tickets and transitions as were used or lost, got fewer",
        ),
        ({"normalizer": {}}, "'observations'"),
        ({"normalizer": {"observations": {"count": 3, "mean": [None] * 4, "squares": [1] * 4}}}, "expected finite numbers"),
        ({"normalizer": {"observations": {"count": 3, "mean": [0, 0], "squares": [1] * 4}}}, "could not be broadcast"),
        ({"normalizer": {"observations": {"count": 3, "mean": "x", "squares": 1}}}, "could not convert string to float"),
    ],
)
def test_a_state_that_no_service_can_have_is_one_line(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    """With such numbers no order would reach a worker, and `gather` would wait for a rollout until its timeout."""
    file = tmp_path / "state.npz"
    with service() as made:
        made.save(file)
    with np.load(file) as saved:
        state = msgspec.msgpack.decode(saved["millrace"].tobytes()) | change
    np.savez(file, millrace=np.frombuffer(msgspec.msgpack.encode(state), np.uint8))
    with pytest.raises(CheckpointError) as caught, service(restore=file):
        pass
    assert str(caught.value).startswith(f"{file}: expected a file that RolloutService.save wrote, cannot read it: ")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_of_another_format_is_for_the_millrace_that_wrote_it(tmp_path: Path) -> None:
    file = tmp_path / "state.npz"
    with service() as made:
        made.save(file)
    with np.load(file) as saved:
        later = msgspec.msgpack.decode(saved["millrace"].tobytes()) | {"format": 3, "rollouts": 0}
    for number, state in ((3, msgspec.msgpack.encode(later)), (1, b'{"env":"CartPole-v1","lanes":"gA==","format":1}')):
        np.savez(file, millrace=np.frombuffer(state, np.uint8))
        with pytest.raises(CheckpointError) as caught, service(restore=file):
            pass
        assert str(caught.value) == f"{file}: expected format 2, got {number}; use the millrace that wrote it"


def test_a_pipe_in_the_place_of_a_saved_state_is_refused_and_a_link_followed(tmp_path: Path) -> None:
    with service() as made:
        made.save(tmp_path / "state.npz")
    (tmp_path / "newest.npz").symlink_to("state.npz")
    with service(restore=tmp_path / "newest.npz") as made:
        assert made.version == -1
    os.mkfifo(tmp_path / "pipe.npz")
    with (
        pytest.raises(CheckpointError, match=r"pipe\.npz: .*: expected a file, got a"),
        service(restore=tmp_path / "pipe.npz"),
    ):
        pass


def test_calls_from_another_thread_and_after_the_end_are_refused() -> None:
    errors: list[Exception] = []

    def call(made: millrace.RolloutService) -> None:
        try:
            made.gather()
        except UsageError as error:
            errors.append(error)

    with service() as made:
        made.publish(made.policy.initial())
        thread = threading.Thread(target=call, args=(made,))
        thread.start()
        thread.join(10)
    assert "from another thread" in str(errors[0])
    with pytest.raises(UsageError, match="it was closed"):
        made.gather()
    made.close()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"worker": 2}, "unknown setting worker; did you mean workers"),
        ({"envs": 5}, "5 envs cannot be shared evenly among 2 lanes"),
        ({"rollout_steps": 0}, "rollout_steps: expected int >= 1, got 0"),
        ({"workers": "two"}, "workers: expected int or \"none\", got 'two'"),
        ({"policy": millrace.CNN()}, "expected an image"),
        ({"policy": millrace.MLP(0)}, "expected widths of hidden layers"),
        ({"policy": millrace.Recurrent(8, core_size=0)}, "policy: core_size: expected int >= 1, got 0"),
        ({"policy": millrace.OwnPolicy(dict, {"w": (2,)}, kwargs={"a": [1]})}, "policy dict: argument a: expected a number"),  # type: ignore[dict-item]
        ({"policy": millrace.MLP}, "policy: expected MLP, CNN, Recurrent or OwnPolicy, as in MLP(64, 64), got <class"),
    ],
)
def test_wrong_arguments_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=re.escape(message)), service(**settings):
        pass


@pytest.mark.parametrize(
    "policy", [millrace.Recurrent(16, core="gru", core_size=8), millrace.MLP(8, normalize_observations=True)]
)
def test_other_policies(policy: Any) -> None:
    with service("CartPole-v1", policy) as made:
        made.publish(made.policy.initial())
        batch = made.gather()
        assert batch.state.shape == (4, made.run.policy.state_size)
        assert np.isfinite(batch.log_prob).all()


def test_the_layout_is_that_of_the_trained_network() -> None:
    import gymnasium

    observation = observation_leaves(gymnasium.spaces.Box(-1, 1, (3,)))
    action = action_spec(gymnasium.spaces.Box(-1, 1, (2,)))
    spec = millrace.MLP(8, 8).spec(observation, action)
    parameters, network = PolicyParameters(spec), ActorCriticNetwork(spec)
    assert parameters.size == network.acting_size
    for piece in parameters.layout:
        view = network.parameters[piece.name]
        assert view.shape == piece.shape
        assert view.storage_offset() == piece.offset
    initial = parameters.named(parameters.initial())
    weight = initial["actor.1.weight"]
    assert np.allclose(weight @ weight.T, 2 * np.eye(8), atol=1e-5)
    assert not initial["actor.0.bias"].any()


# ------------------------------------------------------------------------------------------------------- several agents


SEATED = "tests.support.users_code.seat_envs"
BOTH_FORMS = pytest.mark.parametrize("env", [f"{SEATED}:RandomGame", f"{SEATED}:RandomCrowd"])


class Counts:
    """A policy of one's own that counts the moves of each agent in its state."""

    def load(self, arrays: dict[str, Any]) -> None:
        self.w = arrays["w"]

    def act(self, obs: Any, state: Any, rng: np.random.Generator) -> tuple[Any, Any, dict[str, Any]]:
        action = ((obs[:, 0] * self.w[0]).astype(np.int64) + rng.integers(0, 3, len(obs))) % 3
        return action, state + 1, {"log_prob": np.full(len(obs), -1, np.float32), "moves": state[:, 0].copy()}


OWN = millrace.OwnPolicy(f"{__name__}:Counts", {"w": (1,)}, extras={"log_prob": "float32", "moves": "float32"}, state_size=1)


@BOTH_FORMS
@pytest.mark.parametrize("policy", [millrace.Recurrent(8, core="gru", core_size=4), OWN], ids=["built-in", "own"])
def test_agents_have_columns_whose_rows_are_those_of_the_collector(env: str, policy: Any) -> None:
    with service(env, policy) as made:
        weights = random_weights(made.run.policy)
        made.publish(weights[0])
        acting = CalledPolicy(made.run.policy, made.run.extras) if policy is OWN else make_policy(made.run.policy)
        acting.load(*weights)
        collector, N = Collector(made.run, acting), 4 * len(made.seats)
        for sequence in range(3):
            batch = made.gather()
            wanted = stack_rollouts(collect(collector, made.run, sequence, lanes=(0, 1)))
            for name in ("action", "log_prob", "reward", "terminated", "truncated", "valid", "state", "lane", "resets"):
                assert np.array_equal(getattr(batch, name), getattr(wanted, name)), name
            assert np.array_equal(batch.obs, wanted.obs[0])
            assert all(map(np.array_equal, batch.extras.values(), wanted.extras))
            assert (batch.obs.shape, batch.version.tolist(), batch.columns_per_rollout) == ((9, N, 1), [0] * N, N // 2)
            assert batch.resets is not None
            assert batch.resets.shape == (9, 4)
            assert batch.env_steps == wanted.env_steps == np.count_nonzero(~batch.resets[:-1])
            if policy is OWN:
                check_moves(batch)
        assert made.env_steps == collector.steps
        assert made.seats == AGENTS
        assert made.evaluate(3) == made.evaluate(3)


def check_moves(batch: Any) -> None:
    """Of the valid rows of an agent, each has one move more than the one before, or is the first of an episode."""
    for column in range(batch.valid.shape[1]):
        rows = np.flatnonzero(batch.valid[:, column])
        ended = (batch.terminated | batch.truncated)[rows, column]
        moves = batch.extras["moves"][rows, column]
        assert (moves[1:] == np.where(ended[:-1], 0, moves[:-1] + 1)).all()
        if len(rows) and not batch.resets[: rows[0] + 1, column // len(AGENTS)].any():
            assert moves[0] == batch.state[column, 0]


@BOTH_FORMS
def test_with_agents_a_saved_service_goes_on_and_normalizes_valid_rows(tmp_path: Path, env: str) -> None:
    file, policy = tmp_path / "state.npz", millrace.MLP(8, normalize_observations=True)
    with service(env, policy, rollout_steps=64) as made:
        made.publish(made.policy.initial())
        batch = made.gather()
        made.normalizer.update(batch)
        made.normalizer.scaled_rewards(batch, 0.9)
        seen = batch.obs[:-1][batch.valid]
        assert made.normalizer.mean == pytest.approx(seen.mean(0), rel=1e-5)
        made.save(file)
    with service(env, policy, rollout_steps=64, restore=file) as made:
        assert made.env_steps == batch.env_steps
        assert made.normalizer.mean == pytest.approx(seen.mean(0), rel=1e-5)
        made.publish(made.policy.initial())
        assert made.gather().fresh.all(), "these environments have no np_random"
