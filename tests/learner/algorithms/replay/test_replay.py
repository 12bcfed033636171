"""The replay: what it keeps, what n steps add up to at every kind of end, how it draws, how much memory it asks for."""

from __future__ import annotations

import copy
import io
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from millrace.learner.algorithms.replay import replay_buffer as module
from millrace.learner.algorithms.replay import ring
from millrace.learner.algorithms.replay.replay_buffer import ReplayBuffer, Sample
from millrace.learner.algorithms.replay.ring import Ring
from millrace.learner.algorithms.replay.sum_tree import SumTree
from millrace.protocol.errors import UsageError
from millrace.protocol.machine.available_memory import GIB
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import Leaf
from tests.support.examples import examples

OBS = (Leaf("", "box", (1,), "float64"),)
GAMMA = 0.9
LONGEST_WAIT = 10  # steps
RUBBISH = 77  # stands in every row that is not valid, and must never be seen again


class Row(NamedTuple):
    """A valid row; observations are numbers that never repeat."""

    reward: float
    terminated: bool
    truncated: bool
    leads_to: float


class Stream:
    """One env copy, or one seat, that ends now and then, as the row format has it. A seat may wait between its rows."""

    def __init__(self, generator: np.random.Generator, ends: float, counter: Iterator[int], waits: float) -> None:
        self._generator, self._ends, self._counter, self._waits = generator, ends, counter, waits
        self.begin()

    def begin(self) -> None:
        self.obs, self._ended, self._waited = float(next(self._counter)), False, 0

    def step(self) -> tuple[Row, bool]:
        """A row, and whether it is valid."""
        before_valid, terminated, truncated = not self._ended, False, False
        if before_valid and self._waited < LONGEST_WAIT and self._waits and self._generator.random() < self._waits:
            self._waited += 1
            return Row(RUBBISH, False, False, self.obs), False
        self._waited = 0
        if before_valid:
            terminated, truncated = (bool(self._generator.random() < self._ends) for _ in range(2))
        reward = float(self._generator.integers(-5, 5)) if before_valid else RUBBISH
        self._ended = terminated or truncated
        self.obs = float(next(self._counter))
        return Row(reward, terminated, truncated, self.obs), before_valid


class Lanes:
    """Lanes of streams, and all valid rows that were given away, by the observation they began with."""

    def __init__(
        self, seed: int, lanes: int = 2, copies: int = 2, T: int = 4, ends: float = 0.15, waits: float = 0.0
    ) -> None:
        self.generator, counter = np.random.default_rng(seed), iter(range(1, 10**9))
        self.copies, self.T, self._with_seats = copies, T, waits > 0
        self._streams = [[Stream(self.generator, ends, counter, waits) for _ in range(copies)] for _ in range(lanes)]
        self._fresh = [True] * lanes
        self.rows: dict[float, Row] = {}

    def restart(self, lane: int) -> None:
        for stream in self._streams[lane]:
            stream.begin()
        self._fresh[lane] = True

    def rollout(self, lane: int) -> Batch:
        T, N = self.T, self.copies
        obs, action, reward = np.zeros((T + 1, N, 1)), np.full((T, N), RUBBISH), np.full((T, N), RUBBISH, np.float32)
        terminated, truncated, valid = (np.zeros((T, N), bool) for _ in range(3))
        for n, stream in enumerate(self._streams[lane]):
            obs[0, n] = stream.obs
            for t in range(T):
                began = stream.obs
                row, valid[t, n] = stream.step()
                obs[t + 1, n], reward[t, n], terminated[t, n], truncated[t, n] = row.leads_to, *row[:3]
                if valid[t, n]:
                    action[t, n] = int(began) % 7
        fresh, self._fresh[lane] = self._fresh[lane], False
        resets = np.concatenate([np.zeros((1, N), bool), terminated | truncated]) if self._with_seats else None
        return Batch(
            obs=(obs,),
            action=action,
            log_prob=np.zeros((T, N), np.float32),
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            valid=valid,
            state=np.zeros((N, 0), np.float32),
            lane=np.full(N, lane),
            fresh=np.full(N, fresh),
            columns_per_rollout=N,
            episodes=(),
            resets=resets,
        )

    def used(self, batch: Batch) -> Batch:
        """The batch, its valid rows counted as given away."""
        for t, n in np.argwhere(batch.valid):
            self.rows[float(batch.obs[0][t, n, 0])] = Row(
                float(batch.reward[t, n]),
                bool(batch.terminated[t, n]),
                bool(batch.truncated[t, n]),
                float(batch.obs[0][t + 1, n, 0]),
            )
        return batch

    def slow_sum(self, began: float, n_step: int) -> tuple[float, float, float]:
        """Reward, discount and where it leads: what the definition says, a step at a time."""
        total, at = 0.0, began
        for k in range(n_step):
            row = self.rows[at]
            total += GAMMA**k * row.reward
            at = row.leads_to
            if row.terminated:
                return total, 0.0, at
            if row.truncated or at not in self.rows:
                return total, GAMMA ** (k + 1), at
        return total, GAMMA**n_step, at


