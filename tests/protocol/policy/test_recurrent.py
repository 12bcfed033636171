"""The recurrent core: torch's own arithmetic, carried by the lane, begun anew by the row format; and what it is for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import msgspec
import numpy as np
import pytest
import torch

from millrace.learner.algorithms import algorithm_class
from millrace.learner.algorithms.bodies.networks import ActorCriticNetwork
from millrace.learner.algorithms.minibatches import Minibatch, log_probs
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.config.hyperparameters import HYPERPARAMETERS, PPOConfig
from millrace.learner.torch_setup import one_thread
from millrace.protocol.arrays import Array
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import BadRollout
from millrace.protocol.messages import Evaluate, Permit
from millrace.protocol.policy.distributions import distribution
from millrace.protocol.policy.encoder import RecurrentInput
from millrace.protocol.policy.layout import buffer_size
from millrace.protocol.policy.numpy_policy import NumpyPolicy
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.policy.recurrent import advance, zero_state
from millrace.protocol.policy.torch_distributions import log_prob_and_entropy
from millrace.protocol.policy.torch_policy import TorchPolicy
from millrace.protocol.rollout import Rollout, stack_rollouts
from millrace.protocol.rows.rollout_checks import validate
from millrace.protocol.specs import PolicySpec, RunSpec
from millrace.workers.collect.collector import Collector
from millrace.workers.evaluate.evaluator import Evaluator
from tests.support.conversation.example_messages import example
from tests.support.envs.toy import Scripted
from tests.support.in_process.collectors import TOY, collect, evaluated, random_collector, random_policy, run_of
from tests.support.numbers.batches import DISCRETE, GAUSSIAN, IMAGE, batch, no_pulse, normal, recurrent, shared
from tests.support.numbers.rounding import ELEMENTWISE, UNIT, assert_within, in_double, in_float64, sampled

Core = Literal["lstm", "gru"]
CORES: tuple[Core, Core] = ("lstm", "gru")


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> Iterator[None]:
    with one_thread():
        yield


def random_net(spec: PolicySpec, seed: int = 0) -> ActorCriticNetwork:
    net = ActorCriticNetwork(spec)
    net.flat.copy_(torch.tensor(np.random.default_rng(seed).normal(0, 0.5, len(net.flat)), dtype=torch.float32))
    return net


def doubles(given: RecurrentInput) -> RecurrentInput:
    return given._replace(initial_state=given.initial_state.double(), keep_state=given.keep_state.double())


def acting(net: ActorCriticNetwork) -> Array:
    return net.flat.numpy()[: net.acting_size].copy()


# ------------------------------------------------------------------------------------------------ arithmetic


@pytest.mark.parametrize("core", CORES)
def test_it_computes_what_torch_computes(core: Core) -> None:
    """`torch.nn.LSTM` and `torch.nn.GRU`, over a sequence, from a state that is not zero."""
    spec = recurrent(DISCRETE, core)
    net = random_net(spec)
    own = torch.nn.LSTM(4, 8) if core == "lstm" else torch.nn.GRU(4, 8)
    with torch.no_grad():
        for ours, theirs in (("input", "ih"), ("state", "hh")):
            for kind in ("weight", "bias"):
                getattr(own, f"{kind}_{theirs}_l0").copy_(net.parameters[f"core.{ours}.{kind}"])
    T, C = 7, 5
    x, state = torch.randn(T, C, 4), torch.randn(C, spec.state_size)
    begun = tuple(part[None].contiguous() for part in state.chunk(2, -1)) if core == "lstm" else state[None]
    with torch.no_grad():
        expected, after = own(x, begun)
        found, last = net.encode.core(x.flatten(0, 1), RecurrentInput(state, torch.ones(T, C)))
    parameters, exact = {name: tensor.detach().numpy() for name, tensor in net.parameters.items()}, in_float64(net)
    given = doubles(RecurrentInput(state, torch.ones(T, C)))
    outputs, of_state = sampled(lambda: exact.encode.core(x.double().flatten(0, 1), given))
    outputs_tolerance = outputs.tolerance.reshape(T, C, 8)
    outputs.assert_is(found.numpy(), expected.flatten(0, 1).numpy())
    of_state.assert_is(last.numpy(), (torch.cat(after, -1)[0] if core == "lstm" else after[0]).numpy())
    now = state.numpy()[None].copy()
    for t in range(T):
        out = advance(spec, parameters, x[t].numpy()[None], now)
        assert_within(out[0], expected[t].numpy(), outputs_tolerance[t])
    of_state.assert_is(now[0])


@pytest.mark.parametrize("core", CORES)
@pytest.mark.parametrize(
    "spec", [DISCRETE, normal(GAUSSIAN), IMAGE, shared(IMAGE)], ids=["plain", "normal", "image", "shared"]
)
def test_acting_step_by_step_is_learning_over_the_sequence(core: Core, spec: PolicySpec) -> None:
    """With episodes that begin within the sequence, in numpy or torch."""
    spec = recurrent(spec, core)
    net, generator = random_net(spec), np.random.default_rng(1)
    policy = make_policy(spec)
    assert isinstance(policy, TorchPolicy if spec.needs_torch else NumpyPolicy)
    buffers = generator.uniform(0.5, 2, buffer_size(spec)).astype(np.float32)
    policy.load(acting(net), buffers)
    T, L, N = 6, 2, 3
    leaves: list[Array] = [generator.normal(size=(T, L, N, 4)).astype(np.float32)]
    if spec.needs_torch:
        leaves.append(generator.integers(0, 256, (T, L, N, 8, 8, 1), dtype=np.uint8))
    carried = generator.random((T, L, N)) < 0.7
    carried[0] = True
    state = generator.normal(size=(L, N, spec.state_size)).astype(np.float32)
    now, acted = state.copy(), []
    for t in range(T):
        now[~carried[t]] = 0
        acted.append(policy([leaf[t] for leaf in leaves], now))
    x = (leaves[0] - buffers[:4]) / buffers[4:8] if spec.normalize_observations else leaves[0]
    recurrent_input = RecurrentInput(torch.tensor(state).flatten(0, 1), torch.tensor(carried.astype(np.float32)).flatten(1))
    images = [torch.tensor(leaf).flatten(0, 2) for leaf in leaves[1:]]
    with torch.no_grad():
        params, value = net.forward(torch.tensor(x).flatten(0, 2), images, recurrent_input)
    exact = in_float64(net)
    (expected,) = sampled(lambda: [exact.params(torch.tensor(x).double().flatten(0, 2), images, doubles(recurrent_input))])
    expected.assert_is(params.numpy(), np.stack(acted).reshape(T * L * N, -1))
    wanted = torch.tensor([3, 30, 17])
    with torch.no_grad():
        some = net.forward(torch.tensor(x).flatten(0, 2), images, recurrent_input._replace(output_rows=wanted))
    torch.testing.assert_close(some, (params[wanted], value[wanted]))


def test_no_state_is_the_beginning_of_an_episode() -> None:
    spec = recurrent(DISCRETE, "lstm")
    policy = NumpyPolicy(spec)
    policy.load(acting(random_net(spec)), np.zeros(0, np.float32))
    obs = [np.ones((1, 2, 4), np.float32)]
    np.testing.assert_array_equal(policy(obs), policy(obs, zero_state(spec, 1, 2)))
    assert (policy(obs) != policy(obs, zero_state(spec, 1, 2) + np.float32(1))).all()


# ------------------------------------------------------------------------------------------------ the lane carries it


def check_states(run: RunSpec, rollouts: list[Rollout]) -> None:
    """Act again on the observations: the state before each rollout, and the log-probabilities in it."""
    policy, state, acted = random_policy(run.policy), zero_state(run.policy, 1, run.copies), []
    for rollout in rollouts:
        np.testing.assert_array_equal(rollout.state, state[0])
        for t, valid in enumerate(rollout.valid):
            acted.append(policy([leaf[t][None] for leaf in rollout.obs], state)[0][valid])
            state[0, ~valid] = 0  # the row that resets: what comes is the first observation of an episode
    params = np.concatenate(acted)
    action, log_prob = (
        np.concatenate([getattr(rollout, name)[rollout.valid] for rollout in rollouts]) for name in ("action", "log_prob")
    )
    given = torch.tensor(params).double(), in_double(torch.tensor(action))
    (expected,) = sampled(lambda: [log_prob_and_entropy(run.policy.action, *given)[0]])
    expected.assert_is(log_prob, distribution(run.policy).log_prob(params, action))


@pytest.mark.parametrize("core", CORES)
@pytest.mark.parametrize("script", ["...t", "....u..b", "u", "..........................t"])
@pytest.mark.parametrize("T", [1, 2, 5])
def test_it_is_carried_from_rollout_to_rollout_and_begins_with_an_episode(core: Core, script: str, T: int) -> None:
    run = run_of(f"{TOY}Scripted-v0", T=T, N=2, kwargs={"script": script}, core=core, core_size=6)
    collector = random_collector(run)
    rollouts = [collect(collector, run, k)[0] for k in range(12 // T)]
    check_states(run, rollouts)
    assert (rollouts[0].state == 0).all()
    assert all((rollout.state != 0).all() for rollout in rollouts[1:]) or "t" in script[:12] or "u" in script
    (anew,) = collect(collector, run, incarnation=1)
    assert (anew.state == 0).all()


def test_a_state_that_does_not_fit_is_refused() -> None:
    run = run_of("CartPole-v1", T=2, N=3, core="gru", core_size=5)
    (good,) = collect(random_collector(run), run)
    for state, says in [
        (np.zeros((3, 4), np.float32), r"state: expected float32\[1, 3, 5\], got float32\[1, 3, 4\]"),
        (np.full((3, 5), np.nan, np.float32), "state: expected finite values, got nan at step 0, copy 0"),
    ]:
        with pytest.raises(BadRollout, match=says):
            validate(msgspec.structs.replace(good, state=state), run)


def test_rollouts_are_stacked_with_their_states() -> None:
    run = run_of("CartPole-v1", T=4, N=2, core="gru", core_size=3)
    collector = random_collector(run)
    collect(collector, run, 0, (0, 1))
    later = collect(collector, run, 1, (0, 1))
    rows = stack_rollouts(later[::-1])
    np.testing.assert_array_equal(rows.state, np.concatenate([rollout.state for rollout in later]))
    assert (rows.state != 0).all()


# ------------------------------------------------------------------------------------------------ learning with it


@pytest.mark.parametrize("core", CORES)
@pytest.mark.parametrize("spec", [DISCRETE, normal(GAUSSIAN), shared(DISCRETE)])
def test_a_policy_that_has_not_moved_has_ratio_one(core: Core, spec: PolicySpec) -> None:
    """The learner, over sequences, gives actions the probability that the worker gave them, step by step."""
    config = PPOConfig(n_epochs=1, batch_size=10_000)
    ppo = PPO(config, recurrent(spec, core), total_steps=1000, seed=0)
    metrics = ppo.update(batch(ppo, 0, fresh=True), no_pulse)
    assert abs(metrics["train/approx_kl"]) < ELEMENTWISE * UNIT  # (ρ − 1) − log ρ, where ρ is about 1 and rounded
    assert metrics["train/clip_fraction"] == 0


def _columns(minibatch: Minibatch) -> int:
    assert minibatch.recurrent is not None
    return len(minibatch.recurrent.initial_state)


@pytest.mark.parametrize("parts", [1, 2, 4, 50])
def test_a_minibatch_is_whole_columns_and_every_valid_row_is_in_one(parts: int) -> None:
    ppo = PPO(PPOConfig(), recurrent(DISCRETE, "gru"), total_steps=1000, seed=0)
    rows = batch(ppo, 0)
    count = np.arange(rows.valid.size, dtype=np.float32).reshape(rows.valid.shape)
    rows = msgspec.structs.replace(rows, state=np.repeat(np.arange(6, dtype=np.float32)[:, None], 8, 1))
    given = Minibatch.of(rows, ppo.observations(rows), count, count)
    found = list(given.shuffled(rows.valid, parts, ppo.generator))
    assert len(found) == min(parts, 6)
    assert sorted(torch.cat([each.target for each in found]).tolist()) == count[rows.valid].tolist()
    for each in found:
        assert each.recurrent is not None
        assert each.recurrent.output_rows is not None
        columns = each.recurrent.initial_state[:, 0].long()
        x = each.features.view(len(rows.valid), len(columns), 4)
        np.testing.assert_array_equal(x.numpy(), rows.obs[0][:-1][:, columns.numpy()])
        t, column = each.recurrent.output_rows // len(columns), columns[each.recurrent.output_rows % len(columns)]
        assert (each.target == (t * 6 + column).float()).all()  # each row is the one that the core is asked for
        expected = np.concatenate([np.ones((1, 6), bool), rows.valid[:-1]])[:, columns.numpy()]
        np.testing.assert_array_equal(each.recurrent.keep_state.numpy(), expected)


@pytest.mark.parametrize("name", ["ppo", "a2c", "impala"])
@pytest.mark.parametrize("core", CORES)
def test_what_a_copy_did_before_its_episode_changes_nothing(name: str, core: Core) -> None:
    """Two batches that differ in the rows before a reset give equal values, and log-probabilities, after it."""
    config = HYPERPARAMETERS[name]()
    algorithm: Any = algorithm_class(name)(config, recurrent(DISCRETE, core), total_steps=1000, seed=0)
    rows = batch(algorithm, 0)
    t, n = np.argwhere(~rows.valid)[0]
    other = batch(algorithm, 0)
    other.obs[0][: t + 1, n] += 1
    other.state[n] += 1
    values, others = (algorithm.values(algorithm.observations(each), no_pulse) for each in (rows, other))
    assert (values[: t + 1, n] != others[: t + 1, n]).any()
    np.testing.assert_array_equal(values[t + 1 :, n], others[t + 1 :, n])
    found, others = (log_probs(algorithm.net, algorithm.observations(each), each, no_pulse) for each in (rows, other))
    np.testing.assert_array_equal(found[t + 1 :, n], others[t + 1 :, n])
    np.testing.assert_array_equal(np.delete(found, n, 1), np.delete(others, n, 1))


def test_values_are_the_same_however_many_columns_are_evaluated_together(monkeypatch: pytest.MonkeyPatch) -> None:
    ppo = PPO(PPOConfig(), recurrent(DISCRETE, "lstm"), total_steps=1000, seed=0)
    rows = batch(ppo, 0)
    observations = ppo.observations(rows)
    whole = ppo.values(observations, no_pulse)
    monkeypatch.setattr("millrace.learner.algorithms.minibatches.CHUNK_ROWS", 45)
    assert observations.recurrent is not None
    exact, x, recurrent_input = in_float64(ppo.net), observations.features.double(), doubles(observations.recurrent)
    (expected,) = sampled(lambda: [exact.value(x, (), recurrent_input).view(whole.shape)])
    expected.assert_is(whole, ppo.values(observations, no_pulse))


SETTINGS: dict[str, dict[str, Any]] = {
    "ppo": {"learning_rate": 6e-3, "learning_rate_schedule": "linear", "batch_size": 256, "n_epochs": 4},
    "a2c": {"learning_rate": 2e-2, "optimizer": "adam", "vf_coef": 0.25},
    "impala": {"learning_rate": 2e-2, "optimizer": "adam", "vf_coef": 0.25},
}
"""With these, every seed of 0 to 3 gets more than 0.9 with either core, not the tested one alone."""


def learned(name: str, core: Core | None, updates: int) -> float:
    """The mean return of Recall's episodes in the last of these updates, and greedily: the lower of the two."""
    T, N, lanes = 16, 16, 2
    config = msgspec.convert({**SETTINGS[name], "core": core, "core_size": 16, "net": [16]}, HYPERPARAMETERS[name])
    run = run_of(f"{TOY}Recall-v0", T=T, N=N)
    spec = algorithm_class(name).policy_spec(config, run.policy.observation, run.policy.action)
    run = msgspec.structs.replace(run, policy=spec)
    algorithm = algorithm_class(name)(config, spec, total_steps=updates * T * N * lanes, seed=0)
    collector = Collector(run, make_policy(spec))
    for k in range(updates):
        collector.load(*algorithm.weights())
        rollouts = collector.collect([Permit(k, lane, 0, k, k) for lane in range(lanes)], k, 1, no_pulse)
        algorithm.update(stack_rollouts(rollouts), no_pulse)
    collector.lanes.close_all()
    policy = make_policy(spec)
    policy.load(*algorithm.weights())
    greedy = float(np.mean([episode.reward for episode in evaluated(run, policy, 60, seed=3)]))
    return min(greedy, float(np.mean([episode.reward for rollout in rollouts for episode in rollout.episodes])))


