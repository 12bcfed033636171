"""What a learner refuses of the rows of seats, whoever made them. Each refusal is one line, which names step, copy and seat.

Here a letter is what one step is for a seat: `v` a valid row, `e` a valid row that ends its part of the episode, `.` no row,
`R` a step that only resets the copy. `E` is an end without a valid row, `V` a valid row in a step that resets.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
import numpy as np
import pytest

from millrace.learner.shards.division import part_of
from millrace.protocol.arrays import Array
from millrace.protocol.bounds import MAX_FACTS, MAX_NAME
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import BadRollout
from millrace.protocol.messages import Permit, Weights
from millrace.protocol.rollout import Episode, Rollout, stack_rollouts
from millrace.protocol.rows.rollout_checks import LARGEST_REWARD, validate, wrong_facts
from millrace.protocol.specs import ActionSpec, ExtraArray, Leaf, PolicySpec, RunSpec, seat_returns
from millrace.workers.opponents import whole_episode
from tests.support.conversation.example_messages import example
from tests.support.in_process.collectors import SESSION, VERSION, no_pulse, random_collector, random_weights
from tests.workers.collect.test_seat_rows import FORMS, collected, seated_run

LAW = {
    form: re.compile(rf"({closed}R)?((?!R){closed}R)*{running}")
    for form, closed, running in (
        ("turns", r"(\.*|[v.]*e\.*)", r"[v.]*(e\.*)?"),
        ("together", r"(\.*|\.*v*e\.*)", r"\.*v*(e\.*)?"),
    )
}
"""What the letters of a seat may be in one rollout, with an `R` behind them if the next rollout begins with a reset."""
RESETS, ENDS, VALID = "RV", "eE", "veV"


def letters(rollout: Rollout, seats: int) -> list[str]:
    """Those of each column."""
    assert rollout.resets is not None
    ended, columns = rollout.terminated | rollout.truncated, []
    for column, valid in enumerate(rollout.valid.T):
        resets = rollout.resets[:, column // seats]
        found = [
            {(0, 0, 0): ".", (1, 0, 0): "v", (1, 1, 0): "e", (0, 0, 1): "R"}.get(step, "X")
            for step in zip(valid.tolist(), ended[:, column].tolist(), resets[:-1].tolist(), strict=True)
        ]
        columns.append("".join(found) + "R" * int(resets[-1]))
    return columns


def with_as_many_episodes(rollout: Rollout, run: RunSpec) -> Rollout:
    """The rollout, with an episode for each reset that follows one of its steps."""
    assert rollout.resets is not None
    episode = Episode(0.0, 1, 0.0, (math.nan,) * len(run.facts))
    if run.teams:
        episode = Episode(0.0, 1, 0.0, (*episode.facts[1:], 0.5), 0)
    return msgspec.structs.replace(rollout, episodes=(episode,) * np.count_nonzero(rollout.resets[1:]))


def flipped(rollout: Rollout) -> Iterator[Rollout]:
    """The rollout with one other flag, for each flag that it has."""
    for name in ("valid", "terminated", "truncated", "resets"):
        flags = getattr(rollout, name)
        for index in np.ndindex(flags.shape):
            other = flags.copy()
            other[index] = not other[index]
            yield msgspec.structs.replace(rollout, **{name: other})


def refusal(rollout: Rollout, run: RunSpec) -> str:
    """What the learner says of it; nothing if it takes it."""
    try:
        validate(rollout, run)
    except BadRollout as error:
        return str(error)
    return ""


def against_opponents(run: RunSpec, number: int) -> list[Rollout]:
    """Rollouts of a lane whose copies the policy shares with opponents."""
    collector, held = random_collector(run), {VERSION: Weights(VERSION, *random_weights(run.policy))}
    asked = ([Permit(100, 0, 0, k, k, opponent=VERSION)] for k in range(number))
    return [collector.collect(each, VERSION, SESSION, no_pulse, held)[0] for each in asked]


@pytest.mark.parametrize("teams", [(), ((0,), (1,), (2,))], ids=["all seats", "teams"])
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("T", [1, 2, 11, pytest.param(30, marks=pytest.mark.soak)])
def test_a_flag_that_is_not_the_environments_is_refused_or_could_be(
    form: str, T: int, teams: tuple[tuple[int, ...], ...]
) -> None:
    run, refused, lawful = seated_run(form, T, N=3), 0, 0
    if teams:
        run = msgspec.structs.replace(run, teams=teams)
    rollouts = against_opponents(run, max(6, 120 // T)) if teams else collected(run, max(2, 40 // T))[1]
    place = "column [0-2]" if teams else "copy [0-2], [abc]"
    for rollout in rollouts:
        assert rollout.valid.shape == (T, run.copies * run.sent_seats)
        assert refusal(rollout, run) == ""
        assert all(map(LAW[form].fullmatch, letters(rollout, run.sent_seats)))
        for other in flipped(rollout):
            says = refusal(with_as_many_episodes(other, run), run)
            assert (says == "") == all(map(LAW[form].fullmatch, letters(other, run.sent_seats))), says
            if says:
                assert re.fullmatch(rf"(valid|resets): expected no\S* .*, got one at step \d+, {place}", says)
            refused, lawful = refused + bool(says), lawful + (not says)
    assert min(refused, lawful) > 50


SEATS = ("black", "white")


def run_of(form: str, T: int, copies: int, **changes: Any) -> RunSpec:
    policy = PolicySpec((Leaf("", "box", (1,), "float32"),), ActionSpec("discrete", (), "int64", (2,), (0,)))
    turns = form == "turns"
    run = RunSpec(EnvSpec("Fake-v0"), policy, T, copies, 1, 0, seats=SEATS, takes_turns=turns)
    return msgspec.structs.replace(run, **changes)


def rollout_of(form: str, columns: Sequence[str], **changes: Any) -> tuple[Rollout, RunSpec]:
    """A rollout with these letters, two columns a copy; the last letter says only whether the next step resets.

    With teams, one of the seats is a copy's only column.
    """
    T, C, seats = len(columns[0]) - 1, len(columns), 1 if changes.get("teams") else 2
    run = run_of(form, T, C // seats, **changes)

    def flags(of: str) -> Array:
        return np.array([[letter in of for letter in column] for column in columns]).T

    rollout = example(
        Rollout,
        session=1,
        sequence=5,
        obs=(np.zeros((T + 1, C, 1), np.float32),),
        action=np.zeros((T, C), np.int64),
        log_prob=np.zeros((T, C), np.float32),
        reward=np.zeros((T, C), np.float32),
        terminated=flags(ENDS)[:-1],
        truncated=np.zeros((T, C), bool),
        valid=flags(VALID)[:-1],
        state=np.zeros((C, 0), np.float32),
        resets=flags(RESETS)[:, ::seats],
    )
    return with_as_many_episodes(rollout, run), run


GAP = "valid: expected no gap after a row that has not ended, because no agent waits for others"
EARLY = "resets: expected none before the part of each seat has ended"


@pytest.mark.parametrize(
    ("form", "columns", "says", "place"),
    [
        ("turns", ("v.v.", ".E..", "v...", "v..."), "valid: expected no end in a row that is not valid", (1, 0, "white")),
        ("together", ("eRv.", "eVv."), "valid: expected none in a step that only resets the copy", (1, 0, "white")),
        ("turns", ("ve..", "e.v."), "valid: expected none of a seat whose part of the episode has ended", (2, 0, "white")),
        ("together", ("vvv.", "vvv.", "vvv.", "v.v."), GAP, (1, 1, "white")),
        ("turns", ("v...", "v...", "eRv.", "vRv."), EARLY, (1, 1, "white")),
        ("turns", ("v...", "v...", "v..R", "v.eR"), EARLY, (3, 1, "black")),
        ("turns", ("v...", "v...", "eRR.", "eRR."), "resets: expected none right before another", (1, 1, "black")),
    ],
)
def test_a_false_flag_is_named(form: str, columns: Sequence[str], says: str, place: tuple[int, int, str]) -> None:
    step, copy, seat = place
    assert refusal(*rollout_of(form, columns)) == f"{says}, got one at step {step}, copy {copy}, {seat}"


GOOD = ("v.e.", "...."), ("v.v.", ".v.."), ("eRvv", "eR.v")


@pytest.mark.parametrize("columns", GOOD)
def test_rows_that_keep_the_law_are_taken(columns: tuple[str, str]) -> None:
    assert refusal(*rollout_of("turns", ("v.v.", ".v..", *columns))) == ""


def good(**changes: Any) -> tuple[Rollout, RunSpec]:
    return rollout_of("turns", ("eRv.", "eRv.", "v...", "v..."), **changes)


def test_resets_are_flags_of_each_copy() -> None:
    rollout, run = good()
    assert rollout.resets is not None
    for resets, says in (
        (None, "resets: expected some"),
        (rollout.resets[:-1], r"resets: expected bool\[4, 2\], got bool\[3, 2\]"),
        (rollout.resets[:, :1], r"resets: expected bool\[4, 2\], got bool\[4, 1\]"),
        (np.repeat(rollout.resets, 2, axis=1), r"resets: expected bool\[4, 2\], got bool\[4, 4\]"),
        (rollout.resets.ravel(), r"resets: expected bool\[4, 2\], got bool\[8\]"),
        (rollout.resets.view(np.uint8), r"resets: expected bool\[4, 2\], got uint8\[4, 2\]"),
        ((2 * rollout.resets.view(np.uint8)).view(bool), "resets: expected bytes 0 and 1, got 2"),
    ):
        with pytest.raises(BadRollout, match=says):
            validate(msgspec.structs.replace(rollout, resets=resets), run)
    with pytest.raises(BadRollout, match="resets: expected none"):
        validate(rollout, msgspec.structs.replace(run, seats=(), copies=run.columns))


def test_an_episode_has_one_reset_the_returns_of_all_seats_and_each_fact() -> None:
    rollout, run = good()
    (episode,) = rollout.episodes
    most = 4 * len(SEATS) * LARGEST_REWARD
    for episodes, says in (
        ((), "episodes: expected 1, got 0"),
        ((episode, episode), "episodes: expected 1, got 2"),
        ((Episode(most * 1.001, 4, 0.0, episode.facts),), "episode: expected a finite return"),
        ((Episode(math.nan, 4, 0.0, episode.facts),), "episode: expected a finite return"),
        ((Episode(0.0, 1, 0.0, (math.nan,)),), "episode: expected 2 facts, got 1"),
        ((Episode(0.0, 1, 0.0, (0.0, math.inf)),), "episode: expected finite facts"),
    ):
        assert refusal(msgspec.structs.replace(rollout, episodes=episodes), run).startswith(says)
    validate(msgspec.structs.replace(rollout, episodes=(Episode(most, 4, 0.0, episode.facts),)), run)


TEAMS: dict[str, Any] = {"teams": ((0,), (1,)), "scripted": ("module:program",), "info_keys": ("a",)}


def of_one_team(**changes: Any) -> tuple[Rollout, RunSpec]:
    return rollout_of("turns", ("eRv.", "v...", "v.eR"), **(TEAMS | changes))


def test_with_teams_a_rollout_has_the_columns_of_one_team() -> None:
    rollout, run = of_one_team(masked=True, extras=(ExtraArray("logits", (2,), "float32"),))
    mask, logits = np.ones((4, 3, 2), bool), np.zeros((3, 3, 2), np.float32)
    rollout = msgspec.structs.replace(rollout, mask=mask, extras=(logits,))
    assert refusal(rollout, run) == ""
    flat = {"action": "int64", **dict.fromkeys(("log_prob", "reward"), "float32")}
    flat |= dict.fromkeys(("terminated", "truncated", "valid"), "bool")
    for columns in ([0, 1], [0, 0, 1, 1, 2, 2]):  # a copy is missing; all seats are there
        for name, dtype in flat.items():
            other = msgspec.structs.replace(rollout, **{name: getattr(rollout, name)[:, columns]})
            assert refusal(other, run).startswith(f"{name}: expected {dtype}[3, 3], got {dtype}[3, {len(columns)}]")
        for changes, says in (
            ({"obs": (rollout.obs[0][:, columns],)}, f"float32[4, 3, 1], got float32[4, {len(columns)}, 1]"),
            ({"state": rollout.state[columns]}, f"float32[1, 3, 0], got float32[1, {len(columns)}, 0]"),
            ({"mask": mask[:, columns]}, f"bool[4, 3, 2], got bool[4, {len(columns)}, 2]"),
            ({"extras": (logits[:, columns],)}, f"float32[3, 3, 2], got float32[3, {len(columns)}, 2]"),
        ):
            changed: dict[str, Any] = changes
            assert f": expected {says}" in refusal(msgspec.structs.replace(rollout, **changed), run)


@pytest.mark.parametrize(
    ("opponent", "score", "says"),
    [
        (None, 0.5, "expected an opponent, got None"),
        (-2, 0.5, "expected an opponent from -1, got -2"),
        (-(2**52), 0.5, f"expected an opponent from -1, got {-(2**52)}"),
        *((0, score, f"expected the score 0, 1 or 1/2, got {score}") for score in (0.25, 1 / 3, -1.0, 1.5, math.nan)),
        (0, math.inf, "expected finite facts, got (nan, inf)"),
        *((opponent, score, "") for opponent in (-1, 0, 7) for score in (0.0, 0.5, 1.0)),
    ],
)
def test_with_teams_an_episode_has_an_opponent_and_a_score(opponent: int | None, score: float, says: str) -> None:
    rollout, run = of_one_team()
    first, second = rollout.episodes
    other = msgspec.structs.replace(first, opponent=opponent, facts=(math.nan, score))
    for episodes in ((other, second), (first, other)):
        assert refusal(msgspec.structs.replace(rollout, episodes=episodes), run) == (says and f"episode: {says}")


@pytest.mark.parametrize("score", [0.0, 1 / 3, 0.5, 1.0, 0.25, 2 / 3])
def test_of_three_teams_as_many_as_share_the_first_place_share_the_score(score: float) -> None:
    run = msgspec.structs.replace(of_one_team()[1], seats=tuple("abc"), teams=((0,), (1,), (2,)), info_keys=())
    says = "" if score in (0, 1, 1 / 2, 1 / 3) else f"expected the score 0, 1/n for n from 1 to 3, got {score}"
    assert wrong_facts(Episode(0.0, 1, 0.0, (score,), 0), run) == says


def test_without_teams_an_episode_has_no_opponent() -> None:
    rollout, run = good()
    (episode,) = rollout.episodes
    for opponent in (0, -1):
        other = msgspec.structs.replace(episode, opponent=opponent)
        says = refusal(msgspec.structs.replace(rollout, episodes=(other,)), run)
        assert says == f"episode: expected no opponent, got {opponent}"


def test_a_wrong_value_is_named_by_the_seat_that_it_is_of() -> None:
    rollout, run = good()
    obs, reward, action = rollout.obs[0].copy(), rollout.reward.copy(), rollout.action.copy()
    obs[3, 1], reward[2, 3], action[1, 2] = np.inf, np.nan, 2
    mask = np.ones((4, 4, 2), bool)
    masked = msgspec.structs.replace(run, masked=True)
    forbids, empty = mask.copy(), mask.copy()
    forbids[0, 1, 0] = empty[3, 3] = False
    for changes, of_run, says in (
        ({"obs": (obs,)}, run, "observation: expected finite values, got inf at step 3, copy 0, white"),
        ({"reward": reward}, run, "reward: expected finite values, got nan at step 2, copy 1, white"),
        ({"action": action}, run, "action: expected 0 to 1, got 2 at step 1, copy 1, black"),
        ({"mask": forbids}, masked, "action: expected one that the mask allows at step 0, copy 0, white, got 0"),
        ({"mask": empty}, masked, "mask: expected an allowed choice at step 3, copy 1, white, got none"),
    ):
        changed: dict[str, Any] = changes
        assert refusal(msgspec.structs.replace(rollout, **changed), of_run) == says


def test_the_name_of_a_return_is_as_short_as_a_name_and_hides_nothing() -> None:
    """It names a metric, and policy.json keeps it."""
    (name,) = found = seat_returns(("\u202e" + "a" * (MAX_NAME - 1),))
    assert len(name) == MAX_NAME
    assert name.startswith("return_\\u202eaaa")
    assert run_of("turns", 1, 1, seats=("\u202e" + "a" * (MAX_NAME - 1),)).facts == found


@pytest.mark.parametrize(
    ("info_keys", "seats", "teams", "counted"),
    [
        (2, 0, (), ()),
        (0, 2, (), ("return_0", "return_1")),
        (MAX_FACTS - 2, 2, (), ("return_0", "return_1")),
        (MAX_FACTS - 1, 2, (), ()),
        (0, MAX_FACTS + 1, (), ()),
        (MAX_FACTS - 1, 2, ((0,), (1,)), ("score",)),
    ],
)
def test_the_facts_of_an_episode_are_the_environments_then_the_score_or_the_returns_of_few_agents(
    info_keys: int, seats: int, teams: tuple[tuple[int, ...], ...], counted: tuple[str, ...]
) -> None:
    keys = tuple(f"key{k}" for k in range(info_keys))
    run = run_of("turns", 1, 1, info_keys=keys, seats=tuple(map(str, range(seats))), teams=teams)
    assert run.facts == keys + counted
    returns = tuple(map(float, range(max(1, seats))))
    episode = whole_episode(run, None, 0, returns, 1, 0.0, (0.5,) * info_keys)
    if not teams:
        assert episode.facts == (0.5,) * info_keys + (returns if counted else ())


def test_a_batch_says_which_rows_of_each_column_only_reset_its_copy_and_a_part_keeps_them() -> None:
    columns = "eRv.", "eRv.", "v...", "v..."
    begins = [[letter == "R" for letter in column[:-1]] for column in columns]
    batch = stack_rollouts([rollout_of("turns", columns)[0]])
    assert (batch.columns_per_copy, batch.begins.T.tolist()) == (2, begins)
    for whole_copies in ([0, 1], [2, 3], [2, 3, 0, 1]):
        part = part_of(batch, np.array(whole_copies))
        assert (part.columns_per_copy, part.begins.T.tolist()) == (2, [begins[column] for column in whole_copies])
    alone = msgspec.structs.replace(batch, resets=None)
    assert alone.columns_per_copy == 1
    assert np.array_equal(alone.begins, ~batch.valid)
    assert part_of(alone, np.array([3])).resets is None