def side_by_side(*batches: Batch) -> Batch:
    """Rollouts as one batch, in this order."""
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(batch, name) for batch in batches], 1)
        for name in ("action", "log_prob", "reward", "terminated", "truncated", "valid")
    }
    joined["obs"] = tuple(np.concatenate(leaves, 1) for leaves in zip(*(batch.obs for batch in batches), strict=True))
    joined |= {name: np.concatenate([getattr(batch, name) for batch in batches]) for name in ("state", "lane", "fresh")}
    return msgspec.structs.replace(batches[0], **joined)


def replay(size: int = 1000, n_step: int = 1, alpha: float | None = None, seed: int = 0) -> ReplayBuffer:
    return ReplayBuffer(OBS, size=size, n_step=n_step, gamma=GAMMA, seed=seed, alpha=alpha)


def filled(lanes: Lanes, into: ReplayBuffer, rollouts: int = 4) -> ReplayBuffer:
    for _ in range(rollouts):
        into.add(side_by_side(*(lanes.used(lanes.rollout(lane)) for lane in (0, 1))))
    return into


def check(sample: Sample, lanes: Lanes, n_step: int) -> set[float]:
    """Every transition drawn is what the definition says; where they began."""
    began = dict(zip(sample.leaves[0][:, 0].tolist(), range(len(sample.slots)), strict=True))
    for key, i in began.items():
        reward, discount, leads_to = lanes.slow_sum(key, n_step)
        assert sample.reward[i] == pytest.approx(reward, abs=1e-4)
        assert sample.discount[i] == pytest.approx(discount)
        assert sample.action[i] == int(key) % 7
        if discount:
            assert sample.next_leaves[0][i, 0] == leads_to
    return set(began)


@examples(80)
@given(
    seed=st.integers(0, 2**32),
    T=st.integers(1, 6),
    n_step=st.integers(1, 7),
    ends=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
    waits=st.sampled_from([0.0, 0.3, 0.8]),
    alpha=st.sampled_from([None, 0.5]),
    fates=st.lists(st.tuples(st.integers(0, 1), st.sampled_from(["use", "use", "use", "drop", "restart"])), min_size=1),
)
def test_n_steps_are_the_slow_sum(
    seed: int, T: int, n_step: int, ends: float, waits: float, alpha: float | None, fates: list[tuple[int, str]]
) -> None:
    """Whatever ends and waits where; rollouts of a lane dropped between, the lane begun anew, a lane twice in a batch."""
    lanes, kept = Lanes(seed, T=T, ends=ends, waits=waits), replay(n_step=n_step, alpha=alpha)
    waiting: list[Batch] = []
    for lane, fate in fates:
        if fate == "restart":
            lanes.restart(lane)
        rollout = lanes.rollout(lane)
        if fate != "drop":
            waiting.append(lanes.used(rollout))
        if len(waiting) == 2:
            kept.add(side_by_side(*waiting))
            waiting = []
    for batch in waiting:
        kept.add(batch)
    assert len(kept) == len(lanes.rows)
    if lanes.rows:
        count = 60 * len(lanes.rows)
        assert check(kept.sample(count), lanes, n_step) == set(lanes.rows)


