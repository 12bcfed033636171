"""Adds runs to benchmarks/scores.json, and writes its tables into docs/explanation/results.md and benchmarks/README.md.

`python -m benchmarks.results RUN ...`; without runs, it only writes the tables. For each run it takes the returns of the
final policy and of the best policy of the run's own evaluations, the latter evaluated again on 100 other episodes. If a
run's own evaluations had fewer episodes, the policies are evaluated here. Runs that differ only in their seeds form one row.
"""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Sequence
from pathlib import Path

import msgspec

from benchmarks.programs import flag
from benchmarks.scores import (
    EPISODES,
    Score,
    commands_table,
    merged,
    read_published,
    read_scores,
    returns_table,
    write_scores,
)
from millrace.launch.policy_workers import PlayingWorkers, policy_player
from millrace.learner.config.config import TABLES, Config
from millrace.learner.config.layers import config_of_run, resolve
from millrace.learner.config.local_workers import local_workers
from millrace.learner.config.presets import added, environment_name
from millrace.learner.policy_player import saved_policy
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan, evaluation_of
from millrace.learner.run_folder.results import Evaluation
from millrace.learner.run_folder.run_folder import RunFolder, Which

PAGE = Path(__file__).parents[1] / "docs" / "explanation" / "results.md"
PAGE_OF_COMMANDS = Path(__file__).with_name("README.md")
RETURNS, COMMANDS = (
    re.compile(rf"^\| {first} \|.*?\n(?=\n|\Z)", re.MULTILINE | re.DOTALL) for first in ("environment", "seconds")
)
OTHER_EPISODES = 1_000_000  # default seed of `millrace evaluate`; no run chooses its best policy by these episodes
NOT_IN_COMMANDS = ("env", "algo", "seed", "run_dir", "torch_threads")  # torch_threads is chosen for the machine
EVALUATION = ("eval_every", "eval_episodes")


def read(path: Path, *, only_final: bool) -> Score | None:
    """The score of a run, or None if the run hasn't finished.

    `only_final`: leave out the best policy. The command then omits evaluation settings, because these don't affect the
    weights.
    """
    folder = RunFolder.open(path)
    config = config_of_run(path)
    summary = folder.summary()
    if summary is None:
        return None
    best = _played(path, config, summary.best.evaluation if summary.best and not only_final else None, "best")
    final = _played(path, config, summary.evaluation, "final")
    if final is None:
        return None
    return Score(
        env=environment_name(config.env, config.env_kwargs, config.algo),
        algo=config.algo,
        command=command(config, EVALUATION if only_final else ()),
        env_steps=summary.env_steps,
        final={config.seed: final},
        best={} if best is None else {config.seed: best},
        seconds=summary.wall_s,
        versions=summary.versions,
    )


def _played(path: Path, config: Config, found: Evaluation | None, which: Which) -> float | None:
    """The mean return over `EPISODES` episodes, which are played here if the run's own evaluation had a different number.

    None if the run has no such evaluation.
    """
    if found is not None and found.episodes != EPISODES:
        plan = EvaluationPlan.of(EPISODES, OTHER_EPISODES, config.eval_copies, config.eval_max_steps)
        with policy_player(saved_policy(path, which), PlayingWorkers(local_workers(config)), lambda text: None) as player:
            found = evaluation_of(player.play(plan))
    return None if found is None else found.return_mean


def command(config: Config, leave_out: Sequence[str] = ()) -> str:
    """The shortest command line that reproduces this run, with S as its seed. `leave_out`: settings to leave out."""
    # With max_lag 0, the number of workers has no effect on the results.
    leave_out = (*leave_out, *NOT_IN_COMMANDS, *(() if config.max_lag else ("workers",)))
    words = ["millrace", "train", config.env, "--seed", "S"]
    if config.algo != "ppo":
        words += ["--algo", config.algo]
    preset = resolve(config.env, algo=config.algo)
    if any(getattr(preset, name).keys() - getattr(config, name).keys() for name in TABLES):  # no flag can remove an entry
        preset = resolve(config.env, algo=config.algo, preset="none")
        words = [*words, "--preset", "none"]
    defaults = msgspec.to_builtins(preset)
    settings = msgspec.to_builtins(config)
    defaults |= defaults.pop("algorithm")
    settings |= settings.pop("algorithm")
    for name, value in settings.items():
        if name not in leave_out and value != defaults[name]:
            words += _words(name, value, defaults[name])
    return shlex.join(words)


def _words(name: str, value: object, default: object) -> list[str]:
    match value:
        case dict():
            return [*flag(name, True), *added(value, default if isinstance(default, dict) else {})]
        case _:
            return flag(name, value)


def main() -> None:
    parser = argparse.ArgumentParser(description="scores.json, and the pages with its tables, from run folders")
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--only-final", action="store_true", help="leave the best policies of the runs' evaluations out")
    flags = parser.parse_args()
    scores = {score.command: score for score in read_scores()}
    for path in flags.runs:
        score = read(path, only_final=flags.only_final)
        print(f"{path}: {'not finished' if score is None else score.final}")
        if score is not None:
            scores[score.command] = merged(scores.get(score.command), score)
    write_scores(scores.values())
    written = read_scores()
    returns = returns_table(written, read_published())
    commands = commands_table(written)
    for page, old, new in ((PAGE, RETURNS, returns), (PAGE_OF_COMMANDS, COMMANDS, commands)):
        text = page.read_text()
        page.write_text(text.replace("".join(old.findall(text)), new))
        print(page)


if __name__ == "__main__":
    main()
