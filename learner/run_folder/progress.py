"""The progress of a run, and the names under which its numbers are logged.

If Stable-Baselines3 has a name for a number, that name is used. The x axis is env steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, SupportsFloat

from millrace.learner.run_folder.callback_requests import Requests
from millrace.learner.run_folder.results import EvaluatedPolicy, Evaluation, FactMean, fact_metrics
from millrace.protocol.arrays import Bools
from millrace.protocol.errors import UsageError
from millrace.protocol.progress import RunProgress
from millrace.protocol.rollout import Episode, Rollout

ENV_STEPS_KEY = "time/total_timesteps"
UPDATES_KEY = "time/iterations"
RETURN_KEY = "rollout/ep_rew_mean"
NOT_SHOWN = ("at_s", "settings", "episodes", "rollouts", "incarnations", "fresh", "requests")
"""Fields of `Progress` that are left out when the progress is logged."""
Row = Mapping[str, float | None]


class Progress(RunProgress, frozen=True, kw_only=True):
    """The progress of a run, as callbacks get it: how far the run has got, what is new, and methods for requests.

    Returns are sums of raw rewards, undiscounted. Times are in seconds, speeds in env steps per second over all workers. A
    number that does not exist yet is None. If only some methods of `Callback` get a field, its description says so. Don't
    keep the arrays of `rollouts`, which are read-only; copy them.

    >>> import millrace
    >>> seen = []
    >>> def watch(progress: millrace.Progress) -> None:
    ...     seen.append((progress.env_steps, progress.return_mean, progress.metrics.get("train/value_loss")))
    >>> run = millrace.train("CartPole-v1", callbacks=[watch], steps=500, workers=1, eval_episodes=2, progress=False)
    >>> seen[-1][0] == run.summary.env_steps
    True
    """

    run: str = ""
    """path of the run folder"""
    facts: dict[str, FactMean] = {}
    """for each name in `info_keys`, the mean of the numbers that the environment reported at the ends of the last 100
    training episodes
    """
    note: str = ""
    """a one-line message for the user"""
    settings: dict[str, Any] = {}
    """all settings of the run, by name; `algorithm` has those of the algorithm"""
    metrics: dict[str, float] = {}
    """the algorithm's numbers from the last update, such as losses, by the names under which they are logged; before the
    first update, the numbers from cloning
    """
    episodes: tuple[Episode, ...] = ()
    """the episodes that ended in the rollouts of the last update"""
    lags: tuple[int, ...] = ()
    """the lag of each rollout that the last update used"""
    evaluation: Evaluation | None = None
    """the last evaluation"""
    evaluated: EvaluatedPolicy = EvaluatedPolicy()
    """`version` and `env_steps` of the evaluated policy; with `eval_workers`, it is older than the newest policy"""
    best: tuple[float, int] | None = None
    """the mean return of the best evaluation so far, and the env steps of the policy that it evaluated"""
    checkpoint: str = ""
    """the path of the newest checkpoint; empty before the first"""
    rollouts: tuple[Rollout, ...] = ()
    """only in `Callback.on_rollouts`: the rollouts of the next update, in lane order"""
    incarnations: tuple[int, ...] = ()
    """only in `Callback.on_rollouts`: for each rollout, the incarnation of its lane, which rises when the lane gets new
    copies; `Rollout.sequence` then starts from 0 again
    """
    fresh: tuple[Bools | bool, ...] = ()
    """only in `Callback.on_rollouts`: for each rollout, [N], True for env copies that started afresh, which means that the
    copy's first row doesn't continue the lane's previous rollout; a single value applies to all copies
    """
    requests: Requests | None = None
    """the requests of callbacks"""

    def plain(self) -> RunProgress:
        """The part of the progress that can be sent and written to files."""
        return RunProgress(**{name: getattr(self, name) for name in RunProgress.__struct_fields__})

    def log(self, name: str, value: SupportsFloat) -> None:
        """Log a number with the metrics of the current update. A name without a slash is logged as custom/NAME.

        Use this in `on_rollouts`, `on_update` and `on_evaluation`. A value that is not finite is logged as missing. Raises
        `UsageError` for anything but a name without line breaks and a number.
        """
        if self.requests is None:
            raise UsageError(f"log {name}: this is not the progress of a run")
        self.requests.log(name, value)

    def set_env_attr(self, name: str, value: Any) -> None:
        """Set an attribute of every training env copy from the next weights on, for example for a curriculum.

        `value` must be plain data: numbers, text, lists, dicts or numpy arrays. Each rollout is collected with the
        attributes that belong to its version of the weights, so the result is the same for any number of workers.
        Checkpoints save the attributes. Evaluations use env copies without them. Raises `UsageError` if the value cannot be
        sent, and always in `on_checkpoint` and `on_end`.
        """
        if self.requests is None:
            raise UsageError(f"set_env_attr {name}: this is not the progress of a run")
        self.requests.set_env_attr(name, value)

    @property
    def env_attrs(self) -> dict[str, Any]:
        """The attributes that have been set on env copies so far, by name, including those set before a resume."""
        return {} if self.requests is None else self.requests.attributes.now()

    def row(self, train: Row) -> dict[str, float | None]:
        """One flat row of metrics. `train` are the metrics of the algorithm, of an evaluation, or of callbacks."""
        row: dict[str, float | None] = {
            RETURN_KEY: self.return_mean,
            "rollout/ep_len_mean": self.length_mean,
            "time/fps": self.steps_per_s,
            UPDATES_KEY: self.updates,
            "time/time_elapsed": self.wall_s,
            ENV_STEPS_KEY: self.env_steps,
            "lag/mean": self.lag_mean,
            "lag/max": self.lag_max,
        }
        row |= fact_metrics("rollout", self.facts)
        row |= {f"ledger/{name}": count for name, count in self.ledger.items()}
        row |= {f"stage/{name}": seconds for name, seconds in self.stages.items()}
        return row | named(train)


def steps_per_second(env_steps: int, seconds: float) -> float:
    """Env steps per second; 0 before any time has passed."""
    return env_steps / seconds if seconds else 0.0


def named(train: Row) -> dict[str, float | None]:
    """The metrics of an algorithm or an evaluation, by the names under which they are logged."""
    return {name if "/" in name else f"train/{name}": value for name, value in train.items()}
