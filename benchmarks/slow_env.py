"""Environments whose steps and resets take time and no CPU, because they sleep.

`benchmarks.slow_env:TenMilliseconds-v0` is Pendulum-v1 in which each step takes 10 ms longer. In `FiftyMilliseconds-v0`, a
step takes 50 ms longer, and an episode has 1,000 steps instead of 200.

`benchmarks.slow_env:Lognormal-v0`: a step takes 5 ms on average (lognormal, sigma 1), a reset 200 ms, and an episode has 50
to 150 steps. The durations depend only on the reset seed. A copy that never waits takes 100 steps in 0.7 s.

`benchmarks.slow_env:Constant-v0`: a step takes `seconds`, a reset no time, and an episode has `steps` steps.

`StepTime` makes the steps of any environment take a given time: `--wrappers "benchmarks.slow_env:StepTime(seconds=0.05)"`.

If the environment variable `SLOW_ENV_TIMELINE` names a folder, each copy of `Lognormal-v0` appends three float64 numbers to
a file in it for every step and reset: start and end by the monotonic clock, and 1 for a reset.
"""

from __future__ import annotations

import math
import os
import struct
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.classic_control import PendulumEnv
from gymnasium.envs.registration import register
from gymnasium.spaces import Box, Discrete

MEAN_STEP_S = 0.005
SIGMA = 1.0
RESET_S = 0.2
SHORTEST = 50  # minimum number of steps in an episode
LONGEST = 150
TIMELINE = "SLOW_ENV_TIMELINE"
STEPS_PER_S = 1 / (MEAN_STEP_S + RESET_S / ((SHORTEST + LONGEST) / 2))  # env steps/s of a copy that never waits


class Lognormal(gymnasium.Env[Any, Any]):
    """An environment whose steps and resets sleep; the times of steps are lognormal."""

    def __init__(self) -> None:
        self.observation_space = Box(-1.0, 1.0, (4,), np.float32)
        self.action_space = Discrete(2)
        self._left = 0
        folder = os.environ.get(TIMELINE)
        self._timeline = (Path(folder) / f"{os.getpid()}-{id(self):x}").open("ab", 0) if folder else None

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._sleep(RESET_S, 1.0)
        self._left = int(self.np_random.integers(SHORTEST, LONGEST, endpoint=True))
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._sleep(float(self.np_random.lognormal(math.log(MEAN_STEP_S) - SIGMA**2 / 2, SIGMA)), 0.0)
        self._left -= 1
        return self._observation(), 1.0, self._left == 0, False, {}

    def _observation(self) -> Any:
        return self.np_random.uniform(-1, 1, 4).astype(np.float32)

    def _sleep(self, duration_s: float, is_reset: float) -> None:
        began_s = time.monotonic()
        time.sleep(duration_s)
        if self._timeline is not None:
            self._timeline.write(struct.pack("3d", began_s, time.monotonic(), is_reset))


class Constant(gymnasium.Env[Any, Any]):
    """An environment whose steps all take the same time."""

    def __init__(self, seconds: float = 0.01, steps: int = 100) -> None:
        self.observation_space = Box(0.0, 1.0, (1,), np.float32)
        self.action_space = Discrete(2)
        self._seconds = seconds
        self._steps = steps
        self._left = steps

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._left = self._steps
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        time.sleep(self._seconds)
        self._left -= 1
        return self._observation(), 1.0, self._left == 0, False, {}

    def _observation(self) -> Any:
        return np.array([self._left / self._steps], np.float32)


class StepTime(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A wrapper that makes each step take `seconds`, by sleeping until this time is over. Resets aren't changed."""

    def __init__(self, env: gymnasium.Env[Any, Any], seconds: float) -> None:
        super().__init__(env)
        self._seconds = seconds

    def step(self, action: Any) -> Any:
        end_s = time.monotonic() + self._seconds
        result = self.env.step(action)
        time.sleep(max(0.0, end_s - time.monotonic()))
        return result


class SlowPendulum(PendulumEnv):
    """Pendulum-v1 whose steps take longer."""

    def __init__(self, render_mode: str | None = None, *, step_s: float) -> None:
        """`step_s`: how many seconds longer a step takes."""
        super().__init__(render_mode)
        self._step_s = step_s

    def step(self, action: Any) -> Any:
        time.sleep(self._step_s)
        return super().step(action)  # type: ignore[no-untyped-call]


register("Lognormal-v0", "benchmarks.slow_env:Lognormal")
register("Constant-v0", "benchmarks.slow_env:Constant")
SLOW_PENDULUM = "benchmarks.slow_env:SlowPendulum"
register("TenMilliseconds-v0", SLOW_PENDULUM, max_episode_steps=200, kwargs={"step_s": 0.01})
register("FiftyMilliseconds-v0", SLOW_PENDULUM, max_episode_steps=1000, kwargs={"step_s": 0.05})
