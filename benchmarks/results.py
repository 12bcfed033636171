"""Writes docs/results.md, the returns and commands of runs, from run folders: `python -m benchmarks.results RUN ...`.

For each run the table has the best policy of the run's own evaluations, evaluated again on 100 other episodes, and the
final policy. If a run's own evaluations had fewer episodes, the policies are evaluated here. Runs that differ only in their
seed form one row.
"""

from __future__ import annotations

import argparse
import shlex
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import msgspec

from learner.config.config import Config
from learner.config.layers import config_of_run, resolve
from learner.policy_player import saved_policy
from learner.rollouts.evaluation_tickets import EvaluationPlan, evaluation_of
from learner.run_folder.results import Evaluation, Summary
from learner.run_folder.run_folder import RunFolder, Which
from millrace.launch.policy_workers import PlayingWorkers, policy_player

OUT = Path(__file__).parents[1] / "docs" / "results.md"
EPISODES = 100
OTHER_EPISODES = 1_000_000  # the seed of `millrace evaluate`; no run chooses its best policy by these episodes
HEAD = """# Results

Mean return of 100 greedy episodes, for seeds 1, 2 and 3. *Best* is the best policy of the run's own evaluations, evaluated
again on other episodes than those by which it was chosen. *Final* is the last policy. `python -m benchmarks.results RUN
...` made this table from run folders.

| environment | algorithm | env steps | best | final | seconds | command (for each seed) |
|---|---|---|---|---|---|---|
"""
TAIL = """

On HalfCheetah-v5 CleanRL's settings (in this learner) reached 1,818. The difference comes from an initial log standard
deviation of -2, which makes the first actions small, a shorter horizon (gamma 0.98, lambda 0.92), a narrow clip range (0.1)
and 20 epochs. Observations and rewards are normalized in both cases.
[`learner/config/presets.toml`](../learner/config/presets.toml) has the settings and their sources.
[off_policy.md](off_policy.md) shows the effect of V-trace, and [notebooks.md](notebooks.md) the runs of five teaching
notebooks.

The machine had two cores and no GPU, and did other work while these ran, so the seconds are upper bounds. Versions:
{versions}.
"""


class Run(NamedTuple):
    """What the table needs of one run folder."""

    config: Config
    summary: Summary
    best: float | None
    final: float | None


def read(path: Path) -> Run | None:
    """The run, or None if it has not finished."""
    folder = RunFolder.open(path)
    config, summary = config_of_run(path), folder.summary()
    if summary is None:
        return None
    best = _played(path, config, summary.best.evaluation if summary.best else None, "best")
    return Run(config, summary, best, _played(path, config, summary.evaluation, "final"))


def _played(path: Path, config: Config, found: Evaluation | None, which: Which) -> float | None:
    """The mean return over `EPISODES` episodes. They are played here if the run's own evaluation had another number."""
    if found is not None and found.episodes != EPISODES:
        plan = EvaluationPlan.of(EPISODES, OTHER_EPISODES, config.eval_copies, config.eval_max_steps)
        with policy_player(saved_policy(path, which), PlayingWorkers(config.workers), lambda text: None) as player:
            found = evaluation_of(player.play(plan))
    return None if found is None else found.return_mean


def command(config: Config) -> str:
    """The shortest command line that repeats this run, with S as the seed and without the run folder."""
    words = ["millrace", "train", config.env, "--seed", "S"]
    if config.algo != "ppo":
        words += ["--algo", config.algo]
    defaults = msgspec.to_builtins(resolve(config.env, algo=config.algo))
    settings = msgspec.to_builtins(config)
    defaults |= defaults.pop("algorithm")
    settings |= settings.pop("algorithm")
    for name, value in settings.items():
        if name in ("env", "algo", "seed", "run_dir") or value == defaults[name]:
            continue
        words.append(f"--{name.replace('_', '-')}")
        words += [str(item) for item in value] if isinstance(value, list | tuple) else [str(value)]
    return shlex.join(words)


def row(runs: list[Run]) -> str:
    """One line of the table."""
    runs = sorted(runs, key=lambda run: run.config.seed)
    config = runs[0].config
    best, final = _means([run.best for run in runs]), _means([run.final for run in runs])
    steps = f"{max(run.summary.env_steps for run in runs):,}"
    seconds = f"{max(run.summary.wall_s for run in runs):.0f}"
    return f"| {' | '.join([config.env, config.algo, steps, best, final, seconds, f'`{command(config)}`'])} |"


def _means(found: list[float | None]) -> str:
    return ", ".join("–" if mean is None else f"{mean:,.0f}" for mean in found)


def main() -> None:
    parser = argparse.ArgumentParser(description="docs/results.md from run folders")
    parser.add_argument("runs", type=Path, nargs="+")
    groups: dict[str, list[Run]] = defaultdict(list)
    for path in parser.parse_args().runs:
        run = read(path)
        if run is not None:
            groups[command(run.config)].append(run)
    by_env = sorted(groups.values(), key=lambda runs: (runs[0].config.env, runs[0].config.algo))
    versions = {", ".join(f"{k} {v}" for k, v in run.summary.versions.items()) for runs in by_env for run in runs}
    OUT.write_text(HEAD + "\n".join(map(row, by_env)) + TAIL.format(versions="; ".join(sorted(versions))))
    print(OUT)


if __name__ == "__main__":
    main()
