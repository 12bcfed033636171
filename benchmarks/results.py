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

This page says which returns millrace's algorithms reach, with which commands. Use it to check your installation, or to
choose an algorithm.

Each figure is the mean return of 100 greedy episodes, for seeds 1, 2 and 3. *Best* is the best policy of the run's own
evaluations, evaluated again on other episodes than those by which it was chosen. *Final* is the last policy. This table
was made from run folders by `python -m benchmarks.results RUN ...`.

| environment | algorithm | env steps | best | final | seconds | command (for each seed) |
|---|---|---|---|---|---|---|
"""
TAIL = """

The machine had two cores and no GPU, and did other work during most of these runs, so the seconds are upper bounds.
Versions: {versions}. `make test-learning` checks most of these returns again (not HalfCheetah-v5), in about ten
minutes.

## Compared with published results

| run | millrace | published |
|---|---|---|
| PPO, CartPole-v1, 100k env steps, final | 500, 500, 500 | 500 (RL Zoo) |
| PPO, Pendulum-v1, 300k env steps, final | -159, -194, -179 | -172 (RL Zoo, with gSDE), -175 (SLM-Lab) |
| PPO, HalfCheetah-v5, 1M env steps, best | 5,090, 5,400, 4,828 | 1,443 (CleanRL), 5,784 (Tianshou) |
| [SB3's PPO](how-to/vector_env.md) over `millrace.sb3`, CartPole-v1, 100k env steps | 500, 500, 500 | 500 (RL Zoo) |
| [PPO in one file](../examples/ppo_vector_env.py) over it, the same | 500, 500, 496 | |
| CartPole-v1, weights 6 to 7 versions old, median of five: [IMPALA, A2C](explanation/off_policy.md) | 500, 159 | |

The last row comes from `python -m benchmarks.off_policy`, the two before it from `make test-learning`.

On HalfCheetah-v5 CleanRL's settings in this learner reached 1,818. Our preset differs in an initial log standard
deviation of -2, which makes the first actions small, a shorter horizon (gamma 0.98, lambda 0.92), a narrow clip range
(0.1) and 20 epochs. Observations and rewards are normalized in both cases.
[`learner/config/presets.toml`](../learner/config/presets.toml) has the settings and their sources. [Teaching
notebooks](how-to/teaching_notebooks.md) has the runs of five notebooks.
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
