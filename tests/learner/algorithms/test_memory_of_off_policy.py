"""Recurrent DQN and SAC: what the core of the learner sees, who trains it, and what is learned by it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import msgspec
import numpy as np
import pytest
import torch

from millrace.learner.algorithms import algorithm_class
from millrace.learner.algorithms.replay.sequence_replay import SequenceSample
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.learner.config.layers import resolve
from millrace.protocol.errors import UsageError
from millrace.protocol.messages import Permit
from millrace.protocol.policy.encoder import RecurrentInput
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.rollout import Batch, stack_rollouts
from millrace.workers.collect.collector import Collector
from tests.support.in_process.collectors import TOY, run_of
from tests.support.numbers.batches import DISCRETE, GAUSSIAN, IMAGE, batch, no_pulse
from tests.support.numbers.rounding import assert_within, in_float64, sampled

Core = Literal["lstm", "gru"]
T = 6
SETTINGS: dict[str, Any] = {"core_size": 8, "net": (16,), "batch_size": 48, "learning_starts": 0, "rollout_steps": T}
CRITICS_TRAIN = ("sac", "td3", "tqc", "crossq", "xqc")
SMALL: dict[str, dict[str, Any]] = {"crossq": {"critic_net": (12,)}, "xqc": {"critic_net": (12,), "atoms": 11}}


def made(algo: str, core: Core = "gru", **settings: Any) -> Any:
    given = SETTINGS | {"core": core} | SMALL.get(algo, {}) | settings
    config = msgspec.convert(given, HYPERPARAMETERS[algo])
    spaces = DISCRETE if algo == "dqn" else GAUSSIAN
    spec = algorithm_class(algo).policy_spec(config, spaces.observation, spaces.action)
    return algorithm_class(algo)(config, spec, total_steps=1000, seed=0)


def continued(algorithm: Any, rollouts: int = 3) -> list[Batch]:
    """Batches whose rollouts follow each other, with the states that the algorithm's first weights have between them."""
    batches: list[Batch] = []
    state = np.zeros((6, algorithm.policy.state_size), np.float32)
    for number in range(rollouts):
        rows = batch(algorithm, number, fresh=number == 0, steps=T)
        if batches:
            for leaf, before in zip(rows.obs, batches[-1].obs, strict=True):
                leaf[0] = before[-1]
            rows.valid[0] = ~(batches[-1].terminated | batches[-1].truncated)[-1]
            for flags in (rows.terminated, rows.truncated):
                flags[0] &= rows.valid[0]
            rows.valid[1] = ~(rows.terminated | rows.truncated)[0]
            for flags in (rows.terminated, rows.truncated):
                flags[1] &= rows.valid[1]
        for t in range(1, T):
            rows.valid[t] = ~(rows.terminated | rows.truncated)[t - 1]
            for flags in (rows.terminated, rows.truncated):
                flags[t] &= rows.valid[t]
        rows.state[...] = state
        states, _ = unrolled(algorithm.net.encode, algorithm, [rows], state)
        state = states[-1] * rows.valid[-1][:, None]
        batches.append(rows)
    return batches


def unrolled(encode: Any, algorithm: Any, batches: Sequence[Batch], state: Any) -> tuple[list[Any], list[Any]]:
    """The states after each row, and the outputs at each observation [N, H], one step after the other."""
    states: list[Any] = []
    outputs: list[Any] = []
    now = torch.as_tensor(state, dtype=algorithm.net.flat.dtype)
    with torch.no_grad():
        for rows in batches:
            for t in range(T):
                x, images = algorithm.inputs([leaf[t] for leaf in rows.obs])
                h, after = encode.advance(x, images, RecurrentInput(now, torch.ones(1, len(x))))
                outputs.append(h.numpy())
                states.append(after.numpy())
                now = after * torch.as_tensor(rows.valid[t][:, None])
    return states, outputs


