"""Atari games with the preprocessing of Mnih et al. (2015): every fourth screen, grayscale, 84 × 84, the last four.

Rule: an observation is a stack of screens [4, 84, 84], whichever program steps the game. A single game, the vectorized
form of the emulator and envpool differ only in their random numbers, and in the frames before an episode's first screen:
zeros, except that envpool repeats the first screen. An episode starts with up to 30 no-op actions. Rewards are not clipped.
"""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation

FRAMES, SKIP, SIDE, NOOPS = 4, 4, 84, 30
MAX_FRAMES = 108_000  # in an episode: half an hour of play


def make_game(game: str = "Pong", repeat_action_probability: float = 0.0, **options: Any) -> gymnasium.Env[Any, Any]:
    """One env copy. `options` are further arguments of `gymnasium.make`. Needs ale-py and OpenCV."""
    _silence_emulator()
    sticky: dict[str, Any] = {
        "repeat_action_probability": repeat_action_probability,
        "max_num_frames_per_episode": MAX_FRAMES,
    }
    env = gymnasium.make(f"ale_py:ALE/{game}-v5", frameskip=1, disable_env_checker=True, **sticky, **options)
    return FrameStackObservation(AtariPreprocessing(env, NOOPS, SKIP, SIDE), FRAMES, padding_type="zero")


def make_games(num_envs: int, game: str = "Pong", repeat_action_probability: float = 0.0) -> Any:
    """`num_envs` copies that the emulator steps together; in one thread, because there is a worker for each core."""
    _silence_emulator()
    return gymnasium.make_vec(
        f"ale_py:ALE/{game}-v5",
        num_envs,
        "vector_entry_point",
        frameskip=SKIP,
        repeat_action_probability=repeat_action_probability,
        max_num_frames_per_episode=MAX_FRAMES,
        noop_max=NOOPS,
        use_fire_reset=False,
        reward_clipping=False,
        num_threads=1,
    )


def _silence_emulator() -> None:
    """Otherwise the emulator prints its name and version in every process."""
    import ale_py

    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)


def _envpool(game: str = "Pong", repeat_action_probability: float = 0.0) -> tuple[str, dict[str, Any]]:
    """Name and options of the game in envpool."""
    options = {"noop_max": NOOPS, "use_fire_reset": False, "repeat_action_probability": repeat_action_probability}
    return f"{game}-v5", {**options, "frame_skip": SKIP, "stack_num": FRAMES, "max_episode_steps": MAX_FRAMES // SKIP}


make_game.envpool = _envpool  # type: ignore[attr-defined]  # for protocol/envs/envpool.py
