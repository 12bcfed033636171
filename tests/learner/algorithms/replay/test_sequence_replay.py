"""The replay buffer of sequences: what it keeps, what is drawn with what, what n steps add up to, how it is saved."""

from __future__ import annotations

import io
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from millrace.learner.algorithms.replay import ring
from millrace.learner.algorithms.replay.replay_buffer import DISCRETE
from millrace.learner.algorithms.replay.sequence_replay import SequenceReplay, SequenceSample
from millrace.protocol.errors import UsageError
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec
from tests.learner.algorithms.replay.test_replay import GAMMA, OBS, RUBBISH, Lanes, Row, side_by_side
from tests.support.examples import examples

POLICY = PolicySpec(OBS, DISCRETE, core="gru", core_size=1)


def replay(T: int, sequences: int = 500, n_step: int = 1, alpha: float | None = None, seed: int = 0) -> SequenceReplay:
    return SequenceReplay(POLICY, rows=sequences * T, steps=T, n_step=n_step, gamma=GAMMA, seed=seed, alpha=alpha)


def marked(batch: Batch) -> Batch:
    """With states that say which observation they stand before."""
    return msgspec.structs.replace(batch, state=batch.obs[0][0].astype(np.float32))


class Given:
    """What a replay was given: the rows, and for each sequence, by its first observation, the one that it continues."""

    def __init__(self, lanes: Lanes, into: SequenceReplay) -> None:
        self.lanes, self.into = lanes, into
        self.before: dict[float, float | None] = {}
        self.newest: dict[tuple[int, int], float | None] = {}

    def use(self, lane: int) -> Batch:
        batch = marked(self.lanes.used(self.lanes.rollout(lane)))
        for n, fresh in enumerate(batch.fresh):
            first = float(batch.obs[0][0, n, 0])
            known = None if fresh else self.newest.get((lane, n))
            if batch.valid[:, n].any():
                self.before[first] = known
            waits = batch.obs[0][0, n, 0] == batch.obs[0][-1, n, 0]
            self.newest[lane, n] = first if batch.valid[:, n].any() else known if waits else None
        return batch

    def drop(self, lane: int) -> None:
        """A rollout that is never learned from: the next one continues nothing that is stored."""
        self.lanes.rollout(lane)
        self.lanes._fresh[lane] = True


def slow_sum(rows: dict[float, Row], within: set[float], began: float, n_step: int) -> tuple[float, float, float]:
    """Reward, discount and where it leads, or the last row of a task that terminates: at most n rows of one sequence."""
    total, at = 0.0, began
    for k in range(n_step):
        last = at
        row = rows[last]
        total += GAMMA**k * row.reward
        at = row.leads_to
        if row.terminated:
            return total, 0.0, last
        if row.truncated or at not in within:
            return total, GAMMA ** (k + 1), at
    return total, GAMMA**n_step, at


def check(sample: SequenceSample, given: Given, n_step: int) -> set[float]:
    """All that was drawn is what was given; the first observations of the sequences."""
    T = given.lanes.T
    (obs,) = sample.leaves
    columns = obs.shape[1]
    rows = given.lanes.rows
    stored = set(given.into.arrays["state"][:, 0].tolist())
    valid = np.zeros((T, columns), bool)
    valid.flat[sample.rows] = True
    for c in range(columns):
        first = float(obs[T, c, 0])
        before = given.before[first]
        if before is None or before not in stored:
            assert sample.state[c, 0] == np.float32(first)
            assert not sample.advances[:T, c].any()
            assert sample.keep_state[: T + 1, c].all()
        else:
            assert sample.state[c, 0] == np.float32(before)
            assert obs[0, c, 0] == before
            assert sample.advances[:T, c].any()
        assert (sample.advances[T:-1, c] == valid[:, c]).all()
    began = obs[T:-1, :, 0].ravel()[sample.rows]
    leads = obs[T:, :, 0].ravel()[sample.next_rows]
    for i, key in enumerate(began.tolist()):
        c = int(sample.rows[i]) % columns
        within = set(obs[T:-1, c, 0][valid[:, c]].tolist())
        reward, discount, leads_to = slow_sum(rows, within, key, n_step)
        assert sample.reward[i] == pytest.approx(reward, abs=1e-4)
        assert sample.discount[i] == pytest.approx(discount)
        assert sample.action[i] == int(key) % 7
        assert leads[i] == leads_to
        assert RUBBISH not in (sample.reward[i], sample.action[i])
    return set(obs[T, :, 0].tolist())


