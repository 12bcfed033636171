"""Facts of episodes: what a worker takes from `info`, for a loop over copies and for a vector environment."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

from millrace.extras.envs.vector_copies import VectorCopies
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.protocol.errors import EnvironmentFailed
from millrace.protocol.messages import Evaluate
from millrace.protocol.rollout import Rollout
from millrace.protocol.rows.rollout_checks import validate
from millrace.protocol.specs import RunSpec
from millrace.workers.collect.collector import Collector
from millrace.workers.copies.env_errors import CopyFailed
from millrace.workers.copies.episode_facts import facts_of_copies, facts_of_info
from millrace.workers.copies.split_vector_env import SplitVectorEnv
from millrace.workers.evaluate.evaluator import Evaluator
from tests.support.conversation.example_messages import example
from tests.support.in_process.any_order import any_order
from tests.support.in_process.collectors import (
    collect,
    no_pulse,
    random_collector,
    random_policy,
    run_of,
)
from tests.support.in_process.infos_by_row import InfosByRow, split_in_one_part
from tests.support.users_code.fact_envs import Facts

NAMES = ("is_success", "distance", "speed")
FACTS = "tests.support.users_code.fact_envs:Facts-v0"
RUN = msgspec.structs.replace(run_of(FACTS, T=50, N=3), info_keys=NAMES)


def evaluate_order(run: RunSpec, episodes: int) -> Evaluate:
    return example(Evaluate, session=1, ticket=1, seeds=tuple(range(episodes)), greedy=True, most_steps=1000)


def facts(rollout: Rollout) -> list[tuple[float, ...]]:
    return [episode.facts for episode in rollout.episodes]


def expected_of(episode: int) -> tuple[float, float, float]:
    return float(episode % 2 == 0), float(episode) if episode % 3 else math.nan, math.nan


def same(one: Any, other: Any) -> bool:
    return np.array_equal(one, other, equal_nan=True)


def test_each_episode_has_the_facts_of_its_last_step() -> None:
    (rollout,) = collect(random_collector(RUN), RUN)
    validate(rollout, RUN)
    episodes = len(rollout.episodes) // 3  # of each copy
    assert episodes > 6
    assert same(facts(rollout), [expected_of(n) for n in range(episodes) for _ in range(3)])


def test_facts_of_an_episode_that_began_in_an_earlier_rollout() -> None:
    run = msgspec.structs.replace(RUN, rollout_steps=2)
    collector = random_collector(run)
    found = [row for k in range(25) for row in facts(collect(collector, run, k)[0])]
    (whole,) = collect(random_collector(RUN), RUN)
    assert same(found, facts(whole))


def test_without_names_there_are_none() -> None:
    run = msgspec.structs.replace(RUN, info_keys=())
    (rollout,) = collect(random_collector(run), run)
    assert set(facts(rollout)) == {()}


def test_a_vector_environment_gives_the_facts_of_the_loop() -> None:
    collector = random_collector(
        RUN, lambda run, lane, pulse: VectorCopies(SyncVectorEnv([Facts] * run.copies), run.info_keys)
    )
    (rollout,), (loop,) = collect(collector, RUN), collect(random_collector(RUN), RUN)
    assert same(facts(rollout), facts(loop))


def test_a_split_vector_environment_gives_the_facts_of_the_loop() -> None:
    env = InfosByRow([RUN.env.make] * 6)
    env.reset()
    split = split_in_one_part(env, RUN)
    collector = Collector(RUN, random_policy(RUN.policy), split.open_lane, split)
    for one, other in zip(
        collect(collector, RUN, lanes=range(2)), collect(random_collector(RUN), RUN, lanes=range(2)), strict=True
    ):
        assert same(facts(one), facts(other))
    env.close()


def test_facts_of_a_vector_environment_do_not_depend_on_the_infos_of_other_copies() -> None:
    name = "tests.support.users_code.fact_envs:Unlike-v0"
    run = msgspec.structs.replace(run_of(name, T=20), info_keys=("score",))
    expected = [facts(rollout) for rollout in collect(random_collector(run), run, lanes=range(2))]
    with any_order(VectorEnvSettings(name, 4, lanes=2), 2, shared=True) as (env, _):
        split = SplitVectorEnv(env, run)
        collector = Collector(run, random_policy(run.policy), split.open_lane, split)
        assert [facts(rollout) for rollout in collect(collector, run, lanes=range(2))] == expected
    assert expected[0][0] == (3.75,), "not rounded to the dtype of the 0 in other infos"


def test_evaluation_episodes_have_facts_too() -> None:
    run = msgspec.structs.replace(RUN, info_keys=("is_success", "speed"))
    evaluator = Evaluator(run, random_policy(run.policy))
    answer = evaluator.play(evaluate_order(run, 4), lambda rows: None, no_pulse)
    assert same([episode.facts for episode in answer.episodes], [(1.0, math.nan)] * 4)
    cut = evaluator.play(msgspec.structs.replace(evaluate_order(run, 4), most_steps=2), lambda rows: None, no_pulse)
    assert same([episode.facts for episode in cut.episodes], [(math.nan, math.nan)] * 4), "of an episode that was cut"


@pytest.mark.parametrize("vector", [False, True])
def test_what_is_no_number_names_the_key(vector: bool) -> None:
    run = msgspec.structs.replace(run_of(FACTS, kwargs={"text": True}), info_keys=("name",))
    copies = (lambda run, lane, pulse: VectorCopies(SyncVectorEnv([run.env.make] * 2), run.info_keys)) if vector else None
    collector = random_collector(run, copies) if copies else random_collector(run)
    expected = r"^lane 0, copy [01], step 2: info name: expected a number, got \w+ '?north'?; name only numbers"
    with pytest.raises(EnvironmentFailed, match=expected.replace("north'?", "north.*")):
        collect(collector, run)


def test_an_evaluation_names_the_key_too() -> None:
    run = msgspec.structs.replace(run_of(FACTS, kwargs={"text": True}), info_keys=("name",))
    evaluator = Evaluator(run, random_policy(run.policy))
    with pytest.raises(EnvironmentFailed, match=r"copy 0, step 2: info name: expected a number, got str 'north'"):
        evaluator.play(evaluate_order(run, 2), lambda rows: None, no_pulse)


@pytest.mark.parametrize(
    ("value", "number"),
    [
        (True, 1.0), (3, 3.0), (np.float16(0.5), 0.5), (np.array([2]), 2.0), (np.bool_(False), 0.0),
        (math.inf, math.nan), (math.nan, math.nan), (None, math.nan), (10**400, math.nan),
    ],
)  # fmt: skip
def test_values_that_count_and_values_that_are_missing(value: Any, number: float) -> None:
    assert same(facts_of_info(["a"], {"a": value}), (number,))


@pytest.mark.parametrize("value", ["1", b"1", [], [1, 2], {}, np.ones(2), [[1], [2, 3]], 1j])
def test_values_that_are_refused(value: Any) -> None:
    with pytest.raises(CopyFailed) as caught:
        facts_of_info(["a"], {"a": value}, 1)
    assert caught.value.line.startswith("info a: expected a number, got ")


def test_the_infos_of_copies() -> None:
    infos = {"a": np.array([1.0, 2.0]), "_a": np.array([True, False]), "b": np.array([3, 4]), "_c": np.ones(2, bool)}
    assert same(facts_of_copies(["a", "b", "c"], infos, 2), [[1.0, 3.0, math.nan], [math.nan, 4.0, math.nan]])
    with pytest.raises(CopyFailed) as caught:
        facts_of_copies(["a"], {"a": np.ones(3)}, 2)
    assert caught.value.line.startswith("info a: expected a number for each of 2 copies, got ndarray")


def test_gymnasium_s_environments_have_what_is_tested() -> None:
    assert isinstance(gymnasium.make(FACTS).unwrapped, Facts)
