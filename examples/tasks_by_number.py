"""Four tasks in one run: CartPole with four pole lengths. Each env copy has one of them, which depends on its number.

    python examples/tasks_by_number.py

A copy's number is the same in every run, on every machine and after a resume. Each copy therefore keeps its task, and the
result doesn't depend on the number of workers. The motor's force is also randomized by the number; evaluations use the true
force. With `eval_copies=4`, an evaluation has equally many episodes of each task.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.classic_control import CartPoleEnv

import millrace

POLES = {"short": 0.3, "usual": 0.5, "long": 1.0, "longest": 2.0}  # half lengths in metres, by the name of the task


class Named(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Reports an episode's return in `info`, under the name of its task."""

    def __init__(self, env: gymnasium.Env[Any, Any], task: str) -> None:
        super().__init__(env)
        self.key, self.total = f"return_{task}", 0.0

    def reset(self, **keywords: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        self.total = 0.0
        return super().reset(**keywords)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step, and add its reward to the return."""
        observation, reward, terminated, truncated, info = super().step(action)
        self.total += float(reward)
        return observation, reward, terminated, truncated, {**info, self.key: self.total}


def make_task(copy: millrace.EnvCopy) -> gymnasium.Env[Any, Any]:
    """The environment of this copy."""
    env = gymnasium.make("CartPole-v1")
    cart_pole = env.unwrapped
    assert isinstance(cart_pole, CartPoleEnv)
    task = list(POLES)[copy.number % len(POLES)]
    cart_pole.length = POLES[task]
    cart_pole.polemass_length = cart_pole.masspole * cart_pole.length
    if not copy.evaluation:
        cart_pole.force_mag *= float(np.random.default_rng(copy.number).uniform(0.8, 1.2))
    return Named(env, task)


def train(**settings: Any) -> millrace.Run:
    """Train on all tasks. Each task's return is a metric, such as `rollout/return_long` and `eval/return_long`."""
    names = [f"return_{task}" for task in POLES]
    return millrace.train(make_task, info_keys=names, **{"envs": 8, "lanes": 4, "eval_copies": 4, **settings})


if __name__ == "__main__":
    print(train(steps=100_000, eval_episodes=40, seed=1).summary)