@examples(80)
@given(
    seed=st.integers(0, 2**32),
    T=st.integers(1, 6),
    n_step=st.integers(1, 7),
    ends=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
    waits=st.sampled_from([0.0, 0.3, 0.8]),
    alpha=st.sampled_from([None, 0.5]),
    sequences=st.sampled_from([4, 7, 500]),
    fates=st.lists(st.tuples(st.integers(0, 1), st.sampled_from(["use", "use", "use", "drop", "restart"])), min_size=1),
)
def test_what_is_drawn_is_what_was_given(
    seed: int,
    T: int,
    n_step: int,
    ends: float,
    waits: float,
    alpha: float | None,
    sequences: int,
    fates: list[tuple[int, str]],
) -> None:
    """With seats that wait, dropped rollouts, lanes that begin anew, and a ring that overwrites the sequence before."""
    lanes = Lanes(seed, T=T, ends=ends, waits=waits)
    given = Given(lanes, replay(T, sequences, n_step, alpha))
    for lane, fate in fates:
        if fate == "restart":
            lanes.restart(lane)
        elif fate == "drop":
            given.drop(lane)
        else:
            given.into.add(given.use(lane))
    if len(given.into):
        check(given.into.sample(50 * T), given, n_step)


def filled(T: int = 4, rollouts: int = 6, **settings: Any) -> Given:
    given = Given(Lanes(0, T=T), replay(T, **settings))
    for _ in range(rollouts):
        given.into.add(side_by_side(given.use(0), given.use(1)))
    return given


def test_where_an_episode_begins_the_state_is_not_kept() -> None:
    given = filled(T=8, rollouts=4)
    sample = given.into.sample(800)
    T = 8
    (obs,) = sample.leaves
    for c in range(obs.shape[1]):
        for t in range(T):
            row = given.lanes.rows.get(float(obs[T + t, c, 0]))
            begins = row is None  # a row that is not valid resets its copy
            assert sample.keep_state[T + t + 1, c] != begins


def test_a_fresh_lane_continues_nothing_even_where_observations_are_the_same() -> None:
    given = Given(Lanes(0, T=4), replay(4))
    batch = given.use(0)
    again = msgspec.structs.replace(batch, obs=(batch.obs[0][::-1].copy(),))
    for fresh, continues in ((False, True), (True, False)):
        into = replay(4)
        into.add(batch)
        into.add(msgspec.structs.replace(again, fresh=np.array([fresh, fresh])))
        assert ((into.arrays["before"][into._written - 2 : into._written] >= 0) == continues).all()


def test_every_sequence_has_the_same_chance() -> None:
    given = filled()
    draws = 48_000
    sample = given.into.sample(4 * draws)
    counts = np.bincount(np.searchsorted(sorted(given.before), sample.leaves[0][4, :, 0]))
    assert len(counts) == len(given.before) == 24  # 6 rollouts of 2 lanes of 2 copies
    expected = draws / 24
    assert abs(counts - expected).max() < 5 * np.sqrt(expected)


def test_sequences_are_drawn_in_proportion_to_their_priorities_and_weighted_against_it() -> None:
    """The priority is 0.9 of the greatest error and 0.1 of the mean; the weight is (number · chance)^−β by the greatest."""
    given = filled(rollouts=2, alpha=1.0)
    number = given.into._written
    errors = {}
    generator = np.random.default_rng(3)
    for slot in range(number):
        rows = int(np.count_nonzero(given.into.arrays["valid"][slot]))
        errors[slot] = generator.uniform(0, 5, rows).astype(np.float32)
    slots = np.concatenate([np.full(len(error), slot) for slot, error in errors.items()])
    given.into.update_priorities(slots, np.concatenate(list(errors.values())) * np.where(slots % 2, 1, -1))
    priority = np.array([0.9 * error.max() + 0.1 * error.mean() + 1e-6 for error in errors.values()])
    chance = priority / priority.sum()
    count = 40_000
    sample = given.into.sample(4 * count, beta=0.5)
    columns = len(sample.state)
    slot_of_column = np.zeros(columns, int)
    slot_of_column[sample.rows % columns] = sample.slots
    counts = np.bincount(slot_of_column, minlength=number)
    assert (abs(counts - count * chance) < 5 * np.sqrt(count * chance)).all()
    weights = (number * chance) ** -0.5
    np.testing.assert_allclose(sample.weight, (weights / weights[np.unique(slot_of_column)].max())[sample.slots], rtol=1e-5)


