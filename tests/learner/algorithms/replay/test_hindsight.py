"""Hindsight: goals, rewards and ends of what is drawn, against a full history; and the check of the rewards that arrive."""

from __future__ import annotations

import io
import math
from collections import Counter
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from millrace.learner.algorithms.replay.hindsight import Hindsight, goal_reward, goals_not_used
from millrace.learner.algorithms.replay.mixed_replay import PRIOR_SLOT, MixedReplay
from millrace.learner.algorithms.replay.replay_buffer import ReplayBuffer, Sample
from millrace.learner.algorithms.replay.ring import Ring
from millrace.learner.config.hyperparameters import DQNConfig, PPOConfig, SACConfig
from millrace.protocol.arrays import Array, Doubles
from millrace.protocol.errors import UsageError
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import Leaf
from tests.learner.algorithms.replay.test_replay import GAMMA, Lanes, side_by_side
from tests.support.examples import examples

GOAL = Leaf("achieved_goal", "box", (1,), "float64")
OBS = (Leaf("observation", "box", (1,), "float64"), GOAL, msgspec.structs.replace(GOAL, path="desired_goal"))
ENDS = 2.5
MINE = f"{__name__}:mixed_up"


def mixed_up(achieved: Doubles, desired: Doubles) -> Array:
    """Whole numbers, so that nothing is rounded, and another one for nearly every pair."""
    mixed: Doubles = (31 * achieved[:, 0] + 17 * np.floor(desired[:, 0])) % 11 - 5
    return mixed


def hindsight(share: float = 0.8, reward: str = MINE, ends: float | None = ENDS, dtype: str = "float64") -> Hindsight:
    leaves = tuple(msgspec.structs.replace(leaf, dtype=dtype) for leaf in OBS)
    made = Hindsight.of(DQNConfig(hindsight=share, goal_reward=reward, goal_ends=ends), leaves)
    assert made is not None
    return made


def with_goals(batch: Batch) -> Batch:
    """The achieved goal is the number of the observation. What was desired is near it where the task ended, or half of it.

    Own goals are negative, or end in one half, so that they are never taken for achieved ones.
    """
    number = batch.obs[0]
    desired = -number
    ends_there = batch.terminated & (number[1:, :, 0] % 2 == 0)
    desired[1:][ends_there] = number[1:][ends_there] + 0.5
    reward = batch.reward.copy()
    reward[batch.valid] = mixed_up(number[1:][batch.valid], desired[1:][batch.valid])
    return msgspec.structs.replace(batch, obs=(number, number.copy(), desired), reward=reward)


def buffer(size: int = 1000, n_step: int = 1, alpha: float | None = None, seed: int = 0, **settings: Any) -> ReplayBuffer:
    return ReplayBuffer(OBS, size=size, n_step=n_step, gamma=GAMMA, seed=seed, alpha=alpha, hindsight=hindsight(**settings))


def filled(lanes: Lanes, into: ReplayBuffer, rollouts: int = 4) -> ReplayBuffer:
    for _ in range(rollouts):
        into.add(side_by_side(*(lanes.used(with_goals(lanes.rollout(lane))) for lane in (0, 1))))
    return into


def future(lanes: Lanes, began: float) -> list[float]:
    """What the rows from this one on led to, to the end of the episode or of what was given away."""
    found: list[float] = []
    while began in lanes.rows:
        row = lanes.rows[began]
        found.append(row.leads_to)
        if row.terminated or row.truncated:
            break
        began = row.leads_to
    return found


def slow_sum(lanes: Lanes, began: float, n_step: int, goal: float) -> tuple[float, float, float]:
    """Reward, discount and where it leads under another goal: what the definition says, a step at a time."""
    total = 0.0
    discount = 1.0
    for at in future(lanes, began)[:n_step]:
        row = lanes.rows[began]
        total += discount * float(mixed_up(np.array([[at]]), np.array([[goal]]))[0])
        discount *= GAMMA
        ended_elsewhere = row.terminated and at % 2 == 1
        if abs(at - goal) <= ENDS or ended_elsewhere:
            return total, 0.0, at
        began = at
    return total, discount, at


