"""The results of a run: greedy evaluations, the best policy, the summary (summary.json), and datasets of its episodes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path

import msgspec
import numpy as np

from millrace.learner.run_folder.regular_files import read
from millrace.protocol.bounds import Natural, Real, Seconds, Version
from millrace.protocol.specs import SCORE

SUMMARY_FILE = "summary.json"
ALL_STEPS_DONE = "all steps done"
"""The reason why a run ended if nothing ended it earlier."""
EVALUATION_KEY = "eval/mean_reward"
EVALUATION_LENGTH_KEY = "eval/mean_ep_length"
Z_95 = 1.959964
"""The quantile of the normal distribution for a 95 % interval."""
EVALUATED_AT_KEY = "eval/env_steps"
"""The metric for the env steps of a policy that was evaluated alongside training. Its row's own env steps are higher."""


class FactMean(msgspec.Struct, frozen=True):
    """The mean of a number that the environment reports at the ends of episodes."""

    mean: Real | None
    """the mean over the episodes that have the number; None if none has it"""
    missing: Natural
    """how many episodes do not have the number"""

    def __str__(self) -> str:
        mean = "missing" if self.mean is None else f"{self.mean:.3g}"
        return f"{mean} ({self.missing} without)" if self.missing and self.mean is not None else mean


METRICS_BESIDE_FACTS = frozenset(
    {"ep_rew_mean", "ep_len_mean", "exploration_rate", "mean_reward", "mean_ep_length", "env_steps"}
)
"""The names of other values that are logged as rollout/NAME or eval/NAME. A fact can't have such a name, because otherwise
one of the two values would be lost."""


def fact_means(names: Sequence[str], episodes: Iterable[Sequence[float]]) -> dict[str, FactMean]:
    """The means of these episodes' facts, by name. NaN stands for a missing fact."""
    columns = zip(*episodes, strict=True)
    means = {}
    for name, column in zip_longest(names, columns, fillvalue=()):
        there = [number for number in column if not math.isnan(number)]
        mean = None
        if there:
            mean = math.fsum(number / len(there) for number in there)  # divides first, because the sum may overflow
        means[str(name)] = FactMean(mean, len(column) - len(there))
    return means


def fact_metrics(group: str, facts: Mapping[str, FactMean]) -> dict[str, float | None]:
    """The facts under the names by which they are logged, such as eval/is_success and eval/is_success_missing."""
    row: dict[str, float | None] = {}
    for name, fact in facts.items():
        row |= {f"{group}/{name}": fact.mean, f"{group}/{name}_missing": fact.missing}
    return row


class Evaluation(msgspec.Struct, frozen=True, kw_only=True):
    """The result of an evaluation with greedy episodes, in raw rewards.

    >>> import millrace
    >>> result = millrace.evaluate(run, episodes=2, workers=1)
    >>> isinstance(result, millrace.Evaluation), result.return_std >= 0
    (True, True)
    """

    episodes: Natural
    """number of episodes"""
    return_mean: Real
    """mean return of an episode: its summed raw rewards, undiscounted"""
    return_std: Real
    """population standard deviation over the episodes"""
    length_mean: Real
    """mean length of an episode in env steps"""
    cut: Natural = 0
    """how many episodes were stopped because they were too long; their return up to then counts"""
    facts: dict[str, FactMean] = {}
    """for each name in `info_keys`, the mean of the numbers that the environment reported at the ends of the episodes; also
    the score, if there were opponents
    """
    matches: Natural = 0
    """how many of the episodes were played against opponents"""

    @staticmethod
    def of(returns: Sequence[float], lengths: Sequence[int], cut: int) -> Evaluation:
        """The evaluation that consists of these episodes, of which `cut` were too long."""
        return Evaluation(
            episodes=len(returns),
            return_mean=float(np.mean(returns)),
            return_std=float(np.std(returns)),
            length_mean=float(np.mean(lengths)),
            cut=cut,
        )

    def __str__(self) -> str:
        cut = f", {self.cut} of them cut short" if self.cut else ""
        facts = {name: str(fact) for name, fact in self.facts.items()}
        if (interval := self.score_interval) is not None:
            facts[SCORE] = "{:.2f} ({:.2f} to {:.2f} with 95% confidence)".format(self.facts[SCORE].mean or 0.0, *interval)
        said = "".join(f", {name} {fact}" for name, fact in facts.items())
        episodes = f"{self.episodes} episode{'s' * (self.episodes != 1)}"
        return f"return {self.return_mean:.1f} ± {self.return_std:.1f} over {episodes}{cut}{said}"

    @property
    def score_interval(self) -> tuple[float, float] | None:
        """The 95 % confidence interval of the score (Wilson 1927); None without opponents."""
        score = self.facts.get(SCORE)
        if not self.matches or score is None or score.mean is None:
            return None
        n = self.matches
        z2 = Z_95**2
        middle = score.mean + z2 / (2 * n)
        half = math.sqrt(z2 * score.mean * (1 - score.mean) / n + (z2 / (2 * n)) ** 2)
        return max(0.0, (middle - half) / (1 + z2 / n)), min(1.0, (middle + half) / (1 + z2 / n))

    def metrics(self) -> dict[str, float | None]:
        """The numbers of this evaluation that are logged in a row of metrics."""
        returns = {EVALUATION_KEY: self.return_mean, EVALUATION_LENGTH_KEY: self.length_mean}
        return returns | fact_metrics("eval", self.facts)