@pytest.mark.parametrize("core", ["lstm", "gru"])
@pytest.mark.parametrize("algo", ["dqn", "sac"])
def test_with_unchanged_weights_the_core_remembers_the_whole_episode(algo: str, core: Core) -> None:
    """Stored state, burn-in and sequence give what one pass over all steps since the run began gives."""
    algorithm = made(algo, core)
    batches = continued(algorithm)
    for rows in batches:
        algorithm.replay.add(rows)
    _, outputs = unrolled(algorithm.net.encode, algorithm, batches, np.zeros_like(batches[0].state))
    every = np.stack(outputs)  # [3 T, N, H]
    seen = np.concatenate([rows.obs[0][:-1] for rows in batches])
    sample = algorithm.replay.sample(60 * T)
    found = algorithm.transitions(sample)
    observed = sample.leaves[0][T:-1].reshape(-1, 4)[sample.rows]
    at = [tuple(np.argwhere((seen == each).all(-1))[0]) for each in observed]
    expected = np.stack([every[where] for where in at])
    (allowed,) = tolerances(algorithm, sample)
    assert_within(found.x.detach().numpy(), expected, 2 * allowed)
    assert len({t // T for t, _ in at}) == 3


def tolerances(algorithm: Any, sample: SequenceSample) -> list[Any]:
    """How far float32 may be off in the outputs of the core at the rows of a sample."""
    rows = raw(algorithm, sample)
    sequences = rows.sequences
    assert sequences is not None
    exact = in_float64(algorithm.net)

    def double(given: RecurrentInput) -> RecurrentInput:
        return given._replace(initial_state=given.initial_state.double(), keep_state=given.keep_state.double())

    wide = sequences._replace(before=double(sequences.before), keep_state=sequences.keep_state.double())
    (found,) = sampled(lambda: [wide.outputs(exact.encode, rows.x.double(), ())[sequences.rows]])
    return [found.tolerance]


@pytest.mark.parametrize("algo", ["dqn", "sac"])
def test_with_new_weights_the_core_warms_up_in_the_sequence_before(algo: str) -> None:
    algorithm = made(algo)
    batches = continued(algorithm)
    for rows in batches:
        algorithm.replay.add(rows)
    algorithm.net.flat.mul_(1.5)
    sample = algorithm.replay.sample(60 * T)
    found = algorithm.transitions(sample).x.detach().numpy()
    first = int(np.argmax(sample.advances[:T].any(0)))  # a column with a sequence before it
    state = torch.from_numpy(sample.state[first : first + 1])
    leaves = [leaf[:, first : first + 1] for leaf in sample.leaves]
    outputs = []
    for t in range(2 * T + 1):
        x, images = algorithm.inputs([leaf[t] for leaf in leaves])
        state = state * float(sample.keep_state[t, first])
        h, after = algorithm.net.encode.advance(x, images, RecurrentInput(state, torch.ones(1, 1)))
        state = after if sample.advances[t, first] else state
        outputs.append(h.detach().numpy()[0])
    columns = sample.keep_state.shape[1]
    (allowed,) = tolerances(algorithm, sample)
    compared = 0
    for i, row in enumerate(sample.rows):
        if row % columns == first:
            assert_within(found[i], outputs[T + row // columns], 2 * allowed[i])
            compared += 1
    assert compared


def raw(algorithm: Any, sample: SequenceSample) -> Transitions:
    rows: Transitions = algorithm._of_sequences(sample)
    return rows


@pytest.mark.parametrize("algo", ["dqn", "sac"])
def test_no_gradient_passes_the_sequence_before(algo: str) -> None:
    algorithm = made(algo)
    for rows in continued(algorithm):
        algorithm.replay.add(rows)
    given = raw(algorithm, algorithm.replay.sample(60 * T))
    assert given.sequences is not None
    x = given.x.clone().requires_grad_()
    given.sequences.outputs(algorithm.net.encode, x, ()).square().sum().backward()  # type: ignore[no-untyped-call]
    assert x.grad is not None
    by_step = x.grad.view(2 * T + 1, -1).abs().sum(1)
    assert (by_step[:T] == 0).all()
    assert (by_step[T:] > 0).all()


def test_the_target_network_of_dqn_has_a_core_of_its_own() -> None:
    algorithm = made("dqn")
    for rows in continued(algorithm):
        algorithm.replay.add(rows)
    sample = algorithm.replay.sample(60 * T)
    before = algorithm.transitions(sample)
    assert torch.equal(before.next_x, before.target_x)
    algorithm.target.flat.mul_(1.5)
    after = algorithm.transitions(sample)
    assert torch.equal(before.next_x, after.next_x)
    assert not torch.equal(before.target_x, after.target_x)


@pytest.mark.parametrize("algo", CRITICS_TRAIN)
def test_the_critics_train_the_core_and_the_actor_does_not(algo: str) -> None:
    algorithm = made(algo)
    for rows in continued(algorithm):
        algorithm.replay.add(rows)
    algorithm.set_schedules()
    given = algorithm.transitions(algorithm.replay.sample(60 * T))
    algorithm.net.flat_grad.zero_()
    algorithm.critic_loss(given).loss.backward()
    of_core = algorithm.net.flat_grad[len(algorithm.net.actor) :][: core_size_of(algorithm)]
    assert of_core.abs().sum() > 0
    assert not given.next_x.requires_grad
    algorithm.net.flat_grad.zero_()
    loss = algorithm.actor_loss(given.x.detach())
    (loss if algo == "td3" else loss[0]).backward()
    assert of_core.abs().sum() == 0
    assert algorithm.net.actor.grad.abs().sum() > 0


def core_size_of(algorithm: Any) -> int:
    """The number of parameters of the core: a GRU of 8 units on 4 features."""
    assert (algorithm.policy.core, algorithm.policy.core_size) == ("gru", 8)
    return 3 * 8 * (4 + 8) + 2 * 3 * 8


def learned(core: Core | None, updates: int) -> tuple[float, list[float]]:
    """Of Recall: the greedy mean return, and the highest value at each step of an episode, averaged over episodes."""
    steps, copies = 16, 16
    settings: dict[str, Any] = {
        "core": core,
        "core_size": 16,
        "net": (16,),
        "gamma": GAMMA,
        "rollout_steps": steps,
        "learning_rate": 4e-3,
        "batch_size": 256,
        "learning_starts": 500,
        "gradient_steps": 32,
        "target_every": 50,
        "epsilon_steps": 4000,
        "replay_size": 10_000,
    }
    config = msgspec.convert(settings, HYPERPARAMETERS["dqn"])
    run = run_of(f"{TOY}Recall-v0", T=steps, N=copies)
    spec = algorithm_class("dqn").policy_spec(config, run.policy.observation, run.policy.action)
    run = msgspec.structs.replace(run, policy=spec)
    algorithm: Any = algorithm_class("dqn")(config, spec, total_steps=updates * steps * copies, seed=0)
    collector = Collector(run, make_policy(spec))
    for k in range(updates):
        collector.load(*algorithm.weights())
        rollouts = collector.collect([Permit(k, 0, 0, k, k)], k, 1, no_pulse)
        algorithm.update(stack_rollouts(rollouts), no_pulse)
    collector.lanes.close_all()
    policy = make_policy(spec)
    policy.load(*algorithm.weights())
    state = np.zeros((1, 3, spec.state_size), np.float32)
    shown = [np.eye(3, dtype=np.float32), *[np.zeros((3, 3), np.float32)] * 3]
    values = [policy([obs[None]], state)[0][:, :3] for obs in shown]  # behind them stands ε
    right = float((values[-1].argmax(1) == np.arange(3)).mean())
    return right, [float(each.max(1).mean()) for each in values]


GAMMA = 0.9


@pytest.mark.rest
def test_dqn_remembers_what_was_shown_and_knows_what_that_is_worth() -> None:
    """The action that gets 1 comes three steps later: the values are γ³, γ², γ and 1."""
    right, values = learned("gru", 60)
    assert right == 1
    np.testing.assert_allclose(values, [GAMMA**3, GAMMA**2, GAMMA, 1], atol=0.1)


@pytest.mark.rest
def test_without_a_core_dqn_does_not() -> None:
    right, _ = learned(None, 60)
    assert right <= 1 / 3


def test_hindsight_has_no_memory() -> None:
    config = msgspec.convert(SETTINGS | {"core": "gru", "hindsight": 0.8}, HYPERPARAMETERS["dqn"])
    with pytest.raises(UsageError, match=r"hindsight 0\.8: expected core none"):
        algorithm_class("dqn").policy_spec(config, DISCRETE.observation, DISCRETE.action)


def test_rainbow_has_no_memory_and_says_so_before_workers_start() -> None:
    with pytest.raises(UsageError, match="core: rainbow has no memory: expected none, got gru; take --algo dqn"):
        resolve("CartPole-v1", algo="rainbow", core="gru")


def test_images_pass_the_core_too() -> None:
    algorithm = made("sac")
    policy = algorithm.policy_spec(algorithm.config, IMAGE.observation, GAUSSIAN.action)
    algorithm = type(algorithm)(algorithm.config, policy, total_steps=1000, seed=0)
    batches = [batch(algorithm, number, fresh=number == 0, steps=T) for number in range(3)]
    before = algorithm.weights()[0]
    for rows in batches:
        algorithm.update(rows, no_pulse)
    assert not np.array_equal(before, algorithm.weights()[0])
    acting = make_policy(algorithm.policy)
    acting.load(*algorithm.weights())
    state = np.zeros((1, 6, algorithm.policy.state_size), np.float32)
    acting([leaf[:1] for leaf in batches[0].obs], state)
    assert (state != 0).any()
