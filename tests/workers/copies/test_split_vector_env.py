"""Lanes as parts of one vector environment: each gets, to the bit, what a loop over its own copies gives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest

from millrace.extras.datasets.episodes import EpisodeAssembler
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.protocol.arrays import Array
from millrace.protocol.envs.env_actions import action_converter_of
from millrace.protocol.errors import NoWorkers, WorkerLost
from millrace.protocol.messages import Permit
from millrace.protocol.policy.layout import acting_size, buffer_size
from millrace.protocol.policy.torch_policy import TorchPolicy
from millrace.protocol.specs import RunSpec
from millrace.protocol.wire.plain_values import pack
from millrace.workers.collect.collector import Collector
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.split_vector_env import SplitVectorEnv
from tests.support.in_process.any_order import any_order
from tests.support.in_process.collectors import TOY, bits, collect, no_pulse, random_collector, random_policy, run_of
from tests.support.in_process.infos_by_row import InfosByRow, split_in_one_part

LANES = 3
RUNS = {
    "discrete": run_of("CartPole-v1", T=40),
    "gaussian": run_of("Pendulum-v1", kwargs={"max_episode_steps": 30}, T=40),
    "lstm": run_of("CartPole-v1", T=40, core="lstm", core_size=9),
    "table": run_of(f"{TOY}Spaces-v0", kwargs={"observation": "dict", "action": "table"}, normalize_observations=True),
    "offset": run_of(f"{TOY}Spaces-v0", kwargs={"observation": "multidiscrete", "action": "offset"}),
}


@contextmanager
def split_collector(run: RunSpec) -> Iterator[Collector]:
    env = InfosByRow([run.env.make] * (LANES * run.copies))
    env.reset()  # SyncVectorEnv, unlike ZmqVectorEnv, takes a mask only after a first reset
    split = split_in_one_part(env, run)
    yield Collector(run, random_policy(run.policy), split.open_lane, split)
    env.close()


@pytest.mark.parametrize("name", RUNS)
def test_a_lane_gets_the_bits_of_a_loop_over_its_copies(name: str) -> None:
    run = RUNS[name]
    loop = random_collector(run)
    with split_collector(run) as split:
        for k in range(4):
            actual, expected = (collect(collector, run, k, lanes=range(LANES)) for collector in (split, loop))
            assert [bits(one) for one in actual] == [bits(other) for other in expected]
            assert k or len({one.obs[0].tobytes() for one in actual}) == LANES, "the lanes are the same"


def test_a_lane_of_a_new_incarnation_starts_anew_and_the_others_go_on() -> None:
    run = RUNS["discrete"]
    loop = random_collector(run)
    permits = [Permit(n, n, 1 if n == 1 else 0, 0 if n == 1 else 1, 1) for n in range(LANES)]
    with split_collector(run) as split:
        found = []
        for collector in (split, loop):
            collect(collector, run, 0, lanes=range(LANES))
            found.append([bits(rollout) for rollout in collector.collect(permits, 0, 0, no_pulse)])
    assert found[0] == found[1]


def test_lanes_are_collected_in_any_order_but_only_all_together() -> None:
    run = RUNS["discrete"]
    loop = random_collector(run)
    with split_collector(run) as split:
        actual, expected = (collect(collector, run, lanes=(2, 0, 1)) for collector in (split, loop))
        assert [bits(one) for one in actual] == [bits(other) for other in expected]
        with pytest.raises(ValueError, match=r"expected all lanes of one part, got \[0, 2\]"):
            collect(split, run, 1, lanes=(0, 2))


class LosesTwoCopies(InfosByRow):
    """Loses the first two copies in its step number `at`, as a vector environment over worker processes would."""

    def __init__(self, makes: Any, at: int) -> None:
        super().__init__(makes)
        self.at, self.made = at, 0

    def step(self, actions: Any) -> Any:
        self.made += 1
        if self.made - 1 != self.at:
            return super().step(actions)
        before = np.array(self._observations)
        obs, reward, terminated, truncated, _ = super().step(actions)
        lost = np.arange(self.num_envs) < 2
        obs[lost], reward[lost], terminated[lost], truncated[lost] = before[lost], 0.0, False, True
        self._autoreset_envs = terminated | truncated
        self.infos_by_row = {n: {"worker_lost": True} for n in range(2)}
        return obs, reward, terminated, truncated, {}


@pytest.mark.parametrize("at", range(9))
def test_a_lost_step_is_in_no_valid_row(at: int) -> None:
    """Within an episode, at its end (5 steps) or its reset, in the first row or the last row of a rollout (3 rows)."""
    run = run_of(f"{TOY}Countdown-v0", T=3)
    env = LosesTwoCopies([run.env.make] * (LANES * run.copies), at)
    env.reset()
    split = split_in_one_part(env, run)
    collector = Collector(run, random_policy(run.policy), split.open_lane, split)
    by_lane = zip(*(collect(collector, run, k, lanes=range(LANES)) for k in range(4)), strict=True)
    assembler = EpisodeAssembler(lambda actions: (actions,))
    whole = []
    for lane, rollouts in enumerate(by_lane):
        valid = np.concatenate([rollout.valid for rollout in rollouts])  # [12, N]
        left = np.concatenate([rollout.obs[0][:-1, :, 0] for rollout in rollouts])  # [12, N] of 1.0, in fifths
        reward = np.concatenate([rollout.reward for rollout in rollouts])
        assert valid[at].any() == (lane > 0 and at != 5), "row 5 is every other copy's reset"
        np.testing.assert_array_equal(reward, valid)
        np.testing.assert_allclose(np.diff(left, axis=0)[valid[:-1] & valid[1:]], -0.2, atol=1e-6)
        assert (left[1:][~valid[:-1] & valid[1:]] == 1.0).all(), "an episode began amid another"
        whole += [episode for rollout in rollouts for episode in assembler.add(rollout, 0, fresh=rollout.sequence == 0)]
    assert {episode.length for episode in whole if episode.terminated[-1]} == {5}
    cut = [episode.length for episode in whole if episode.truncated[-1]]
    assert cut == [] if at in (0, 3, 5, 6) else cut == [at if at < 5 else at - 6] * 2
    assert assembler.left_out == (6 if at == 3 else 0), "three steps of two copies, delivered before the loss"
    assert collector.steps == assembler.waiting + assembler.left_out + sum(episode.length for episode in whole)
    env.close()


@pytest.mark.parametrize(
    "policy",
    [
        {"kwargs": {"observation": "image", "action": "table"}},
        {"kwargs": {"observation": "image"}, "core": "gru", "core_size": 5},
        {"kwargs": {"observation": "image"}, "head": "q"},
        {"kwargs": {"observation": "dict", "action": "box"}, "normalize_observations": True},
    ],
)
def test_one_forward_pass_for_all_lanes_equals_one_pass_for_each_lane(policy: dict[str, Any]) -> None:
    spec = run_of(f"{TOY}Spaces-v0", **policy).policy
    generator = np.random.default_rng(0)
    parameters = generator.normal(0, 0.3, acting_size(spec)).astype(np.float32)
    buffers = generator.uniform(0.5, 1.5, buffer_size(spec)).astype(np.float32)
    leaves = [generator.integers(0, 2, (LANES, 4, *leaf.shape)).astype(leaf.dtype) for leaf in spec.observation]
    for array, leaf in zip(leaves, spec.observation, strict=True):
        array += np.reshape(leaf.start, leaf.shape).astype(leaf.dtype) if leaf.start else 0
    results = []
    for together in (True, False):
        acting = TorchPolicy(spec, together=together)
        acting.load(parameters, buffers)
        state = np.full((LANES, 4, spec.state_size), 0.25, np.float32)
        results.append((acting(leaves, state), state))
    (one, after_one), (each, after_each) = results
    assert one.shape == each.shape
    np.testing.assert_allclose(one, each, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(after_one, after_each, rtol=1e-4, atol=1e-5)
    assert not spec.state_size or (after_one != 0.25).any()


class Watched:
    """Each lane steps its own copies, in these parts, and this notes when which of them begin and end."""

    def __init__(self, *parts: slice) -> None:
        self._parts = parts
        self.seen: list[str] = []

    def parts(self, lanes: int) -> Sequence[slice]:
        return self._parts

    def begin(self, lanes: Sequence[int], actions: Array, pulse: Pulse) -> None:
        self.seen.append(f"begin {[*lanes]} {actions.shape}")

    def end(self, lanes: Sequence[int], pulse: Pulse) -> None:
        self.seen.append(f"end {[*lanes]}")


def test_the_policy_acts_for_one_part_while_the_other_steps() -> None:
    run = msgspec.structs.replace(RUNS["discrete"], rollout_steps=2)
    watched = Watched(slice(0, 1), slice(1, 3))
    collect(Collector(run, random_policy(run.policy), together=watched), run, lanes=(4, 1, 2))
    assert watched.seen == [
        "begin [4] (1, 2)",
        "begin [1, 2] (2, 2)",
        "end [4]",
        "begin [4] (1, 2)",
        "end [1, 2]",
        "begin [1, 2] (2, 2)",
        "end [4]",
        "end [1, 2]",
    ]


@pytest.mark.parametrize("ends", [(3,), (2, 3), (1, 2, 3)])
def test_the_number_of_parts_changes_no_bit(ends: Sequence[int]) -> None:
    run = RUNS["lstm"]
    alone = random_collector(run)
    collector = Collector(run, random_policy(run.policy), together=Watched(*(slice(*each) for each in pairwise((0, *ends)))))
    for k in range(3):
        actual, expected = (collect(one, run, k, lanes=range(LANES)) for one in (collector, alone))
        assert [bits(one) for one in actual] == [bits(other) for other in expected]


def test_a_dropped_rollout_abandons_the_steps_under_way() -> None:
    run = RUNS["discrete"]
    abandoned = []

    class Abandons(InfosByRow):
        def end_step(self, lanes: Sequence[int]) -> Any:
            raise NoWorkers("none")

        def abandon(self) -> None:
            abandoned.append(True)

    env = Abandons([run.env.make] * (LANES * run.copies))
    env.reset()
    split = SplitVectorEnv(env, run)
    with pytest.raises(NoWorkers):
        collect(Collector(run, random_policy(run.policy), split.open_lane, split), run, lanes=range(LANES))
    assert abandoned
    env.close()


@pytest.mark.parametrize("shared", [True, False], ids=["shared memory", "messages"])
def test_replacements_of_lost_copies_get_the_attributes_when_their_part_is_stepped(shared: bool) -> None:
    """A part may still step when copies of another part are lost."""
    run = run_of(f"{TOY}Informs-v0", N=1)
    with any_order(VectorEnvSettings(f"{TOY}Informs-v0", LANES, lanes=LANES), LANES, shared=shared) as (env, link):
        split = SplitVectorEnv(env, run)
        for n in range(LANES):
            lane = split.open_lane(run, n, no_pulse)
            lane.reset([n], no_pulse)
            lane.assign("level", pack(5), no_pulse)
        chosen = np.zeros((LANES, 1, *run.policy.action.shape), run.policy.action.stored_dtype)
        actions = action_converter_of(run.policy)(chosen)
        split.begin([0], actions[:1], no_pulse)
        split.begin([1, 2], actions[1:], no_pulse)
        link.frozen = {"w0"}
        link.leave("w0")
        split.end([0], no_pulse)
        assert split.result(slice(0, 1)).truncated.all()
        split.begin([0], actions[:1], no_pulse)
        split.end([1, 2], no_pulse)
        split.end([0], no_pulse)
        assert env.get_attr("level") == (5,) * LANES


class Leveled(gymnasium.Env[Any, Any]):
    """Shows its level at the reset, which then rises by one."""

    observation_space = gymnasium.spaces.Box(-9, 9, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)
    level = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._shown = np.full(1, self.level, np.float32)
        self.level += 1
        return self._shown, {}

    def step(self, action: Any) -> Any:
        return self._shown, 1.0, False, False, {}


gymnasium.register("LeveledLane-v0", f"{__name__}:Leveled", disable_env_checker=True)


@pytest.mark.parametrize("lost", ["before", "noticed before", "during"])
@pytest.mark.parametrize("shared", [True, False], ids=["shared memory", "messages"])
def test_copies_that_replace_lost_ones_in_a_reset_get_the_attributes_before_it(lost: str, shared: bool) -> None:
    """And attributes that an environment has changed are not set again on copies that were not lost."""
    name = f"{__name__}:LeveledLane-v0"
    run = run_of(name, N=2)
    with any_order(VectorEnvSettings(name, 2 * LANES, lanes=LANES), LANES, shared=shared) as (env, link):
        split = SplitVectorEnv(env, run)
        lanes = [split.open_lane(run, n, no_pulse) for n in range(LANES)]
        for lane in lanes:
            lane.assign("level", pack(5), no_pulse)
        seen = [lane.reset([0, 1], no_pulse) for lane in lanes[:-1]]
        if lost == "during":
            link.frozen = {"w2"}
            leave = iter([lambda: link.leave("w2")])
            env.hub.while_waiting = lambda: next(leave, lambda: None)()
        else:
            link.leave("w2")
        if lost == "noticed before":
            env.hub.listen()
        seen.append(lanes[-1].reset([0, 1], no_pulse))
        assert [[leaf.tolist() for leaf in leaves] for leaves in seen] == [[[[5.0]] * 2]] * LANES
        assert env.get_attr("level") == (6,) * 2 * LANES
        split.begin([0], np.zeros((1, 2), np.int64), no_pulse)
        split.begin([1, 2], np.zeros((2, 2), np.int64), no_pulse)
        split.end([0], no_pulse)
        split.end([1, 2], no_pulse)
        assert split.result(slice(0, 2 * LANES)).reward.tolist() == [1.0] * 2 * LANES
        assert env.get_attr("level") == (6,) * 2 * LANES


def test_no_episode_begins_in_copies_without_their_attributes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of the three resets loses a worker, after the attributes were set."""
    name = f"{__name__}:LeveledLane-v0"
    run = run_of(name, N=2)
    with any_order(VectorEnvSettings(name, 2, lanes=1), 4, shared=False) as (env, link):
        lane = SplitVectorEnv(env, run).open_lane(run, 0, no_pulse)
        lane.assign("level", pack(5), no_pulse)
        reset = env.reset

        def loses_a_worker(**given: Any) -> Any:
            results = reset(**given)
            owner = env.hub.coordinator.owner(0)
            assert owner is not None
            link.leave(owner.hello.worker)
            env.hub.listen()
            return results

        with monkeypatch.context() as patched, pytest.raises(WorkerLost) as caught:
            patched.setattr(env, "reset", loses_a_worker)
            lane.reset([0, 1], no_pulse)
        assert str(caught.value) == "copies 0 to 1: each of 3 resets lost a worker, so new copies lack the attribute level"
        assert [leaf.tolist() for leaf in lane.reset([0, 1], no_pulse)] == [[[5.0]] * 2]