def check(drawn: Sample, lanes: Lanes, n_step: int) -> Counter[tuple[float, float]]:
    """Every transition is what the definition says. How often each row got which goal."""
    got: Counter[tuple[float, float]] = Counter()
    for i in range(len(drawn.slots)):
        began = float(drawn.leaves[0][i, 0])
        goal = float(drawn.leaves[2][i, 0])
        if goal == -began or goal % 1 or goal == 0:
            expected = lanes.slow_sum(began, n_step)
        else:
            assert goal in future(lanes, began)
            expected = slow_sum(lanes, began, n_step, goal)
            assert drawn.next_leaves[2][i, 0] == goal
            got[began, goal] += 1
        reward, discount, leads_to = expected
        assert drawn.reward[i] == pytest.approx(reward, abs=1e-4)
        assert drawn.discount[i] == pytest.approx(discount)
        assert drawn.next_leaves[0][i, 0] == drawn.next_leaves[1][i, 0] == leads_to
        assert drawn.leaves[1][i, 0] == began
    return got


@examples(80)
@given(
    seed=st.integers(0, 2**32),
    T=st.integers(1, 6),
    n_step=st.integers(1, 5),
    ends=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
    waits=st.sampled_from([0.0, 0.3, 0.8]),
    alpha=st.sampled_from([None, 0.5]),
    fates=st.lists(st.tuples(st.integers(0, 1), st.sampled_from(["use", "use", "use", "drop", "restart"])), min_size=1),
)
def test_a_row_with_another_goal_is_what_the_definition_says(
    seed: int, T: int, n_step: int, ends: float, waits: float, alpha: float | None, fates: list[tuple[int, str]]
) -> None:
    """Whatever ends and waits where; rollouts of a lane dropped between, the lane begun anew. All goals that can be are."""
    lanes = Lanes(seed, T=T, ends=ends, waits=waits)
    kept = buffer(n_step=n_step, alpha=alpha)
    for lane, fate in fates:
        if fate == "restart":
            lanes.restart(lane)
        rollout = with_goals(lanes.rollout(lane))
        if fate != "drop":
            kept.add(lanes.used(rollout))
    assert len(kept) == len(lanes.rows)
    if lanes.rows:
        got = check(kept.sample(50 * len(lanes.rows)), lanes, n_step)
        assert all(future(lanes, began) for began in lanes.rows)
        last = [began for began in lanes.rows if len(future(lanes, began)) == 1]
        assert all((began, future(lanes, began)[0]) in got for began in last)


@examples(30)
@given(
    seed=st.integers(0, 2**32),
    n_step=st.integers(1, 4),
    size=st.integers(30, 45),
    ends=st.sampled_from([0.0, 0.05, 0.5]),
    waits=st.sampled_from([0.0, 0.5]),
    alpha=st.sampled_from([None, 1.0]),
)
def test_goals_are_right_while_the_ring_overwrites_rows(
    seed: int, n_step: int, size: int, ends: float, waits: float, alpha: float | None
) -> None:
    size += 60 if waits else 0
    lanes = Lanes(seed, ends=ends, waits=waits)
    kept = buffer(size, n_step, alpha)
    for _ in range(8):
        filled(lanes, kept, 3)
        check(kept.sample(400), lanes, n_step)
    assert len(kept) <= size


def test_each_later_step_is_as_likely_as_every_other() -> None:
    lanes = Lanes(0, lanes=1, copies=1, T=20, ends=0.0)
    kept = buffer(share=0.5, ends=None)
    kept.add(lanes.used(with_goals(lanes.rollout(0))))
    count = 200_000
    drawn = kept.sample(count)
    goals = drawn.leaves[2][:, 0]
    relabelled = goals > 0
    assert abs(relabelled.mean() - 0.5) < 6 * math.sqrt(0.25 / count)
    pairs = Counter(zip(drawn.leaves[0][relabelled, 0].tolist(), goals[relabelled].tolist(), strict=True))
    for began in lanes.rows:
        later = future(lanes, began)
        chance = 0.5 / 20 / len(later)
        for goal in later:
            assert abs(pairs[began, goal] / count - chance) < 6 * math.sqrt(chance / count)


def test_equal_parts_of_the_chance_choose_equal_numbers_of_steps() -> None:
    lanes = Lanes(0, lanes=1, copies=1, T=7, ends=0.0)
    kept = buffer()
    kept.add(with_goals(lanes.rollout(0)))
    assert kept._paths is not None
    later = kept._paths.later(np.zeros(70, np.int64), (np.arange(70) + 0.5) / 70)
    assert np.bincount(later).tolist() == [0, *[10] * 7]
    least, most = kept._paths.later(np.zeros(2, np.int64), np.array([0.0, math.nextafter(1, 0)]))
    assert (least, most) == (1, 7)