@examples(30)
@given(
    seed=st.integers(0, 2**32),
    n_step=st.integers(1, 5),
    size=st.integers(30, 45),
    waits=st.sampled_from([0.0, 0.5]),
    alpha=st.sampled_from([None, 1.0]),
)
def test_a_full_ring_keeps_the_newest_and_breaks_no_chain(
    seed: int, n_step: int, size: int, waits: float, alpha: float | None
) -> None:
    size += 60 if waits else 0  # room for what other seats do while one waits its longest
    lanes, kept = Lanes(seed, waits=waits), replay(size, n_step, alpha)
    for _ in range(8):
        filled(lanes, kept, 5 if waits else 1)
        found = check(kept.sample(1500), lanes, n_step)
        assert len(found) == len(kept) <= size
        newest = sorted(lanes.rows)[-1]
        assert newest in found
    assert len(kept) >= size // 2 - 4  # but for final observations, each after a row of its own, and the newest ones
    assert min(lanes.rows) not in found


@pytest.mark.parametrize(("alpha", "at_once", "draws"), [(None, 1 << 20, 1), (None, 0, 7), (1.0, 1 << 20, 7)])
def test_minibatches_are_drawn_together_where_that_is_cheaper(
    alpha: float | None, at_once: int, draws: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "DRAWN_AT_ONCE", at_once)
    lanes, kept = Lanes(1), replay(n_step=3, alpha=alpha)
    filled(lanes, kept, 8)
    same = copy.deepcopy(kept)
    found = list(kept.samples(7, 20))
    whole = [same.sample(7 * 20 // draws) for _ in range(draws)]
    assert [len(each.slots) for each in found] == [20] * 7
    np.testing.assert_array_equal(
        np.concatenate([each.slots for each in found]), np.concatenate([each.slots for each in whole])
    )
    for each in found:
        check(each, lanes, 3)
    assert list(kept.samples(0, 20)) == []


@pytest.mark.parametrize("others", [2, 4])  # it is overwritten by the very rollout that would go on from it; was so before
def test_a_copy_whose_newest_observation_is_overwritten_begins_a_new_chain(others: int) -> None:
    lanes = Lanes(0, ends=0.0)
    kept = replay(size=25, n_step=4)
    first = lanes.used(lanes.rollout(0))
    kept.add(first)
    for _ in range(others):
        kept.add(lanes.used(lanes.rollout(1)))
    again = lanes.used(lanes.rollout(0))  # begins where the first ended; that slot is another's by now
    kept.add(again)
    found = check(kept.sample(1000), lanes, 4)
    assert set(again.obs[0][:-1].ravel().tolist()) <= found
    assert len(found) == len(kept)


def test_a_fresh_lane_cuts_even_where_observations_are_the_same() -> None:
    lanes, kept = Lanes(0, lanes=1, copies=1, T=2, ends=0.0), replay(n_step=4)
    first, second = lanes.rollout(0), lanes.rollout(0)
    kept.add(first)
    kept.add(msgspec.structs.replace(second, fresh=np.ones(1, bool)))
    drawn = kept.sample(100)
    began = drawn.leaves[0][:, 0] == first.obs[0][0, 0, 0]
    assert drawn.discount[began] == pytest.approx(GAMMA**2)
    assert (drawn.next_leaves[0][began] == first.obs[0][2, 0, 0]).all()
    going_on = replay(n_step=4)
    going_on.add(first)
    going_on.add(second)
    drawn = going_on.sample(100)
    assert drawn.discount[drawn.leaves[0][:, 0] == first.obs[0][0, 0, 0]] == pytest.approx(GAMMA**4)


def test_a_fresh_lane_may_have_more_copies_than_it_had() -> None:
    kept = replay()
    for copies in (2, 3):
        kept.add(Lanes(copies, lanes=1, copies=copies, T=2, ends=0.0).rollout(0))
    assert len(kept) == 2 * (2 + 3)


def test_nothing_goes_on_from_an_end_even_where_observations_are_the_same() -> None:
    """The rollout that reset the copy was dropped, and the next one begins as the truncated episode ended."""
    lanes, kept = Lanes(0, lanes=1, copies=1, T=2, ends=0.0), replay(n_step=4)
    first, second = lanes.rollout(0), lanes.rollout(0)
    first.truncated[-1] = True
    kept.add(first)
    kept.add(second)
    drawn = kept.sample(100)
    assert drawn.discount[drawn.leaves[0][:, 0] == first.obs[0][0, 0, 0]] == pytest.approx(GAMMA**2)
    assert len(kept) == 4


@pytest.mark.parametrize("waits", [0.0, 0.5, 0.9])
def test_an_observation_stands_once_and_only_where_it_is_needed(waits: float) -> None:
    """One slot for each row, for each end by the clock alone, and for the newest observation of each copy that goes on."""
    lanes, kept = Lanes(4, ends=0.3, waits=waits), replay()
    rows = clocks = 0
    goes_on = np.zeros(4, bool)
    for _ in range(5):
        batch = side_by_side(lanes.rollout(0), lanes.rollout(1))
        kept.add(batch)
        rows += int(np.count_nonzero(batch.valid))
        clocks += int(np.count_nonzero(batch.truncated & ~batch.terminated))
        for valid, ended in zip(batch.valid, batch.terminated | batch.truncated, strict=True):
            goes_on = np.where(valid, ~ended, goes_on & (waits > 0))
        assert kept._written == rows + clocks + np.count_nonzero(goes_on)


@pytest.mark.parametrize("alpha", [None, 0.6])
def test_rows_that_are_not_valid_are_never_kept(alpha: float | None) -> None:
    lanes = Lanes(3, ends=0.3)
    kept = filled(lanes, replay(alpha=alpha), 10)
    drawn = kept.sample(5000)
    assert not (drawn.action == RUBBISH).any()
    assert np.abs(drawn.reward).max() <= 5
    assert set(drawn.leaves[0][:, 0].tolist()) == set(lanes.rows)


def test_a_batch_without_a_valid_row_adds_nothing() -> None:
    lanes, kept = Lanes(0), replay()
    rollout = lanes.rollout(0)
    kept.add(msgspec.structs.replace(rollout, valid=np.zeros_like(rollout.valid)))
    assert len(kept) == 0


# -------------------------------------------------------------------- drawing


def priorities(errors: dict[float, float], alpha: float) -> tuple[ReplayBuffer, npt.NDArray[np.int64]]:
    """A replay of transitions with these errors, by the observations they begin with; and the slots."""
    lanes, kept = Lanes(0, lanes=1, copies=1, T=len(errors), ends=0.0), replay(alpha=alpha)
    rollout = lanes.rollout(0)
    rollout.obs[0][:-1, 0, 0] = list(errors)
    kept.add(rollout)
    drawn = kept.sample(100)
    kept.update_priorities(drawn.slots, np.array([errors[key] for key in drawn.leaves[0][:, 0]], np.float32))
    return kept, drawn.slots


def test_transitions_are_drawn_in_proportion_to_their_priorities_and_weighted_against_it() -> None:
    errors, alpha, beta = {1.0: 0.5, 2.0: -1.0, 3.0: 2.0, 4.0: 4.0}, 0.7, 0.4
    kept, _ = priorities(errors, alpha)
    drawn = kept.sample(20_000, beta)
    began = drawn.leaves[0][:, 0]
    chance = np.abs(list(errors.values())) ** alpha
    chance /= chance.sum()
    weight = (4 * chance) ** -beta
    for key, p, w in zip(errors, chance, weight / weight.max(), strict=True):
        assert (began == key).mean() == pytest.approx(p, abs=1e-3)  # strata: far nearer than chance would come
        assert drawn.weight[began == key] == pytest.approx(w, rel=1e-4)
    unweighted = kept.sample(100, beta=0.0)
    assert unweighted.weight == pytest.approx(1.0)


def test_what_is_new_gets_the_highest_priority_ever_seen() -> None:
    kept, _ = priorities({1.0: 0.1, 2.0: 3.0}, alpha=1.0)
    kept.add(Lanes(5, lanes=1, copies=1, T=1, ends=0.0).rollout(0))
    kept.update_priorities(kept.sample(50).slots, np.full(50, 1e-3, np.float32))
    kept.add(Lanes(6, lanes=1, copies=1, T=1, ends=0.0).rollout(0))
    drawn = kept.sample(1000)
    newest = drawn.slots == drawn.slots.max()
    assert newest.mean() == pytest.approx(3 / 3.003, abs=2e-3)


def test_uniform_draws_are_uniform() -> None:
    lanes = Lanes(1, ends=0.4)
    kept = filled(lanes, replay(), 3)
    drawn = kept.sample(len(kept) * 1000)
    _, counts = np.unique(drawn.slots, return_counts=True)
    assert len(counts) == len(kept)
    assert np.abs(counts / 1000 - 1).max() < 6 / math.sqrt(1000)
    assert (drawn.weight == 1).all()


@examples(100)
@given(data=st.data(), size=st.integers(1, 40))
def test_a_sum_tree_is_the_sum_of_its_leaves_and_finds_each_by_its_weight(data: st.DataObject, size: int) -> None:
    tree, expected = SumTree(size), np.zeros(max(size, 2))
    index = st.lists(st.integers(0, size - 1), min_size=1, max_size=10)
    for _ in range(data.draw(st.integers(1, 5))):
        at = np.array(data.draw(index))
        weight = np.array(data.draw(st.lists(st.integers(0, 9), min_size=len(at), max_size=len(at))), float)
        tree.set(at, weight)
        expected[at] = weight
        assert tree.weights.tolist() == expected.tolist()
        nodes = tree._nodes
        inner = np.arange(1, max(size, 2))
        assert (nodes[inner] == nodes[2 * inner] + nodes[2 * inner + 1]).all()
        assert tree.total == expected.sum()
    if tree.total:
        found = tree.find(np.arange(tree.total) + 0.5)
        assert np.bincount(found, minlength=len(expected)).tolist() == expected.tolist()
        assert expected[tree.find(np.array([0.0, math.nextafter(tree.total, 0), tree.total]))].all()


# -------------------------------------------------------------------- saving


@pytest.mark.parametrize("alpha", [None, 0.6])
@pytest.mark.parametrize("size", [40, 1000])
def test_a_restored_replay_goes_on_to_the_bit(size: int, alpha: float | None) -> None:
    lanes = Lanes(2)
    first = filled(lanes, replay(size, 3, alpha))
    first.update_priorities(first.sample(9).slots, np.arange(9, dtype=np.float32))
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second = filled(Lanes(7), replay(size, 3, alpha, seed=9), 9)
    second.load_state_dict(torch.load(file, weights_only=True))
    batch = side_by_side(lanes.used(lanes.rollout(0)), lanes.used(lanes.rollout(1)))
    for _ in range(2):
        drawn = [each.sample(50, 0.5) for each in (first, second)]
        for a, b in zip(*drawn, strict=True):
            np.testing.assert_array_equal(a, b)
        for each in (first, second):
            each.update_priorities(drawn[0].slots, np.linspace(0, 3, 50, dtype=np.float32))
            each.add(batch)
        assert len(first) == len(second)
    check(second.sample(500), lanes, 3)


def test_a_saved_state_does_not_change_with_the_replay() -> None:
    lanes = Lanes(2)
    kept = filled(lanes, replay(40, alpha=0.5))
    state = kept.state_dict()
    before = {name: array.clone() for name, array in state["arrays"].items()}
    filled(lanes, kept)
    assert all(torch.equal(array, state["arrays"][name]) for name, array in before.items())


def test_a_state_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="replay_size: expected 50, got 40"):
        replay(40).load_state_dict(replay(50).state_dict())


@pytest.mark.parametrize("dtype", ["bool", "int8", "uint8", "uint16", "uint32", "uint64", "float16", "float64", "int64"])
def test_observations_stay_as_they_are(dtype: str) -> None:
    leaf = Leaf("", "box", (2, 1), dtype)
    kept = ReplayBuffer((leaf, OBS[0]), size=50, n_step=1, gamma=GAMMA, seed=0)
    rollout = Lanes(0, ends=0.0).rollout(0)
    ones = np.ones((5, 2, 2, 1), dtype)
    kept.add(msgspec.structs.replace(rollout, obs=(ones, *rollout.obs)))
    file = io.BytesIO()
    torch.save(kept.state_dict(), file)
    file.seek(0)
    kept.load_state_dict(torch.load(file, weights_only=True))
    drawn = kept.sample(20)
    for leaves in (drawn.leaves, drawn.next_leaves):
        assert leaves[0].dtype == np.dtype(dtype)
        assert (leaves[0] == 1).all()


# -------------------------------------------------------------------- memory


@pytest.mark.parametrize("alpha", [None, 0.5])
def test_the_memory_that_is_foretold_is_what_it_takes(alpha: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    foretold: list[int] = []
    monkeypatch.setattr(Ring, "_check_memory", lambda _, needed: foretold.append(needed))
    observation = (Leaf("", "box", (84, 84, 4), "uint8", divisor=255), Leaf("n", "discrete", (), "int64", (3,), (0,)))
    kept = ReplayBuffer(observation, size=50, n_step=1, gamma=GAMMA, seed=0, alpha=alpha)
    arrays = kept.arrays["row"].nbytes + sum(leaf.nbytes for leaf in kept._obs)
    tree = 0 if kept._priorities is None else kept._priorities.tree._nodes.nbytes
    assert [kept.bytes] == foretold == [arrays + tree]


def test_a_replay_that_does_not_fit_is_refused_before_it_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    def of_images(size: int) -> None:
        ReplayBuffer((Leaf("", "box", (84, 84, 4), "uint8", divisor=255),), size=size, n_step=1, gamma=GAMMA, seed=0)

    monkeypatch.setattr(ring, "available_bytes", lambda: 2 * GIB)
    made: list[object] = []
    with monkeypatch.context() as patched, pytest.raises(UsageError) as refused:
        patched.setattr(np, "zeros", lambda *args: made.append(args))
        of_images(1_000_000)
    assert not made
    line = str(refused.value)
    assert "\n" not in line
    assert "replay_size 1000000: 1000000 transitions take 26.3 GiB" in line
    assert "2.0 GiB of memory are free; take --replay-size 38000 or less" in line
    of_images(38_000)  # its memory is never touched
    with pytest.raises(UsageError):
        of_images(39_000)
    monkeypatch.setattr(ring, "available_bytes", lambda: None)
    of_images(39_000)


def test_a_rollout_that_does_not_fit_is_refused() -> None:
    with pytest.raises(UsageError, match="replay_size 9: a rollout takes up to 10; take --replay-size 10 or more"):
        replay(9).add(Lanes(0).rollout(0))
    replay(10).add(Lanes(0).rollout(0))