def test_what_is_new_gets_the_highest_priority_ever_seen() -> None:
    given = filled(rollouts=1, alpha=1.0)
    given.into.update_priorities(np.array([0]), np.array([9.0], np.float32))
    given.into.update_priorities(np.array([0]), np.array([0.5], np.float32))
    given.into.add(given.use(0))
    assert given.into._priorities is not None
    assert given.into._priorities.tree.weights[given.into._written - 1] == pytest.approx(9, rel=1e-5)


def equal(a: dict[str, Any], b: dict[str, Any]) -> bool:
    saved = []
    for state in (a, b):
        file = io.BytesIO()
        torch.save(state, file)
        saved.append(file.getvalue())
    return saved[0] == saved[1]


@pytest.mark.parametrize("alpha", [None, 0.6])
@pytest.mark.parametrize("sequences", [9, 500])
def test_a_restored_replay_goes_on_to_the_bit(sequences: int, alpha: float | None) -> None:
    given = filled(sequences=sequences, alpha=alpha)
    other = replay(4, sequences, alpha=alpha, seed=5)
    other.load_state_dict(given.into.state_dict())
    batches = [given.use(lane) for lane in (0, 1, 0)]
    for into in (given.into, other):
        for batch in batches:
            drawn = into.sample(16)
            into.update_priorities(drawn.slots, np.linspace(0, 3, len(drawn.slots), dtype=np.float32))
            into.add(batch)
    assert equal(given.into.state_dict(), other.state_dict())
    assert len(given.into) == len(other)


@pytest.mark.parametrize("alpha", [None, 0.6])
@pytest.mark.parametrize("sequences", [9, 500])
def test_it_returns_to_what_was_remembered(sequences: int, alpha: float | None) -> None:
    given = filled(sequences=sequences, alpha=alpha)
    given.into.remember()
    before, rows = given.into.state_dict(), len(given.into)
    for lane in (0, 1, 0, 1):
        drawn = given.into.sample(16)
        given.into.update_priorities(drawn.slots, np.linspace(0, 3, len(drawn.slots), dtype=np.float32))
        given.into.add(given.use(lane))
    assert not equal(before, given.into.state_dict())
    given.into.roll_back()
    assert equal(before, given.into.state_dict())
    assert len(given.into) == rows


def test_a_state_of_another_length_or_size_is_refused() -> None:
    state = replay(4).state_dict()
    with pytest.raises(ValueError, match="rollout_steps: expected 4, got 5"):
        replay(5).load_state_dict(state)
    with pytest.raises(ValueError, match="replay_size: expected 2000, got 4000"):
        replay(4, 1000).load_state_dict(state)


def test_masks_are_those_of_the_observations_that_follow() -> None:
    given = Given(Lanes(0, T=4), replay(4))
    for _ in range(3):
        batch = given.use(0)
        mask = np.zeros((5, 2, 7), bool)
        np.put_along_axis(mask, (batch.obs[0].astype(int) % 7), True, -1)
        given.into.add(msgspec.structs.replace(batch, mask=mask))
    sample = given.into.sample(200)
    leads = sample.leaves[0][4:, :, 0].ravel()[sample.next_rows]
    assert sample.next_mask is not None
    np.testing.assert_array_equal(sample.next_mask.argmax(1), leads.astype(int) % 7)
    assert (sample.next_mask.sum(1) == 1).all()


def test_a_replay_that_does_not_fit_is_refused_before_it_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    needed = 2 * replay(4, 100).bytes
    monkeypatch.setattr(ring, "available_bytes", lambda: needed)
    replay(4, 100)
    with pytest.raises(UsageError, match=r"replay_size 404: 404 transitions take .* take --replay-size 400 or less"):
        replay(4, 101)


def test_a_rollout_that_does_not_fit_is_refused() -> None:
    with pytest.raises(UsageError, match=r"replay_size 12: expected room for two rollouts of a lane, 16 rows"):
        replay(4, 3).add(Given(Lanes(0), replay(4)).use(0))
