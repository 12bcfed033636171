"""The counter of episodes: whole rollouts are counted as their rows are, wherever rollouts are cut."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from millrace.protocol.arrays import Array, Bools
from millrace.protocol.errors import EnvironmentFailed
from millrace.workers.lanes.running_episodes import EndedEpisode, RunningEpisodes
from tests.support.in_process.collectors import run_of

RUN = msgspec.structs.replace(run_of("CartPole-v1"), info_keys=("speed",))
N = 3
Rows = tuple[Array, Bools]


def rows_with(ends: Sequence[Sequence[bool]]) -> Rows:
    """Rewards [T, N] that add up exactly, and which steps only reset a copy [T+1, N], if episodes end in these steps."""
    resets = np.zeros((len(ends) + 1, N), bool)
    for t, of_step in enumerate(ends):
        resets[t + 1] = np.array(of_step) & ~resets[t]
    reward = np.arange(1, len(ends) * N + 1, dtype=float).reshape(-1, N) / 8
    reward[resets[:-1]] = 0.0
    return reward, resets


def pieces(T: int, cuts: Sequence[int]) -> Iterator[slice]:
    """The rollouts between these cuts."""
    ends = sorted({cut for cut in cuts if cut < T} | {0, T})
    for i in range(len(ends) - 1):
        yield slice(ends[i], ends[i + 1])


def by_rows(reward: Array, resets: Bools) -> tuple[RunningEpisodes, list[EndedEpisode]]:
    counter, found = RunningEpisodes(RUN, N, 0), []
    for t in range(len(reward)):
        counter.add(reward[t, :, None], ~resets[t])
        ending = np.flatnonzero(resets[t + 1]).tolist()
        found += [counter.ended(n, float(t + 1), (t + n / 8,), None) for n in ending]
    return counter, found


STEPS = st.lists(st.lists(st.booleans(), min_size=N, max_size=N), min_size=1, max_size=25)


@given(ends=STEPS, cuts=st.lists(st.integers(1, 24), max_size=4))
def test_rollouts_are_counted_as_their_rows_are(ends: list[list[bool]], cuts: list[int]) -> None:
    reward, resets = rows_with(ends)
    expected, episodes = by_rows(reward, resets)
    counter, found = RunningEpisodes(RUN, N, 0), []
    for piece in pieces(len(reward), cuts):
        facts = {
            (t, n): (piece.start + t + n / 8,) for t, n in np.argwhere(resets[piece.start + 1 : piece.stop + 1]).tolist()
        }
        step_end_s = [t + 1.0 for t in range(piece.start, piece.stop)]
        found += counter.add_rows(reward[piece], resets[piece.start : piece.stop + 1], step_end_s, facts)
    assert found == episodes
    for name in ("returns", "lengths", "began_s"):
        np.testing.assert_array_equal(getattr(counter, name), getattr(expected, name), name)


def test_an_episode_that_no_learner_takes_is_the_environments_fault() -> None:
    counter = RunningEpisodes(RUN, N, None, most_steps=5)
    counter.add(np.full((N, 1), 1e300), np.ones(N, bool))
    with pytest.raises(EnvironmentFailed, match=r"evaluated: copy 2, episode: expected a finite return of 1 to 5"):
        counter.ended(2, 1.0, None, None)
