"""Results of a run: greedy evaluations, the best policy, and the summary (summary.json)."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

EVALUATION_KEY = "eval/mean_reward"


class Evaluation(msgspec.Struct, frozen=True, kw_only=True):
    """The result of greedy episodes, in raw rewards."""

    episodes: int
    return_mean: float
    return_std: float
    """population standard deviation over the episodes"""
    length_mean: float
    """mean length of an episode in env steps"""
    cut: int = 0
    """episodes that were stopped because they were too long; they count with the return they had by then"""

    @staticmethod
    def of(returns: Sequence[float], lengths: Sequence[int], cut: int) -> Evaluation:
        """The evaluation of these episodes; `cut` of them were too long."""
        return Evaluation(
            episodes=len(returns),
            return_mean=float(np.mean(returns)),
            return_std=float(np.std(returns)),
            length_mean=float(np.mean(lengths)),
            cut=cut,
        )

    def __str__(self) -> str:
        cut = f", {self.cut} of them cut short" if self.cut else ""
        return f"return {self.return_mean:.1f} ± {self.return_std:.1f} over {self.episodes} episodes{cut}"

    def metrics(self) -> dict[str, float]:
        """The numbers that are logged with a row of metrics."""
        return {EVALUATION_KEY: self.return_mean, "eval/mean_ep_length": self.length_mean}


class Best(msgspec.Struct, frozen=True, kw_only=True):
    """The policy with the highest mean return in the run's own evaluations."""

    env_steps: int
    """env steps of training when it was evaluated"""
    chosen_by: float
    """the mean return by which it was chosen; as the maximum of several means it is biased upwards"""
    evaluation: Evaluation
    """a second evaluation of the same policy, on other episodes"""


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """The results of a run: summary.json."""

    env: str
    algo: str
    seed: int
    env_steps: int
    updates: int
    wall_s: float
    env_steps_per_s: float
    stop_reason: str
    return_mean_100: float | None
    """mean return of the last 100 training episodes"""
    evaluation: Evaluation | None
    """evaluation of the final policy"""
    best: Best | None = None
    """the best policy of the run's own evaluations, if there were any"""
    ledger: dict[str, int] = {}
    """number of tickets and transitions in each state"""
    lags: dict[str, int] = {}
    """number of rollouts that updates used, by lag, since this process started"""
    first_use_s: dict[str, float] = {}
    """by worker: median seconds from publishing new weights to the arrival of the first rollout under them"""
    stages: dict[str, float] = {}
    """seconds spent in each stage"""
    versions: dict[str, str] = {}
    """versions of millrace and of the packages that decide its results"""
