"""Action masks in workers: no illegal action, the mask of each row, and one line for a mask that is wrong."""

from __future__ import annotations

import re
from typing import Any

import msgspec
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

from millrace.extras.envs.vector_copies import VectorCopies
from millrace.learner.env_spaces import EnvSpaces
from millrace.protocol.arrays import Array, Bools
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.action_masks import has_mask, without_mask
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import BadRollout, EnvironmentFailed, UsageError
from millrace.protocol.messages import Evaluate
from millrace.protocol.rollout import Rollout, stack_rollouts
from millrace.protocol.rows.rollout_checks import validate
from millrace.protocol.specs import PolicySpec, RunSpec
from millrace.workers.collect.collector import Collector, OpenEnvCopies
from millrace.workers.copies.env_errors import CopyFailed
from millrace.workers.copies.split_vector_env import SplitVectorEnv
from millrace.workers.evaluate.evaluator import Evaluator
from tests.support.conversation.example_messages import example
from tests.support.in_process.collectors import collect, no_pulse, random_collector, random_policy
from tests.support.in_process.infos_by_row import InfosByRow, split_in_one_part
from tests.support.users_code.mask_envs import SIZES, InInfo, InObservation, Mixed, Parts

ENVS: dict[str, Any] = {"InInfo": InInfo, "Parts": Parts, "Mixed": Mixed, "InObservation": InObservation}


def masked_run(name: str, T: int = 40, N: int = 3, fault: str = "", **policy: Any) -> RunSpec:
    """A run with masks on one of the environments."""
    env = ENVS[name]
    spec = EnvSpec.of(f"tests.support.users_code.mask_envs:{name}-v0", {"fault": fault})
    observation = observation_leaves(without_mask(env.observation_space, env.action_space))
    described = PolicySpec(observation, action_spec(env.action_space), **policy)
    return RunSpec(spec, described, rollout_steps=T, copies=N, lanes=8, seed=1, masked=True)


def vectorized(run: RunSpec, lane: int, pulse: Any) -> VectorCopies:
    return VectorCopies(SyncVectorEnv([run.env.make] * run.copies), run.info_keys, masked=run.masked)


def split(run: RunSpec, lanes: int) -> tuple[SplitVectorEnv, Collector]:
    vector = InfosByRow([run.env.make] * run.copies * lanes)
    vector.reset()  # it cannot reset some copies before all of them
    env = split_in_one_part(vector, run)
    return env, Collector(run, random_policy(run.policy), env.open_lane, env)


def same(one: Rollout, other: Rollout) -> bool:
    assert one.mask is not None
    assert other.mask is not None
    pairs = [*zip(one.obs, other.obs, strict=True), (one.mask, other.mask), (one.action, other.action)]
    return all(np.array_equal(a, b) for a, b in [*pairs, (one.reward, other.reward), (one.log_prob, other.log_prob)])


def seen(rollout: Rollout) -> Array:
    """What the environment shows is its true mask."""
    return np.asarray(rollout.obs[0] > 0)


@pytest.mark.parametrize("name", ENVS)
@pytest.mark.parametrize("head", ["actor_critic", "q"])
def test_rows_carry_the_masks_and_no_action_is_illegal(name: str, head: Any) -> None:
    if head == "q" and name in ("Parts", "Mixed"):
        pytest.skip("action values are of Discrete actions")
    run = masked_run(name, head=head)
    collector, masks = random_collector(run), 0
    for k in range(5):
        (rollout,) = collect(collector, run, k)  # the environment raises for an illegal action
        validate(rollout, run)
        mask = rollout.mask
        assert mask is not None
        assert mask.shape == (run.rollout_steps + 1, run.copies, run.policy.action.choices)
        assert np.array_equal(mask[:-1][rollout.valid], seen(rollout)[:-1][rollout.valid])
        assert mask[1:][rollout.terminated].all()
        cut = rollout.truncated & ~rollout.terminated
        assert np.array_equal(mask[1:][cut], seen(rollout)[1:][cut])
        masks += int(np.count_nonzero(~mask[:-1][rollout.valid]))
    assert masks > 100
    if head == "actor_critic":
        assert (rollout.log_prob > -20).all()


@pytest.mark.parametrize("name", ENVS)
@pytest.mark.parametrize("form", ["vectorized", "split"])
def test_a_vector_environment_gives_the_rows_of_the_loop(name: str, form: str) -> None:
    run = masked_run(name)
    by_loop = random_collector(run)
    other = random_collector(run, vectorized) if form == "vectorized" else split(run, 1)[1]
    for k in range(3):
        assert same(collect(by_loop, run, k)[0], collect(other, run, k)[0])


