"""The fold over a lane's rollouts, and what a lane's next owner is told of it."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from millrace.learner.rollouts.lane_history import LaneHistories, LaneHistory
from millrace.learner.rollouts.lanes import MOST_ATTEMPTS, TicketedLane
from millrace.learner.rollouts.past_rollouts import packed, unpacked
from millrace.protocol.bounds import LARGEST
from millrace.protocol.errors import BadRollout
from millrace.protocol.lane_past import EpisodeBegin, LanePast, LastEpisode
from millrace.protocol.messages import Collect, Permit
from millrace.protocol.rollout import Rollout
from millrace.protocol.rows.rollout_checks import validate
from millrace.protocol.wire.codec import decode_to_worker, encode
from tests.support.conversation.fake_ends import fake_rollout, run_spec

A, B, C = bytes([1]), bytes([2]), bytes([3])  # random numbers
HISTORIES = LaneHistories(copies=2, most_steps=100)


def rollout(ends: list[str], begun: tuple[EpisodeBegin, ...] = (), sequence: int = 0, known: bool = True) -> Rollout:
    """Two copies: of each, whether it ends its episode in a row (`e`), is reset in it (`r`), or goes on (`.`).

    The actions count from 10 times the sequence number.
    """
    T = len(ends[0])
    ended = np.array([[letter == "e" for letter in rows] for rows in ends]).T
    resets = np.array([[letter == "r" for letter in rows] for rows in ends]).T
    action = 10 * sequence + np.arange(T, dtype=np.int64)[:, None].repeat(2, 1)
    return replace(
        fake_rollout(0, 0, 0, 0, sequence),
        obs=(np.full((T + 1, 2, 1), sequence, np.float32),),
        action=action,
        terminated=ended,
        truncated=np.zeros((T, 2), bool),
        valid=~resets,
        begun=begun,
        memory=(np.full((2, 2), sequence, np.float64),) if known else (),
    )


def started(*numbers: int) -> tuple[EpisodeBegin, ...]:
    return tuple(EpisodeBegin(n, number, b"") for n, number in enumerate(numbers))


def folded(*rollouts: Rollout, most_steps: int = 100) -> LaneHistory:
    history = LaneHistory.of_nothing(2, most_steps)
    for each in rollouts:
        history.add(each, b"")
    return history


# ------------------------------------------------------------------------------------------------ the fold


def test_an_episode_is_how_it_began_and_the_actions_since() -> None:
    begins = EpisodeBegin(1, 0, A)
    past = folded(rollout(["...", "..."], started(0, 0)), rollout(["...", "er."], (begins,), 1)).past(7)
    assert past.lane == 7
    assert past.copies == (LastEpisode(0, b"", 0, False, steps=6), LastEpisode(0, A, 5, False, steps=1))
    assert past.action[:, 0].tolist() == [0, 1, 2, 10, 11, 12]
    assert past.obs[0].tolist() == [[1], [1]]
    assert past.memory[0].tolist() == [[1, 1]] * 2


def test_an_episode_that_is_over_is_about_to_begin() -> None:
    begins = EpisodeBegin(0, 0, A), EpisodeBegin(1, 0, B)
    past = folded(rollout(["..e", "..e"], begins)).past(0)
    assert past.copies == (LastEpisode(0, A, 0, True), LastEpisode(0, B, 0, True))
    assert len(past.action) == 0
    assert past.repeated_steps == 0


def test_rows_that_are_not_needed_are_dropped_but_for_those_that_reset_a_copy() -> None:
    """Row 2 resets both copies: it decides the attributes with which the episodes begin."""
    begins = EpisodeBegin(0, 0, A), EpisodeBegin(1, 0, B)
    history = folded(
        rollout(["...", "..."], started(0, 0)), rollout([".er", ".er"], begins, 1), rollout(["...", "..."], (), 2)
    )
    past = history.past(0)
    assert [last.first for last in past.copies] == [3, 3]
    assert past.action[:, 0].tolist() == [10, 11, 12, 20, 21, 22]
    assert len(history.rows) == 2


@pytest.mark.parametrize(("most_steps", "repeats"), [(6, True), (5, False), (0, False), (-1, False)])
def test_an_episode_that_is_longer_than_the_limit_is_not_repeated(most_steps: int, repeats: bool) -> None:
    history = folded(rollout(["...", "..."], started(0, 0)), rollout(["...", "..."], (), 1), most_steps=most_steps)
    past = history.past(0)
    assert [last.random for last in past.copies] == [b"" if repeats else None] * 2
    assert past.new_episodes == (0 if repeats else 2)
    assert len(past.action) == (6 if repeats else 0)
    assert len(history.rows) == (2 if repeats else 0)


def test_a_lane_after_a_long_episode_is_repeated_again() -> None:
    begins = EpisodeBegin(0, 0, A), EpisodeBegin(1, 0, B)
    first = rollout(["...", "..."], started(0, 0))
    past = folded(first, rollout(["er.", "er."], begins, 1), most_steps=2).past(0)
    assert [last.random for last in past.copies] == [A, B]
    assert past.repeated_steps == 2


def test_a_worker_that_tells_nothing_cannot_be_continued() -> None:
    first = rollout(["...", "..."], started(0, 0))
    past = folded(first, rollout(["...", "er."], (), 1, known=False)).past(0)
    assert [last.random for last in past.copies] == [None, None]


def test_copies_that_started_anew_are_named() -> None:
    history = folded(rollout(["..", ".."], started(0, 0)))
    assert history.add(rollout(["..", ".."], (EpisodeBegin(1, 3, b""),), 1), b"").tolist() == [False, True]
    assert history.past(0).copies[1] == LastEpisode(3, b"", 2, False, steps=2)


def test_a_worker_cannot_take_numbers_of_starts_back() -> None:
    past = folded(rollout(["..", ".."], started(4, 6)), rollout(["..", ".."], started(1, 7), 1)).past(0)
    assert [last.start for last in past.copies] == [4, 7]


def test_the_numbers_of_starts_do_not_run_out() -> None:
    most = replace(fake_rollout(0, 0, 0, 0, 0), begun=(EpisodeBegin(0, LARGEST // 2, b""),))
    validate(most, run_spec(), 1)
    with pytest.raises(BadRollout, match=r"begun: expected starts up to"):
        validate(replace(most, begun=(EpisodeBegin(0, LARGEST // 2 + 1, b""),)), run_spec(), 1)


def test_an_episode_whose_state_is_no_longer_saved_cannot_be_continued_and_later_ones_are_repeated() -> None:
    first = rollout(["...", "..."], started(0, 0))
    history = folded(replace(first, saved=(0, 1)))
    assert history.past(0).copies == (LastEpisode(0, b"", 0, False, saved=True, steps=3),) * 2
    history.add(rollout(["...", "er."], (EpisodeBegin(1, 0, A),), 1), b"")
    past = history.past(0)
    assert past.copies == (LastEpisode(0, None, 0, False, steps=6), LastEpisode(0, A, 2, False, steps=1))
    assert (past.new_episodes, past.repeated_steps) == (1, 1)
    history.add(replace(rollout(["...", "..."], (), 2), saved=(0, 1)), b"")
    assert history.past(0).new_episodes == 0


def test_attributes_change_where_they_changed() -> None:
    history = LaneHistory.of_nothing(2, 100)
    for number, attributes in enumerate([b"", b"", b"a", b"a", b"b"]):
        history.add(rollout(["..", ".."], started(0, 0) if number == 0 else (), number), attributes)
    assert history.past(0).attributes.by_row() == {4: b"a", 8: b"b"}


def test_a_past_in_which_attributes_often_changed_can_be_sent() -> None:
    """The number of arrays in a message is limited."""
    history = LaneHistory.of_nothing(2, 1000)
    for number in range(300):
        history.add(rollout(["..", ".."], started(0, 0) if number == 0 else (), number), b"%d" % number)
    past = history.past(0)
    order = Collect(1, 0, (Permit(5, 0, 1, 0, 300, None, past),), (), keep=())
    decoded = decode_to_worker(list(encode(order)))
    assert isinstance(decoded, Collect)
    sent = decoded.permits[0].past
    assert sent is not None
    assert sent.attributes.by_row() == {2 * number: b"%d" % number for number in range(300)}
    assert told(LaneHistory.of(sent, 1000).past(0)) == told(past)


ENDS = st.lists(st.booleans(), min_size=3, max_size=3)
ROUNDS = st.lists(st.tuples(ENDS, ENDS, st.sampled_from([b"", b"a", b"b"])), max_size=7)


def letters(ends: list[bool], *, over: bool) -> str:
    """The rows of a copy, whose episode may be `over` when they begin. `ends`: where one ends, unless it is reset."""
    found = ""
    for end in ends:
        found += "r" if over else "e" if end else "."
        over = end and not over
    return found


@given(ROUNDS, st.sets(st.integers(0, 7)), st.sampled_from([3, 7, 100]))
@settings(max_examples=60, deadline=None)
def test_a_history_that_went_through_checkpoints_says_the_same(rounds: Any, resumed: set[int], most_steps: int) -> None:
    """But for rows before the earliest episode, of which a resumed learner may keep more."""
    straight = LaneHistory.of_nothing(2, most_steps)
    through = LaneHistory.of_nothing(2, most_steps)
    over = [False, False]
    for number, (*ends, attributes) in enumerate(rounds):
        rows = [letters(ends[n], over=over[n]) for n in range(2)]
        over = [each.endswith("e") for each in rows]
        newer = [n for n, each in enumerate(rows) if "r" in each or "e" in each[-1]]
        begun = {n: EpisodeBegin(n, 0, b"") for n in range(2) if number == 0}
        begun |= {n: EpisodeBegin(n, 0, bytes([number + 1])) for n in newer}
        each = rollout(rows, tuple(begun.values()), number)
        straight.add(each, attributes)
        through.add(each, attributes)
        if number in resumed:
            through = LaneHistory.of(read(through.past(3)), most_steps)
        assert told(straight.past(3)) == told(through.past(3))


def read(past: LanePast) -> LanePast:
    return unpacked(LanePast, packed(past))


def told(past: LanePast) -> Any:
    """Of each copy, how its episode began, its actions, and the attributes of each."""
    of_row = [b""] * len(past.action)
    for row, packed_attributes in past.attributes.by_row().items():
        of_row[row:] = [packed_attributes] * (len(of_row) - row)
    copies = []
    for n, last in enumerate(past.copies):
        known = last.random is not None
        since = last.first - (1 if last.random and not last.over else 0)
        assert since >= 0
        rows = slice(since, None) if known else slice(0, 0)
        copies.append((last.start, last.random, last.over, past.action[rows, n].tolist(), of_row[rows]))
    return copies, [leaf.tolist() for leaf in past.obs], [each.tolist() for each in past.memory]


# ------------------------------------------------------------------------------------------------ checkpoints


@pytest.mark.parametrize(("most_steps", "repeats"), [(6, True), (5, False), (-1, False)])
def test_the_limit_of_the_run_that_goes_on_decides(most_steps: int, repeats: bool) -> None:
    past = folded(rollout(["...", "..."], started(0, 0)), rollout(["...", "..."], (), 1)).past(0)
    found = LaneHistory.of(read(past), most_steps).past(0)
    assert found.new_episodes == (0 if repeats else 2)
    assert found.repeated_steps == (12 if repeats else 0)


def test_a_run_with_another_number_of_copies_begins_anew_under_numbers_that_were_not_used() -> None:
    past = folded(rollout(["..", ".."], started(3, 5))).past(4)
    history = LaneHistories(copies=3, most_steps=100, pasts=[past]).of(4)
    assert history is not None
    assert history.past(4).copies == (LastEpisode(5, None, 0, False),) * 3
    assert LaneHistories(copies=3, most_steps=100, pasts=[past]).of(3) is None


@given(st.binary(max_size=200))
def test_bytes_that_are_no_records_are_refused(data: bytes) -> None:
    with pytest.raises((ValueError, msgspec.ValidationError)):
        found = unpacked(LanePast, np.frombuffer(data, np.uint8))
        raise ValueError(f"{found} is a record")


NO_ARRAYS = [7, "a", [], ["<f4", [2]], ["<f4", [2], b"1"], ["O", [1], b"12345678"], [[], [], []]]


@pytest.mark.parametrize("array", NO_ARRAYS)
def test_an_array_that_is_none_is_refused(array: Any) -> None:
    empty = ["<i8", [0], b""]
    assert unpacked(LanePast, np.frombuffer(msgspec.msgpack.encode([0, [], empty, [empty] * 3, [], []]), np.uint8))
    record = [0, [], array, [empty] * 3, [], []]
    with pytest.raises((ValueError, msgspec.ValidationError)):
        unpacked(LanePast, np.frombuffer(msgspec.msgpack.encode(record), np.uint8))


# ------------------------------------------------------------------------------------------------ who continues a lane


def test_nothing_has_come_of_a_lane_so_it_begins() -> None:
    assert TicketedLane(0).past(HISTORIES, ()) is None


def test_a_rollout_between_that_was_rejected_ends_what_is_known() -> None:
    lane = TicketedLane(0)
    first, _, third = (rollout(["..", ".."], started(0, 0) if n == 0 else (), n) for n in range(3))
    lane.take(0, first, b"", HISTORIES, from_past=False)
    waiting = lane.past(HISTORIES, [(0, third, b"")])
    assert waiting is not None
    assert [last.random for last in waiting.copies] == [None, None]
    assert lane.take(0, third, b"", HISTORIES, from_past=False).tolist() == [True, True]
    assert lane.history is not None
    assert [last.random for last in lane.history.past(0).copies] == [None, None]


def test_rollouts_that_wait_are_continued() -> None:
    lane = TicketedLane(0)
    lane.take(0, rollout(["..", ".."], started(0, 0)), b"", HISTORIES, from_past=False)
    past = lane.past(HISTORIES, [(0, rollout(["..", ".."], (), n), b"") for n in (1, 2)])
    assert past is not None
    assert past.action[:, 0].tolist() == [0, 1, 10, 11, 20, 21]
    assert lane.history is not None
    assert lane.history.count == 2  # asking changes nothing


def test_a_continued_lane_is_fresh_only_in_copies_that_started_anew() -> None:
    lane = TicketedLane(0)
    assert lane.take(0, rollout(["..", ".."], started(0, 0)), b"", HISTORIES, from_past=False).all()
    goes_on = rollout(["..", ".."], (EpisodeBegin(1, 1, b""),), 0)
    assert lane.take(1, goes_on, b"", HISTORIES, from_past=True).tolist() == [False, True]
    assert lane.take(1, rollout(["..", ".."], (), 1), b"", HISTORIES, from_past=False).tolist() == [False, False]
    assert lane.take(2, rollout(["..", ".."], (), 0, known=False), b"", HISTORIES, from_past=True).all()


@pytest.mark.parametrize("taken", [True, False])
def test_each_failure_and_each_three_losses_take_the_next_number(taken: bool) -> None:
    lane = TicketedLane(0)
    if taken:
        lane.take(0, rollout(["..", ".."], started(4, 6)), b"", HISTORIES, from_past=False)
    numbers: list[list[int] | None] = []
    for failures, losses in ((0, MOST_ATTEMPTS - 1), (0, MOST_ATTEMPTS), (1, 0), (1, MOST_ATTEMPTS), (2, 2 * MOST_ATTEMPTS)):
        lane.failures = failures
        lane.losses = losses
        past = lane.past(HISTORIES, ())
        if past is None or past.copies[0].random is not None:
            numbers.append(None)
            continue
        assert {last.random for last in past.copies} == {None}
        numbers.append([last.start + 1 for last in past.copies])
    first = [4, 6] if taken else [0, 0]
    assert numbers == [None, *([start + more for start in first] for more in (1, 1, 2, 4))]


def test_a_copy_that_could_not_be_continued_does_not_get_the_number_of_its_first_attempt_again() -> None:
    lane = TicketedLane(0)
    lane.take(0, rollout(["..", ".."], started(4, 6), known=False), b"", HISTORIES, from_past=False)
    lane.lost(failed=True)  # of an attempt that began under 5 and 7
    assert next_starts(lane) == [6, 8]


def test_such_a_number_is_not_used_again_if_a_worker_was_lost_before_after_a_rollout() -> None:
    lane = TicketedLane(0, next_sequence=1)
    lane.take(0, rollout(["..", ".."], started(4, 6), known=False), b"", HISTORIES, from_past=False)
    lane.lost(failed=False)
    assert next_starts(lane) == [5, 7]
    lane.next_sequence = 0
    lane.lost(failed=True)  # of the attempt that began under 5 and 7
    assert next_starts(lane) == [6, 8]
    lane.lost(failed=True)
    assert next_starts(lane) == [7, 9]
    lane.went_on()
    lane.next_sequence = 1
    lane.lost(failed=True)
    assert next_starts(lane) == [5, 7], "the history tells of the newest numbers"


def next_starts(lane: TicketedLane) -> list[int]:
    """The start numbers of the next attempt, of copies that can't be continued."""
    past = lane.past(HISTORIES, ())
    assert past is not None
    return [last.start + 1 for last in past.copies]
