"""`millrace evaluate --video`: greedy episodes as mp4 files, by gymnasium's RecordVideo, whose packages are optional.

Rule: the folder holds only complete videos. The name of a video has the seed and the number of its episode, so a new video
of the same episode replaces the old one.
"""

from __future__ import annotations

import os
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium

from learner.recording.player import Player
from learner.run_folder.results import Evaluation
from protocol.env_spec import EnvSpec
from protocol.errors import EnvironmentFailed, RunError, UsageError
from protocol.policy.policy import Policy
from protocol.specs import PolicySpec

LONGEST_VIDEO = 1_500  # frames; RecordVideo holds them in memory until it writes the file
LONGEST_EPISODE = 20_000  # env steps
FOLDER = "videos"


def record_videos(
    run: Path, env_spec: EnvSpec, policy: Policy, spec: PolicySpec, episodes: int, seed: int
) -> tuple[Evaluation, list[Path]]:
    """Play greedy episodes and record a video of each.

    Returns the evaluation and the paths of the videos. Raises `UserFacingError`, with a one-line message, if videos cannot
    be made.
    """
    try:
        import moviepy  # noqa: F401
    except ImportError as error:
        raise UsageError("videos need moviepy, which is an extra; pip install 'millrace-rl[video]'") from error
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    folder = run / FOLDER
    try:
        folder.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".new-") as new, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # from packages that gymnasium uses
            evaluation = _play(env_spec, policy, spec, episodes, seed, Path(new, "videos"))
            videos = sorted(Path(new, "videos").glob("*.mp4"), key=lambda path: int(path.stem.rpartition("-")[2]))
            return evaluation, [path.replace(folder / path.name) for path in videos]
    except OSError as error:
        raise RunError(f"videos of run {run} were not written: {error.strerror or error}") from error


def _play(env_spec: EnvSpec, policy: Policy, spec: PolicySpec, episodes: int, seed: int, folder: Path) -> Evaluation:
    env: gymnasium.Env[Any, Any] = env_spec.make(render_mode="rgb_array")
    try:
        modes = env.metadata.get("render_modes", [])
        if env.render_mode != "rgb_array" or "rgb_array" not in modes:
            raise UsageError(f"environment {env_spec.id} cannot be filmed: expected it to render rgb_array, got {modes}")
        env = gymnasium.wrappers.RecordVideo(
            env, str(folder), episode_trigger=lambda _: True, video_length=LONGEST_VIDEO, name_prefix=f"seed-{seed}"
        )
        player = Player(env, policy, spec, seed)
        played, cut = [], 0
        for _ in range(episodes):
            played.append(player.episode(longest=LONGEST_EPISODE))
            cut += player.was_cut
    except EnvironmentFailed as error:
        if isinstance(error.__cause__, gymnasium.error.DependencyNotInstalled):
            line = f"environment {env_spec.id} cannot be filmed: {error.__cause__}; pip install 'millrace-rl[video]'"
            raise UsageError(line) from error
        raise
    finally:
        close: Callable[[], None] = env.close
        close()  # this writes the last video
    return Evaluation.of([episode.episode_return for episode in played], [episode.length for episode in played], cut)