def test_of_two_million_goals_none_is_from_another_episode() -> None:
    lanes = Lanes(1, lanes=2, copies=8, T=6, ends=0.04, waits=0.2)
    kept = filled(lanes, buffer(4000, n_step=3), 60)
    last = {began: future(lanes, began)[-1] for began in lanes.rows}
    numbers = 1 + int(max(last.values()))
    end_of_row = np.full(numbers, -1)
    end_of_row[np.array([*last], int)] = np.array([*last.values()], int)
    end_of_row[np.array([*last.values()], int)] = np.array([*last.values()], int)
    relabelled = 0
    for _ in range(20):
        drawn = kept.sample(100_000)
        goals = drawn.leaves[2][:, 0]
        theirs = np.flatnonzero((goals > 0) & (goals % 1 == 0))
        began = drawn.leaves[0][theirs, 0].astype(int)
        goal = goals[theirs].astype(int)
        assert (end_of_row[began] == end_of_row[goal]).all()
        assert (goal > began).all()
        relabelled += len(theirs)
    assert relabelled > 1_500_000


def test_an_episode_without_an_end_takes_no_more_memory_than_its_rows() -> None:
    lanes = Lanes(0, lanes=1, copies=1, T=50, ends=0.0)
    kept = buffer(200)
    for _ in range(100):
        kept.add(lanes.used(with_goals(lanes.rollout(0))))
        check(kept.sample(20), lanes, 1)
    assert kept._paths is not None
    (path,) = kept._paths._paths.values()
    assert 200 <= len(path.slots) <= 2 * 200
    assert path.end == 50 * 100 + 1


@pytest.mark.parametrize("size", [60, 1000])
def test_a_restored_replay_draws_the_same_goals(size: int) -> None:
    lanes = Lanes(2)
    first = filled(lanes, buffer(size, 3, 0.5), 9)
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second = filled(Lanes(7), buffer(size, 3, 0.5, seed=9), 12)
    second.load_state_dict(torch.load(file, weights_only=True))
    for _ in range(3):
        for one, other in zip(first.sample(80), second.sample(80), strict=True):
            np.testing.assert_array_equal(one, other)
        batch = side_by_side(*(lanes.used(with_goals(lanes.rollout(lane))) for lane in (0, 1)))
        first.add(batch)
        second.add(batch)
    check(second.sample(200), lanes, 3)


def test_what_is_taken_back_is_drawn_again() -> None:
    lanes = Lanes(2)
    kept = filled(lanes, buffer(60, 2), 9)
    kept.remember()
    first = kept.sample(80)
    filled(Lanes(5), kept, 3)
    kept.sample(5)
    kept.roll_back()
    for one, other in zip(first, kept.sample(80), strict=True):
        np.testing.assert_array_equal(one, other)
    filled(lanes, kept, 2)
    check(kept.sample(200), lanes, 2)


def test_prior_transitions_get_other_goals_of_their_own_episodes() -> None:
    before = Lanes(2, lanes=1, copies=1, T=12, ends=0.0)
    own = Lanes(3, lanes=1, copies=1, ends=0.0)
    made = MixedReplay(OBS, size=100, n_step=2, gamma=GAMMA, seed=0, hindsight=hindsight(ends=None))
    episodes = []
    for _ in range(3):
        episode = before.rollout(0)
        episode.truncated[-1] = True
        before.restart(0)
        episodes.append(with_goals(before.used(episode)))
    made.add_prior(episodes, 3 * 13, 0.5)
    made.add(with_goals(own.rollout(0)))
    drawn = made.sample(1000)
    prior = np.flatnonzero((drawn.slots == PRIOR_SLOT) & (drawn.leaves[2][:, 0] > 0))
    assert 300 < len(prior) < 500
    for i in prior:
        assert drawn.leaves[2][i, 0] in future(before, float(drawn.leaves[0][i, 0]))
    wrong = msgspec.structs.replace(episodes[0], reward=episodes[0].reward + 1)
    with pytest.raises(UsageError, match=r"^prior: episode 1: goal_reward .*: lane 0, column 0, step 0 of its rollout: "):
        made.add_prior([episodes[1], wrong], 50, 0.5)


def test_the_memory_that_is_foretold_is_what_it_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    foretold: list[int] = []
    monkeypatch.setattr(Ring, "_check_memory", lambda _, needed: foretold.append(needed))
    lanes = Lanes(0, lanes=1, copies=1, T=49, ends=0.0)
    kept = buffer(50)
    kept.add(with_goals(lanes.rollout(0)))
    assert kept._paths is not None
    arrays = kept.arrays["row"].nbytes + sum(leaf.nbytes for leaf in kept._obs)
    paths = (
        kept._paths._number.nbytes
        + kept._paths._place.nbytes
        + sum(8 * len(one.slots) for one in kept._paths._paths.values())
    )
    assert [kept.bytes] == foretold == [arrays + paths]


# -------------------------------------------------------------------- the check of what arrives


