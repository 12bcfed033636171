"""CartPole whose worker fails once, at a chosen row: the way in which a test has every lane of a run started anew.

With one worker, all lanes are collected side by side. When a copy raises, none of their rollouts was delivered, so all lanes
start anew under the version in which that happened, and no update notices more than that.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv

MOST_STEPS = 30  # short episodes: several end in each rollout


class Restarting(CartPoleEnv):
    """Raises at row `at` (counted from 1) of a copy, unless the file `once` exists, which is then made. 0: never."""

    def __init__(self, at: int = 0, once: str = "") -> None:
        super().__init__()
        self._at, self._once = at, once
        self._calls = -1  # the first reset is no row

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start, and count a row: after the end of an episode, one row is a reset. The first one, and those of evaluations,
        have a seed.
        """
        if seed is not None:
            self._calls = -1
        self._count()
        found: tuple[Any, dict[str, Any]] = super().reset(seed=seed, options=options)
        return found

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step, and count a row."""
        self._count()
        found: tuple[Any, float, bool, bool, dict[str, Any]] = super().step(action)  # type: ignore[no-untyped-call]
        return found

    def _count(self) -> None:
        self._calls += 1
        if self._at and self._calls == self._at and not Path(self._once).exists():
            Path(self._once).touch()
            raise RuntimeError("this copy fails once, as it was asked to")


class Push(gymnasium.ActionWrapper[Any, Any, Any]):
    """A number in [-1, 1] for an action: which way to push."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.action_space = gymnasium.spaces.Box(-1, 1, (1,))

    def action(self, action: Any) -> int:
        """Left or right."""
        return int(action[0] > 0)


class Both(gymnasium.ActionWrapper[Any, Any, Any]):
    """A Tuple for an action: a number, and which way to push if the number is small."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.action_space: Any = gymnasium.spaces.Tuple([gymnasium.spaces.Box(-1, 1, (1,)), gymnasium.spaces.Discrete(2)])

    def action(self, action: Any) -> int:
        """Left or right."""
        number, way = action
        return int(way) if abs(number[0]) < 0.5 else int(number[0] > 0)


gymnasium.register("Restarting-v0", f"{__name__}:Restarting", max_episode_steps=MOST_STEPS)