@pytest.mark.parametrize("name", ENVS)
@pytest.mark.parametrize("greedy", [True, False])
def test_evaluation_takes_no_illegal_action(name: str, greedy: bool) -> None:
    run = masked_run(name)
    rows: list[Any] = []
    order = example(Evaluate, session=1, ticket=1, seeds=(1, 2, 3), greedy=greedy, most_steps=1000, send_rows=True)
    played = Evaluator(run, random_policy(run.policy)).play(order, rows.append, no_pulse)
    assert len(played.episodes) == 3
    assert len(rows[0].obs) == len(run.policy.observation)  # without the mask


FAULTS = {
    "short": "got bool[6]",
    "missing": "got none",
    "empty": "got one without a choice, [0, 0, 0, 0, 0, 0, 0]",
    "two": "got the value 2",
}


@pytest.mark.parametrize("open_copies", [None, vectorized])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_mask_is_one_line_that_names_lane_copy_and_step(fault: str, open_copies: OpenEnvCopies | None) -> None:
    run = masked_run("InInfo", N=1, fault=fault)
    collector = random_collector(run) if open_copies is None else random_collector(run, open_copies)
    if open_copies is not None and fault == "short":
        pytest.skip("a SyncVectorEnv cannot join masks of different lengths")
    with pytest.raises(EnvironmentFailed) as caught:
        collect(collector, run)
    line = str(caught.value)
    expected = "action_mask: expected 7 zeros and ones of int8 or bool in info, at least one allowed"
    assert re.fullmatch(rf"lane 0, copy 0, step \d+: {expected}, {re.escape(FAULTS[fault])}; .* action_masks to none", line)


def test_a_wrong_mask_in_an_evaluation_is_one_line() -> None:
    run = masked_run("InInfo", fault="empty")
    with pytest.raises(EnvironmentFailed, match=r"copy 0, step \d+: action_mask: expected 7 zeros and ones"):
        Evaluator(run, random_policy(run.policy)).play(
            example(Evaluate, session=1, ticket=1, greedy=True, most_steps=99), print, no_pulse
        )


def test_a_copy_that_was_cut_needs_no_mask_until_it_is_reset() -> None:
    run = masked_run("InInfo")

    def figures(evaluator: Evaluator, seeds: tuple[int, ...], most_steps: int) -> list[tuple[float, int]]:
        order = example(Evaluate, session=1, ticket=1, seeds=seeds, greedy=True, most_steps=most_steps)
        return [(episode.reward, episode.length) for episode in evaluator.play(order, print, no_pulse).episodes]

    used, fresh = (Evaluator(run, random_policy(run.policy)) for _ in range(2))
    assert [length for _, length in figures(used, (1, 2, 3), 2)] == [2, 2, 2]
    assert figures(used, (4,), 99) == figures(fresh, (4,), 99)


class NoChoice(InInfo):
    """Says that no action is allowed, and takes any."""

    def given(self, bits: Any) -> Any:
        return bits * np.int8(0)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return *self._next()[:1], 0.0, False, False, self._info


def test_a_wrong_mask_of_a_split_vector_environment_is_of_a_copy_of_its_lane() -> None:
    run = masked_run("InInfo", N=2)
    vector = InfosByRow([InInfo, InInfo, InInfo, NoChoice])
    vector.reset()
    env = split_in_one_part(vector, run)
    with pytest.raises(EnvironmentFailed, match="lane 1, copy 1, first reset: action_mask: expected"):
        collect(Collector(run, random_policy(run.policy), env.open_lane, env), run, lanes=range(2))


def test_a_wrong_mask_of_the_evaluation_copies_of_a_vector_environment_is_of_a_copy_of_these() -> None:
    vector = InfosByRow([NoChoice] * 4)
    vector.reset()
    split = SplitVectorEnv(vector, masked_run("InInfo", N=1), evaluation_copies=2)
    with pytest.raises(CopyFailed) as caught:
        split.evaluation_lane().step(np.array([0]), no_pulse, [1])
    assert caught.value.copy == 1


def good() -> tuple[Rollout, RunSpec]:
    run = masked_run("Parts")
    return collect(random_collector(run), run)[0], run


def test_the_learner_checks_masks() -> None:
    rollout, run = good()
    validate(rollout, run)
    assert rollout.mask is not None
    assert stack_rollouts([rollout]).mask is not None
    short, numbers, empty = rollout.mask[:-1], rollout.mask.astype(np.int8), rollout.mask.copy()
    empty[4, 1, 3:5] = False  # the choices of the second entry
    t, n = (int(i) for i in np.argwhere(rollout.valid)[-1])
    forbidden: Bools = rollout.mask.copy()
    forbidden[t, n, : SIZES[0]] = True
    forbidden[t, n, rollout.action[t, n, 0]] = False
    cases: list[tuple[Any, str]] = [
        (None, "mask: expected one"),
        (short, r"mask: expected bool\[41, 3, 10\], got bool\[40, 3, 10\]"),
        (numbers, r"mask: expected bool\[41, 3, 10\], got int8"),
        (empty, "mask: expected an allowed choice at step 4, copy 1, got none"),
        (forbidden, rf"action: expected one that the mask allows at step {t}, copy {n}, got \["),
    ]
    for mask, message in cases:
        with pytest.raises(BadRollout, match=message):
            validate(msgspec.structs.replace(rollout, mask=mask), run)
    with pytest.raises(BadRollout, match="mask: expected none"):
        validate(rollout, msgspec.structs.replace(run, masked=False))


