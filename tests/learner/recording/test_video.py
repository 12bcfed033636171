"""Films of games: which episodes are played together, and what the files are called."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from learner.policy_player import PolicyPlayer
from learner.recording import video
from learner.rollouts.evaluation_dealer import PlayedEpisode
from protocol.rollout import Episode


@pytest.mark.parametrize(("teams", "expected"), [(0, [2, 2, 1]), (2, [2, 2, 1]), (3, [3, 2])])
def test_each_team_is_filmed_once_before_one_is_filmed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, teams: int, expected: list[int]
) -> None:
    """The first episode of a plan is played by the first team."""
    together: list[int] = []

    class Played:
        def __init__(self, *args: Any) -> None: ...

        def play(self, count: int, *args: Any, **keywords: Any) -> list[Any]:
            together.append(count)
            return [SimpleNamespace(frames=[], result=PlayedEpisode(Episode(1.0, 1, 0.0), cut=False))] * count

    monkeypatch.setattr(video, "PlayedEpisodes", Played)
    monkeypatch.setattr(video, "_write", lambda path, frames, rate: path.touch())
    described = SimpleNamespace(metadata={"render_modes": ["rgb_array"]}, render_mode="rgb_array")
    player = SimpleNamespace(
        policy=SimpleNamespace(env=SimpleNamespace(id="game")),
        describe=lambda mode: described,
        facts=(),
        teams=tuple((n,) for n in range(teams)),
    )
    _, films = video.record_videos(cast(PolicyPlayer, player), tmp_path, 5, 7, 100, "against-old-")
    assert together == expected
    assert films == [tmp_path / "videos" / f"against-old-seed-7-episode-{n}.mp4" for n in range(5)]
