"""Atari games as Mnih et al. (2015) show them to a network: each fourth screen, grey, 84 × 84, the last four of them.

The law: one stack of screens [4, 84, 84], whoever steps the game. A game alone, the emulator's vectorised form and envpool
differ in nothing but their random numbers, and in what stands before an episode's first screen (nothing; envpool repeats
it). Up to 30 screens without an action begin an episode; rewards are the game's own.
"""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation

FRAMES, SKIP, SIDE, NOOPS = 4, 4, 84, 30
MAX_FRAMES = 108_000  # of an episode: half an hour of play


def make_game(game: str = "Pong", repeat_action_probability: float = 0.0, **options: Any) -> gymnasium.Env[Any, Any]:
    """One copy; `options` are those of `gymnasium.make`. Needs ale-py and OpenCV."""
    _quiet()
    sticky: dict[str, Any] = {
        "repeat_action_probability": repeat_action_probability,
        "max_num_frames_per_episode": MAX_FRAMES,
    }
    env = gymnasium.make(f"ale_py:ALE/{game}-v5", frameskip=1, disable_env_checker=True, **sticky, **options)
    return FrameStackObservation(AtariPreprocessing(env, NOOPS, SKIP, SIDE), FRAMES, padding_type="zero")


def make_games(num_envs: int, game: str = "Pong", repeat_action_probability: float = 0.0) -> Any:
    """So many copies, stepped at once by the emulator's own code; in one thread, for there is a worker for each core."""
    _quiet()
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


def _quiet() -> None:
    """The emulator says who it is in every process, unless it is told not to."""
    import ale_py

    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)


def _envpool(game: str = "Pong", repeat_action_probability: float = 0.0) -> tuple[str, dict[str, Any]]:
    """What envpool calls it, and its options there."""
    options = {"noop_max": NOOPS, "use_fire_reset": False, "repeat_action_probability": repeat_action_probability}
    return f"{game}-v5", {**options, "frame_skip": SKIP, "stack_num": FRAMES, "max_episode_steps": MAX_FRAMES // SKIP}


make_game.envpool = _envpool  # type: ignore[attr-defined]  # for protocol/envs/envpool.py