IN_MAKE_TEST = (("ppo", "gru"), ("impala", "lstm"))


@pytest.mark.parametrize(
    ("name", "core"),
    [
        pytest.param(name, core, marks=() if (name, core) in IN_MAKE_TEST else pytest.mark.rest)
        for name in SETTINGS
        for core in CORES
    ],
)
def test_what_was_shown_is_remembered(name: str, core: Core) -> None:
    assert learned(name, core, 40 if name == "ppo" else 60) > 0.9


def test_without_a_core_it_is_not() -> None:
    assert learned("ppo", None, 40) < 0.6


class Ragged(Scripted):
    """Episodes of any length up to 9: copies stop playing at different times."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        found = super().reset(seed=seed)
        self._script, self._played = "." * int(self.np_random.integers(9)) + "t", 0
        return found


class Watching:
    """A policy whose state counts the observations of an episode, as `Scripted` shows them."""

    def load(self, parameters: Array, buffers: Array) -> None: ...

    def __call__(self, leaves: Any, state: Array | None = None) -> Array:
        assert state is not None
        assert state.shape[:2] == leaves[0].shape[:2]
        np.testing.assert_array_equal(state[..., 0], leaves[0][..., 1])
        state += 1
        return np.zeros((*leaves[0].shape[:2], 2), np.float32)


def test_an_evaluation_begins_each_episode_without_memory() -> None:
    run = run_of(f"{TOY}Scripted-v0", core="gru")
    evaluator = Evaluator(msgspec.structs.replace(run, env=EnvSpec.of(Ragged)), Watching())
    orders = [example(Evaluate, session=1, ticket=seed, seeds=(seed,), greedy=True) for seed in range(50)]
    lengths = [evaluator.play(order, lambda rows: None, no_pulse).episodes[0].length for order in orders]
    assert len(set(lengths)) > 2
