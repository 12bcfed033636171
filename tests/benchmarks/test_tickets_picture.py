"""docs/images/tickets.png shows what docs/explanation/tickets.md says about `max_lag`."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.tickets import LANES, busy_share, draw, play

SECONDS = 60.0


@pytest.mark.parametrize("max_lag", [0, 1, 2])
def test_every_lag_up_to_the_bound_occurs(max_lag: int) -> None:
    played = play(max_lag, SECONDS)
    assert set(played.lags) == set(range(max_lag + 1))
    assert len(played.lags) > 10 * LANES


def test_without_lag_they_take_turns() -> None:
    spans = play(0, SECONDS).spans
    updates = [span for span in spans if span.row == LANES]
    lanes = [span for span in spans if span.row < LANES]
    assert all(lane.end_s <= update.start_s or lane.start_s >= update.end_s for lane in lanes for update in updates)
    assert all(span.version == index // LANES for index, span in enumerate(lanes))  # one rollout of every lane


def test_workers_wait_less_with_lag() -> None:
    shares = [busy_share(play(max_lag, SECONDS), range(LANES), SECONDS) for max_lag in (0, 1, 2)]
    assert shares[0] < 0.6 < 0.9 < shares[1] < shares[2]


def test_it_is_drawn(tmp_path: Path) -> None:
    draw(tmp_path / "tickets.png")
    assert (tmp_path / "tickets.png").read_bytes().startswith(b"\x89PNG")