@pytest.mark.parametrize(
    ("mask", "action", "expected"),
    [
        (spaces.MultiBinary(4), spaces.Discrete(4), True),
        (spaces.Box(0, 1, (4,), np.int8), spaces.Discrete(4), True),
        (spaces.Box(0, 1, (5,), np.int8), spaces.MultiDiscrete([2, 3]), True),
        (spaces.Tuple([spaces.MultiBinary(2), spaces.MultiBinary(3)]), spaces.MultiDiscrete([2, 3]), True),
        (spaces.MultiDiscrete([2, 2]), spaces.Discrete(2), True),
        (spaces.MultiBinary(3), spaces.Discrete(4), False),
        (spaces.Box(0, 1, (4,), np.float32), spaces.Discrete(4), False),
        (spaces.MultiBinary(4), spaces.Box(-1, 1, (4,)), False),
        (spaces.MultiBinary(4), spaces.MultiBinary(4), False),
    ],
)
def test_which_key_of_an_observation_is_a_mask(mask: Any, action: Any, expected: bool) -> None:
    observation = spaces.Dict({"action_mask": mask, "z": spaces.Box(0, 1, (2,))})
    assert has_mask(observation, action) == expected
    assert list(without_mask(observation, action).spaces) == (["z"] if expected else ["action_mask", "z"])  # type: ignore[attr-defined]
    assert not has_mask(spaces.Dict({"action_mask": mask}), action)  # nothing would be left to see


TO_DO = "; correct it, or set action_masks to none"


@pytest.mark.parametrize(
    ("mask", "got"),
    [
        (spaces.MultiBinary(4), f"int8[4]{TO_DO}"),
        (spaces.Box(0, 1, (5,), np.float32), f"float32[5]{TO_DO}"),
        (
            spaces.Box(0, 1, (4, 5), np.int8),
            "int8[4, 5]; a wrapper has stacked it, so stack only the images (millrace:StackImages), or set action_masks to "
            "none",
        ),
    ],
)
def test_a_part_of_an_observation_that_is_called_a_mask_but_cannot_be_one_is_refused(mask: Any, got: str) -> None:
    observation = spaces.Dict({"action_mask": mask, "z": spaces.Box(0, 1, (2,))})
    env = DescribedEnv(observation, spaces.MultiDiscrete([2, 3]))
    expected = "observation action_mask: expected a mask, a MultiBinary or .* with a bit for each of 5 choices, got "
    with pytest.raises(UsageError, match=f"^{expected}{re.escape(got)}, which makes it an ordinary part"):
        EnvSpaces.of_description(env)
    assert [leaf.path for leaf in EnvSpaces.of_description(env, "none").observation] == ["action_mask", "z"]
    assert len(EnvSpaces.of_description(DescribedEnv(observation, spaces.Box(-1, 1, (5,)))).observation) == 2


def test_a_run_without_masks_reads_none() -> None:
    run = msgspec.structs.replace(masked_run("InInfo"), masked=False)
    with pytest.raises(EnvironmentFailed, match="illegal action"):
        collect(random_collector(run), run)


def test_masks_of_lanes_do_not_depend_on_each_other() -> None:
    run = masked_run("InInfo", T=10)
    alone = [collect(random_collector(run), run, lanes=[lane])[0] for lane in (0, 1)]
    both = collect(split(run, 2)[1], run, lanes=[0, 1])
    assert all(map(same, alone, both))


# ------------------------------------------------------------------------------------------------ a mask that is not used


@pytest.mark.parametrize("vector", [False, True])
def test_whoever_trains_is_told_of_a_mask_in_info_that_the_run_does_not_use(vector: bool) -> None:
    run = msgspec.structs.replace(masked_run("InInfo"), masked=False)
    collector = random_collector(run, vectorized) if vector else random_collector(run)
    assert collector.note == ""
    with pytest.raises(EnvironmentFailed, match="illegal action"):
        collect(collector, run)
    said = "the environment's info has an action_mask, which this run does not use; --action-masks info does"
    assert collector.note == said


def test_a_mask_that_is_used_is_not_told_of() -> None:
    run = masked_run("InInfo")
    collector = random_collector(run)
    collect(collector, run)
    assert collector.note == ""
