"""The progress of a run, and the names under which its numbers are logged.

The names are those of Stable-Baselines3 where it has one. The x axis is env steps.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

ENV_STEPS_KEY = "time/total_timesteps"
UPDATES_KEY = "time/iterations"
RETURN_KEY = "rollout/ep_rew_mean"
EVALUATION_KEY = "eval/mean_reward"
Row = Mapping[str, float | None]


class Progress(msgspec.Struct, frozen=True, kw_only=True):
    """The progress of a run, which the terminal shows and the metrics record after each update."""

    run: str = ""
    """path of the run folder"""
    env_steps: int = 0
    total_steps: int = 0
    """env steps to train for"""
    updates: int = 0
    wall_s: float = 0.0
    """seconds of training, those before a resume included; evaluations do not count"""
    steps_per_s: float = 0.0
    """env steps per second of training since this process started"""
    return_mean: float | None = None
    """mean return of the last 100 training episodes, in raw rewards; None before the first has ended"""
    length_mean: float | None = None
    """mean length of the same episodes, in env steps"""
    lag_mean: float = 0.0
    lag_max: int = 0
    workers_alive: int = 0
    workers_expected: int = 0
    """0: any number"""
    ledger: dict[str, int] = {}
    """number of tickets and transitions in each state"""
    stages: dict[str, float] = {}
    """seconds spent in each stage so far"""
    note: str = ""
    """a message to the user, in one line"""
    doing: str = ""
    """what the run does instead of training, as "evaluating: 37 of 100 episodes"; empty while it trains"""

    def row(self, train: Mapping[str, float]) -> dict[str, float | None]:
        """One flat row of metrics. `train`: the metrics of the algorithm."""
        row: dict[str, float | None] = {
            RETURN_KEY: self.return_mean,
            "rollout/ep_len_mean": self.length_mean,
            "time/fps": self.steps_per_s,
            UPDATES_KEY: self.updates,
            "time/time_elapsed": self.wall_s,
            ENV_STEPS_KEY: self.env_steps,
            "lag/mean": self.lag_mean,
            "lag/max": self.lag_max,
            "drop/stale": self.ledger.get("stale", 0),
        }
        row |= {f"ledger/{name}": count for name, count in self.ledger.items()}
        row |= {f"stage/{name}": seconds for name, seconds in self.stages.items()}
        return row | named(train)


def named(train: Mapping[str, float]) -> dict[str, float]:
    """The metrics of an algorithm or an evaluation under the names by which they are logged."""
    return {name if "/" in name else f"train/{name}": value for name, value in train.items()}
