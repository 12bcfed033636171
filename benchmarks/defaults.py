"""Returns of policies trained with the default settings, and with other settings: `python -m benchmarks.defaults`.

Rule: each run is `millrace train ENV --preset none` with the flags of a variant. A figure is the mean return of the final
policy over the run's own greedy episodes. Finished runs are kept in benchmarks/results/defaults, by the name of the variant,
and a later call makes only the missing runs, so remove that folder after changing the code or a variant.

`--variant NAME=FLAGS` adds a variant; without one, only the defaults are run.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import shlex
import statistics
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from benchmarks.scores import return_text
from benchmarks.writing import RESULTS
from millrace.learner.run_folder.run_folder import RunFolder, as_folder_name

ROOT = Path(__file__).parents[1]
NOW = "defaults"


class Case(NamedTuple):
    """An environment in the table."""

    env: str
    flags: str = ""
    """flags without which the environment can't be trained"""
    continuous: bool = False
    """whether its actions are continuous"""
    needs: str = ""
    """module that must be installed; otherwise the environment is left out"""


MINIGRID = "--wrappers minigrid.wrappers:ImgObsWrapper gymnasium.wrappers:FlattenObservation"
CASES = (
    Case("CartPole-v1"),
    Case("Acrobot-v1"),
    Case("MountainCar-v0"),
    Case("FrozenLake-v1"),
    Case("CliffWalking-v1", "--wrappers gymnasium.wrappers:TimeLimit(max_episode_steps=200)"),
    Case("Taxi-v4"),
    Case("LunarLander-v3", needs="Box2D"),
    Case("minigrid:MiniGrid-Empty-8x8-v0", MINIGRID, needs="minigrid"),
    Case("minigrid:MiniGrid-DoorKey-5x5-v0", MINIGRID, needs="minigrid"),
    Case("Pendulum-v1", continuous=True),
    Case("MountainCarContinuous-v0", continuous=True),
    Case("BipedalWalker-v3", continuous=True, needs="Box2D"),
    Case("InvertedDoublePendulum-v5", continuous=True, needs="mujoco"),
    Case("Reacher-v5", continuous=True, needs="mujoco"),
    Case("Swimmer-v5", continuous=True, needs="mujoco"),
    Case("Hopper-v5", continuous=True, needs="mujoco"),
    Case("HalfCheetah-v5", continuous=True, needs="mujoco"),
)


def command(case: Case, algo: str, seed: int, flags: str) -> list[str]:
    """The command that trains a run."""
    words = [sys.executable, "-m", "millrace", "train", case.env, "--algo", algo, "--seed", str(seed), "--preset", "none"]
    return [*words, "--workers", "1", "--action-masks", "none", *shlex.split(case.flags), *shlex.split(flags)]


def final_return(case: Case, algo: str, seed: int, variant: str, flags: str) -> float | None:
    """The return of the final policy; None if the run failed. The run is trained unless a finished one is kept."""
    where = RESULTS / "defaults" / algo / variant / as_folder_name(case.env) / f"seed{seed}"
    if (found := _read(where)) is not None:
        return found
    words = [*command(case, algo, seed, flags), "--run-dir", str(where)]
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, check=False)
    if done.returncode:
        print(f"{variant}, {case.env}, seed {seed}: {done.stderr.strip().splitlines()[-1:]}", file=sys.stderr)
    return _read(where)


def _read(where: Path) -> float | None:
    for path in sorted(where.glob("*"), reverse=True):
        summary = RunFolder.open(path).summary()
        if summary is not None and summary.evaluation is not None:
            return summary.evaluation.return_mean
    return None


def show(found: dict[tuple[str, str], list[float]], cases: Sequence[Case], variants: Sequence[str], title: str) -> Table:
    """A table with a row for each environment and a column for each variant: the mean over the seeds, and each seed."""
    table = Table(title=title)
    for column in ("environment", *variants):
        table.add_column(column)
    for case in cases:
        cells = [_cell(found[case.env, variant]) for variant in variants]
        table.add_row(case.env, *cells)
    return table


def _cell(returns: Sequence[float]) -> str:
    if not returns:
        return "–"
    each = ", ".join(map(return_text, returns))
    return each if len(returns) == 1 else f"{return_text(statistics.fmean(returns))} ({each})"


def main() -> None:
    parser = argparse.ArgumentParser(description="returns of environments without a preset")
    parser.add_argument("--algo", default="ppo")
    parser.add_argument("--variant", action="append", default=[], help="NAME=FLAGS, besides the defaults")
    parser.add_argument("--env", action="append", default=[], help="only this environment; repeat it for more")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--jobs", type=int, default=2, help="runs at the same time")
    parser.add_argument("--no-defaults", action="store_true", help="only the variants")
    given = parser.parse_args()
    variants = {} if given.no_defaults else {NOW: ""}
    variants |= dict(text.split("=", 1) for text in given.variant)
    takes = {"dqn": (False,), "rainbow": (False,), "sac": (True,), "td3": (True,)}.get(given.algo, (False, True))
    cases = [
        case
        for case in CASES
        if (not given.env or case.env in given.env)
        and (not case.needs or find_spec(case.needs) is not None)
        and case.continuous in takes
    ]
    runs = [(case, variant, seed) for variant in variants for seed in given.seeds for case in cases]
    with ThreadPoolExecutor(given.jobs) as pool:
        returns = pool.map(lambda run: final_return(run[0], given.algo, run[2], run[1], variants[run[1]]), runs)
        found: dict[tuple[str, str], list[float]] = {(case.env, variant): [] for case, variant, _ in runs}
        for (case, variant, _), reached in zip(runs, returns, strict=True):
            if reached is not None:
                found[case.env, variant].append(reached)
    title = f"{given.algo}: mean return of greedy episodes, seeds {', '.join(map(str, given.seeds))}"
    Console(width=200).print(show(found, cases, list(variants), title))


if __name__ == "__main__":
    main()
