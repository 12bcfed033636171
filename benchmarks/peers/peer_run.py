"""Shared by the programs of all peers: reading settings, reporting each update, and finding out when the task is solved.

Rule: the same code evaluates all peers, with greedy episodes, as often as millrace evaluates. The time of these evaluations
is included in a peer's time, as it is in millrace's.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

Greedy = Callable[[NDArray[np.float32]], NDArray[np.int64]]
"""Takes observations [B, *obs], and returns greedy actions [B]."""
FIRST_SEED = 1000


class PeerRun:
    """Reports the progress of a run to the benchmark, as lines of output."""

    def __init__(self, argv: list[str] | None = None) -> None:
        parser = argparse.ArgumentParser()
        parser.add_argument("settings", type=json.loads)
        parser.add_argument("--target", type=float, help="stop as soon as a greedy evaluation averages at least this")
        parser.add_argument("--how", default="", help="the way of collecting or the settings, for a peer that has several")
        arguments = parser.parse_args(argv)
        self.settings: dict[str, Any] = arguments.settings
        self.how: str = arguments.how
        self._target: float | None = arguments.target
        self.until_solved = self._target is not None
        self._due = self.settings["eval_every"]  # env steps at which the next evaluation is due

    def update(self, env_steps: int, greedy: Greedy) -> bool:
        """Report an update. Returns whether the run must end, because the task is solved or all steps are done."""
        print(json.dumps({"env_steps": env_steps, "at_s": time.monotonic()}), flush=True)
        if self._target is not None and env_steps >= self._due:
            self._due = (env_steps // self.settings["eval_every"] + 1) * self.settings["eval_every"]
            found = mean_return(self.settings["env"], self.settings["eval_episodes"], greedy)
            if found >= self._target:
                print(json.dumps({"solved": found, "at_s": time.monotonic()}), flush=True)
                return True
        return env_steps >= int(self.settings["steps"])


def mean_return(env_id: str, episodes: int, greedy: Greedy) -> float:
    """The mean return of this many greedy episodes, which are played at the same time."""
    copies: list[gymnasium.Env[Any, Any]] = [gymnasium.make(env_id) for _ in range(episodes)]
    obs = [copy.reset(seed=FIRST_SEED + lane)[0] for lane, copy in enumerate(copies)]
    total = 0.0
    playing = list(range(episodes))
    while playing:
        actions = greedy(np.stack([obs[lane] for lane in playing]).astype(np.float32))
        for lane, action in zip(list(playing), actions, strict=True):
            obs[lane], reward, terminated, truncated, _ = copies[lane].step(int(action))
            total += float(reward)
            if terminated or truncated:
                playing.remove(lane)
    for copy in copies:
        copy.close()
    return total / episodes


def scheduled(settings: dict[str, Any], name: str, env_steps: int) -> float:
    """The value of a hyperparameter with a schedule after this many env steps."""
    value = float(settings[name])
    return value * max(0.0, 1.0 - env_steps / settings["steps"]) if settings[f"{name}_schedule"] == "linear" else value