class EvaluatedPolicy(msgspec.Struct, frozen=True):
    """The policy that an evaluation played. The defaults stand for no policy."""

    version: Version = -1
    env_steps: Natural = 0
    """the env steps of training up to this version"""


class DecidingReturns(msgspec.Struct, frozen=True, kw_only=True):
    """The returns that decide whether a run ends. Each is None if there is none yet."""

    evaluation: Real | None = None
    """the mean return of the newest evaluation"""
    evaluated_before: Natural | None = None
    """the env steps of training up to the evaluated policy; None if it is the newest policy"""
    training: Real | None = None
    """the mean return of the last training episodes; None as long as there are too few"""


class Best(msgspec.Struct, frozen=True, kw_only=True):
    """The policy with the highest mean return in the run's own evaluations."""

    env_steps: Natural
    """the env steps of training after which it was evaluated"""
    chosen_by: Real
    """the mean return by which it was chosen, which is biased upwards because it is the maximum of several means"""
    evaluation: Evaluation
    """a second evaluation of the same policy, on other episodes"""


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """The results of a run, from its summary.json. `Run.summary` is None until the run has ended.

    Returns are sums of raw rewards, undiscounted. Numbers cover the whole run, including the time before a resume, unless
    their description says otherwise.

    >>> import millrace
    >>> summary = millrace.Run(run).summary
    >>> isinstance(summary, millrace.Summary), summary.evaluation.episodes
    (True, 2)
    """

    env: str
    """id or name of the environment"""
    algo: str
    """name of the algorithm; `module:Class` for your own"""
    seed: int
    env_steps: Natural
    """env steps that updates used, over all env copies"""
    updates: Natural
    wall_s: Seconds
    """seconds of training; evaluations do not count"""
    env_steps_per_s: Real
    """`env_steps` / `wall_s`"""
    stop_reason: str
    """why it ended: `all steps done`, the target that it reached, the callback that ended it, an error or a signal"""
    cut_short: bool = False
    """whether an error or an interrupt ended the run"""
    return_mean_100: Real | None
    """mean return of the last 100 training episodes; None if none has ended"""
    facts_100: dict[str, FactMean] = {}
    """for each name in `info_keys`, the mean of the numbers that the environment reported at the ends of these episodes"""
    evaluation: Evaluation | None
    """evaluation of the final policy with greedy episodes; None if the run was cut short before it"""
    ended_by: Real | None = None
    """the mean return of the evaluation that ended the run by reaching `target_return`; if a callback ended the run, the
    mean return of the final policy, provided that the callback could know it. Such a return is biased upwards. If it belongs
    to the final policy, `evaluation` is therefore a second evaluation, on other episodes
    """
    best: Best | None = None
    """the best policy of the run's own evaluations, if there were any"""
    ledger: dict[str, Natural] = {}
    """the numbers of tickets and of transitions in each state"""
    lags: dict[str, Natural] = {}
    """the number of rollouts that updates used, by lag, since this process started"""
    first_use_s: dict[str, Real] = {}
    """for each worker, the median number of seconds from the publication of new weights to the arrival of the worker's first
    rollout with them, since this process started
    """
    stages: dict[str, Real] = {}
    """the seconds that the learner, and all workers together, spent in each stage, such as collecting and updating"""
    versions: dict[str, str] = {}
    """the versions of millrace and of the packages on which its results depend"""


class RecordedDataset(msgspec.Struct, frozen=True, kw_only=True):
    """The size and the returns of a recorded dataset.

    >>> import millrace
    >>> result = millrace.record(run, "cartpole/example-v0", steps=20, workers=1)
    >>> isinstance(result, millrace.RecordedDataset), result.steps >= 20
    (True, True)
    """

    dataset_id: str
    episodes: int
    steps: int
    return_mean: float
    return_std: float
    cut: int
    """how many episodes were stopped because they were too long"""

    def __str__(self) -> str:
        cut = ", the last of them cut short" if self.cut else ""
        returns = f"return {self.return_mean:.1f} ± {self.return_std:.1f}"
        return f"dataset {self.dataset_id}: {self.steps:,} steps, {self.episodes:,} episodes{cut}, {returns}"


def read_summary(run: Path) -> Summary:
    """Read the summary.json of a run folder. Raises OSError if there is none, or an error of msgspec if it is damaged."""
    return msgspec.json.decode(read(run / SUMMARY_FILE), type=Summary)
