"""`millrace evaluate --video`: greedy episodes as mp4 files. Workers play and render; this file only encodes.

Rule: the episodes are the first ones that `millrace evaluate` plays with the same seed. A video has every frame, and is
    written atomically. Its name contains the seed and the episode's number, so an episode's new video overwrites its old
    one.
"""

from __future__ import annotations

import os
import sys
import tempfile
import warnings
from pathlib import Path

from millrace.extras.datasets.played_episodes import PlayedEpisodes
from millrace.learner.policy_player import PolicyPlayer
from millrace.learner.rollouts.evaluation_dealer import PlayedEpisode, episode_seeds, evaluation_of
from millrace.learner.run_folder.regular_files import subfolder
from millrace.learner.run_folder.results import Evaluation
from millrace.playing import RecordVideos
from millrace.protocol.arrays import Array
from millrace.protocol.errors import EnvironmentFailed, RunError, UsageError, first_line

AT_ONCE = 2  # number of episodes that are in memory at the same time, with their frames
LONGEST_EPISODE = 20_000  # env steps; the worker sends frames of the first 1,500
FRAMES_PER_S = 30  # used if the environment's metadata has no render_fps
# Bounds on the frame rate that a worker reports for its environment. moviepy writes two decimals.
LEAST_FRAMES_PER_S = 0.01
MOST_FRAMES_PER_S = 1_000
FOLDER = "videos"


def prepare_videos() -> RecordVideos:
    """Let pygame render without a screen, and return `record_videos`. Call it before workers start.

    Raises `UsageError` if videos can't be made.
    """
    try:
        import moviepy  # noqa: F401
    except ImportError as error:
        raise UsageError("videos need moviepy; pip install moviepy pygame-ce") from error
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    return record_videos


def record_videos(
    player: PolicyPlayer, run: Path, episodes: int, seed: int, max_steps: int, prefix: str = ""
) -> tuple[Evaluation, list[Path]]:
    """Let the workers of `player` play episodes, and write a video of each. Names of videos begin with `prefix`.

    `seed`: seed of the episodes; see `EvaluationPlan.of`. `max_steps`: limit on the env steps of all episodes together; each
    episode gets an equal share, but at most `LONGEST_EPISODE`. Returns the evaluation and the paths of the videos. Raises
    `UserFacingError`, with a one-line message, if videos can't be made.
    """
    env_id = player.run.env.id
    env = player.describe("rgb_array")
    modes = env.metadata.get("render_modes", [])
    if env.render_mode != "rgb_array" or not isinstance(modes, list | tuple) or "rgb_array" not in modes:
        raise UsageError(f"environment {env_id} cannot be filmed: expected it to render rgb_array, got {modes}")
    frames_per_s = env.metadata.get("render_fps")
    if not (isinstance(frames_per_s, int | float) and LEAST_FRAMES_PER_S <= frames_per_s <= MOST_FRAMES_PER_S):
        frames_per_s = FRAMES_PER_S
    folder = run / FOLDER
    episodes_played = PlayedEpisodes(player, episode_seeds(seed, episodes))
    longest = min(LONGEST_EPISODE, max(1, max_steps // episodes))
    results: list[PlayedEpisode] = []
    videos: list[Path] = []
    try:
        subfolder(run, FOLDER)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".new-") as new:
            while len(results) < episodes:
                at_once = max(AT_ONCE, len(player.run.teams))  # a plan divides its episodes among the teams
                count = min(at_once, episodes - len(results))
                for one in episodes_played.play(count, longest, frames=True):
                    video = Path(new, f"{prefix}seed-{seed}-episode-{len(results)}.mp4")
                    _write(video, one.frames, frames_per_s)
                    videos.append(video)
                    results.append(one.result)
            videos = [video.replace(folder / video.name) for video in videos]
    except EnvironmentFailed as error:
        if "DependencyNotInstalled" in str(error):
            missing = str(error).rpartition("DependencyNotInstalled: ")[2].partition(";")[0]
            line = f"environment {env_id} cannot be filmed: {missing}; pip install moviepy pygame-ce"
            raise UsageError(line) from error
        raise
    except OSError as error:
        raise RunError(f"videos of run {run} were not written: {error.strerror or first_line(error)}") from error
    return evaluation_of(results, player.run.facts), videos


def _write(path: Path, frames: list[Array], frames_per_s: float) -> None:
    """Encode each of these frames [H, W, 3] once.

    moviepy's own clips have a length in seconds; rounding it would lose the last frame.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # packages that moviepy uses give warnings
        from moviepy.video.io.ffmpeg_writer import FFMPEG_VideoWriter
    height, width, _ = frames[0].shape
    with FFMPEG_VideoWriter(str(path), (width, height), frames_per_s) as writer:
        encoder = writer.proc
        for frame in frames:
            writer.write_frame(frame)
    if encoder.returncode:
        raise OSError(f"ffmpeg ended with exit code {encoder.returncode}")