def rows_of(achieved: Array, desired: Array, reward: Array, terminated: bool = False) -> Batch:
    """A batch of one column whose rows led to these goals [T, G]."""
    T = len(achieved)
    flags = np.zeros((T, 1), bool)
    first = np.zeros((1, 1, achieved.shape[1]), achieved.dtype)
    goals = [np.concatenate([first, goal[:, None]]) for goal in (achieved, desired)]
    return Batch(
        obs=(goals[0], *goals),
        action=np.zeros((T, 1), np.int64),
        log_prob=np.zeros((T, 1), np.float32),
        reward=np.asarray(reward, np.float32)[:, None],
        terminated=flags | terminated,
        truncated=flags,
        valid=~flags,
        state=np.zeros((1, 0), np.float32),
        lane=np.full(1, 3),
        fresh=np.ones(1, bool),
        columns_per_rollout=1,
        episodes=(),
    )


numbers = st.floats(-100, 100).filter(lambda number: number == 0 or abs(number) > 1e-30)


@examples(200)
@given(
    data=st.data(),
    G=st.integers(1, 5),
    dtype=st.sampled_from(["float16", "float32", "float64"]),
    computed=st.sampled_from([np.float32, np.float64]),
    kind=st.sampled_from(["dense", "sparse", "success"]),
)
def test_goals_that_were_rounded_after_the_reward_was_computed_are_right(
    data: st.DataObject, G: int, dtype: str, computed: type, kind: str
) -> None:
    """Also at the very distance at which a sparse reward changes, and if the environment computes in float32."""
    achieved: Array = np.array([data.draw(st.lists(numbers, min_size=G, max_size=G))], computed)
    desired: Array = np.array([data.draw(st.lists(numbers, min_size=G, max_size=G))], computed)
    apart = np.linalg.norm(achieved - desired, axis=-1)
    within = abs(float(apart[0])) + data.draw(st.sampled_from([0.0, 1e-9, -1e-9, 1e-6, -1e-6, 5.0]))
    within = max(within, 0.0)
    reward = {"dense": -apart, "sparse": -(apart > within).astype(float), "success": (apart <= within).astype(float)}[kind]
    name = kind if kind == "dense" else f"{kind}:{within!r}"
    checked = hindsight(reward=name, ends=None, dtype=dtype)
    checked.check(rows_of(achieved.astype(dtype), desired.astype(dtype), reward))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("off", [1e-5, -1e-5])
def test_a_threshold_that_is_off_by_little_is_noticed(dtype: str, off: float) -> None:
    desired = np.array([[0.3, -0.5, 0.9]] * 3)
    achieved = desired + np.array([[0.2, 0, 0], [0.05 + off / 2, 0, 0], [0.0, 0, 0]])
    reward = -(np.linalg.norm(achieved - desired, axis=1) > 0.05).astype(float)
    goals = (achieved.astype(dtype), desired.astype(dtype))
    hindsight(reward="sparse:0.05", ends=None, dtype=dtype).check(rows_of(*goals, reward))
    with pytest.raises(UsageError) as refused:
        hindsight(reward=f"sparse:{0.05 + off}", ends=None, dtype=dtype).check(rows_of(*goals, reward))
    line = str(refused.value)
    assert "\n" not in line
    assert f"goal_reward sparse:{0.05 + off}: lane 3, column 0, step 1 of its rollout: expected {-(off < 0):g} for" in line
    assert f"at a distance of {0.05 + off / 2:g}" in line
    assert f"got {-(off > 0):g} from the environment; name the function that it computes rewards with" in line


@pytest.mark.parametrize("wrong", [lambda r: 0.1 * r, lambda r: r + 1e-3, lambda r: np.where(r == r[2], np.nan, r)])
def test_rewards_that_a_wrapper_changes_are_noticed(wrong: Any) -> None:
    generator = np.random.default_rng(0)
    achieved, desired = generator.normal(size=(2, 9, 3))
    reward = -np.linalg.norm(achieved - desired, axis=1)
    hindsight(reward="dense", ends=None).check(rows_of(achieved, desired, reward))
    with pytest.raises(UsageError, match=r"^goal_reward dense: lane 3, column 0, step [02] of its rollout: expected "):
        hindsight(reward="dense", ends=None).check(rows_of(achieved, desired, wrong(reward)))


def test_rows_that_are_not_valid_are_not_checked() -> None:
    rows = rows_of(np.zeros((2, 1)), np.ones((2, 1)), np.array([-1.0, 77.0]))
    with pytest.raises(UsageError, match="step 1"):
        hindsight(reward="sparse:0.5", ends=None).check(rows)
    valid = np.array([[True], [False]])
    hindsight(reward="sparse:0.5", ends=None).check(msgspec.structs.replace(rows, valid=valid))
    hindsight(reward="sparse:0.5", ends=None).check(msgspec.structs.replace(rows, valid=valid & False))


