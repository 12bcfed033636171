"""Videos of games: which episodes are played together, and what the files are called."""

from __future__ import annotations

import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from millrace.extras.datasets import video
from millrace.learner.policy_player import PolicyPlayer
from millrace.learner.rollouts.evaluation_dealer import PlayedEpisode
from millrace.protocol.rollout import Episode


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
        describe=lambda mode: described,
        run=SimpleNamespace(env=SimpleNamespace(id="game"), facts=(), teams=tuple((n,) for n in range(teams))),
    )
    _, films = video.record_videos(cast(PolicyPlayer, player), tmp_path, 5, 7, 100, "against-old-")
    assert together == expected
    assert films == [tmp_path / "videos" / f"against-old-seed-7-episode-{n}.mp4" for n in range(5)]


@pytest.mark.parametrize(
    ("number", "rate"),
    [
        *((number, 30) for number in (1, 2, 3, 10, 49, 100)), *((number, 50) for number in (21, 58)),
        (7, 29.97), (23, 12.5), (3, 0.01), (50, 1000), (200, 15), (101, 60),
    ],
)  # fmt: skip
def test_a_film_has_each_frame_once(tmp_path: Path, number: int, rate: float) -> None:
    """Each is brighter than the one before, so that the last one, in which the game ends, is known."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    pytest.importorskip("moviepy")
    shades = np.linspace(20, 230, number).astype(np.uint8)
    film = tmp_path / "film.mp4"
    video._write(film, [np.full((16, 32, 3), shade, np.uint8) for shade in shades], rate)
    decode = [ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", film, "-fps_mode", "passthrough", "-f", "rawvideo"]
    decoded = subprocess.run([*decode, "-pix_fmt", "gray", "-"], capture_output=True, timeout=60, check=True).stdout
    frames = np.frombuffer(decoded, np.uint8).reshape(-1, 16, 32)
    assert len(frames) == number
    # shades of limited range, 16 to 235, which the encoder changes by a few
    assert np.abs(frames.mean((1, 2)) - shades).max() <= 10


def test_what_ends_the_encoder_is_an_error(tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    with pytest.raises(OSError, match=r"(?i)ffmpeg"):
        video._write(tmp_path / "no such folder" / "film.mp4", [np.zeros((16, 16, 3), np.uint8)] * 2, 30)