def test_a_task_that_ends_at_its_goal_must_be_called_so_and_only_then() -> None:
    there = rows_of(np.zeros((1, 1)), np.full((1, 1), 0.4), np.zeros(1), terminated=True)
    hindsight(reward="sparse:0.5", ends=0.5).check(there)
    for ends, named in ((None, "none"), (0.3, "0.3")):
        with pytest.raises(UsageError, match=rf"^goal_ends {named}: .* got its end; take --goal-ends 0.5 if it ends at"):
            hindsight(reward="sparse:0.5", ends=ends).check(there)
    goes_on = msgspec.structs.replace(there, terminated=~there.terminated)
    hindsight(reward="sparse:0.5", ends=None).check(goes_on)
    with pytest.raises(UsageError, match=r"^goal_ends 0.5: .*expected that the task ends at .* got a row that goes on; "):
        hindsight(reward="sparse:0.5", ends=0.5).check(goes_on)
    fell = rows_of(np.zeros((1, 1)), np.full((1, 1), 9.0), np.full(1, -1.0), terminated=True)
    hindsight(reward="sparse:0.5", ends=0.5).check(fell)
    hindsight(reward="sparse:0.5", ends=None).check(fell)


# -------------------------------------------------------------------- settings


def raises(achieved: Doubles, desired: Doubles) -> Array:
    raise ValueError("no such goal")


def wrong_shape(achieved: Doubles, desired: Doubles) -> Array:
    return achieved


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (
            "near",
            "goal_reward near: expected sparse:DISTANCE, success:DISTANCE, dense or module:function, as in sparse:0.05",
        ),
        ("sparse:-1", "goal_reward sparse:-1: expected a distance of at least 0, got -1"),
        ("success:inf", "goal_reward success:inf: expected a distance of at least 0, got inf"),
        (f"{__name__}:no_such", f"goal_reward {__name__}:no_such: module {__name__} has no no_such"),
        ("sparse:x", "goal_reward sparse:x: no module named sparse; is it installed, or its folder on PYTHONPATH?"),
    ],
)
def test_a_reward_that_there_is_not_is_refused_in_one_line(name: str, expected: str) -> None:
    with pytest.raises(UsageError) as refused:
        goal_reward(name)
    assert str(refused.value) == expected


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("raises", r"raises failed: ValueError: no such goal$"),
        ("wrong_shape", r"wrong_shape: expected an array of 2 numbers for goals \[2, 1\], got float64\[2, 1\]$"),
    ],
)
def test_a_function_that_fails_or_returns_something_else_is_named(name: str, expected: str) -> None:
    checked = hindsight(reward=f"{__name__}:{name}", ends=None)
    with pytest.raises(UsageError, match=expected):
        checked.check(rows_of(np.zeros((2, 1)), np.ones((2, 1)), np.zeros(2)))


SETTINGS = SACConfig(hindsight=0.8, goal_reward="sparse:0.1")


@pytest.mark.parametrize(
    ("leaves", "got"),
    [
        (OBS[:1], "got observation float64[1]; "),
        ((Leaf("", "box", (4,), "float32"),), "got one array float32[4]; "),
        (
            (OBS[1], msgspec.structs.replace(OBS[2], dtype="float32")),
            "got achieved_goal float64[1], desired_goal float32[1]; ",
        ),
    ],
)
def test_observations_without_the_two_goals_are_refused_in_one_line(leaves: tuple[Leaf, ...], got: str) -> None:
    with pytest.raises(UsageError) as refused:
        Hindsight.of(SETTINGS, leaves)
    line = str(refused.value)
    assert line.startswith(
        "hindsight 0.8: expected a Dict observation with achieved_goal and desired_goal, of one shape and"
    )
    assert got in line
    assert Hindsight.of(SACConfig(goal_reward="dense"), leaves) is None


def test_a_run_that_could_use_its_goals_is_told_so() -> None:
    assert goals_not_used(SACConfig(), OBS, "Reach-v0").startswith(
        "Reach-v0 shows an achieved and a desired goal: if its reward is sparse, --hindsight 0.8 --goal-reward sparse:0.05 "
    )
    assert not goals_not_used(SETTINGS, OBS, "Reach-v0")
    assert not goals_not_used(SACConfig(), OBS[:1], "Reach-v0")
    assert not goals_not_used(PPOConfig(), OBS, "Reach-v0")
