"""Learning curves, each with the greedy returns of one run over env steps. They are kept in benchmarks/curves.json.

Rule: there is one curve for each environment, system, algorithm and seed; a newer curve replaces the older one. A curve
consists of the run's own evaluations, as raw returns.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec

from benchmarks import kept_records, results
from benchmarks.wall_clock_programs import OURS
from benchmarks.writing import processor
from millrace.learner.config.layers import config_of_run
from millrace.learner.config.local_workers import local_workers
from millrace.learner.run_folder.metrics_log import METRICS_FILE, read_rows
from millrace.learner.run_folder.progress import ENV_STEPS_KEY
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.learner.run_folder.run_format import CONFIG_FILE

CURVES = Path(__file__).with_name("curves.json")
THEIR_CURVE = "curve.jsonl"
RETURN_KEY = "eval/mean_reward"
EVALUATED_KEY = "eval/env_steps"


class Curve(msgspec.Struct, kw_only=True):
    """The curve of one run."""

    env: str
    system: str
    algo: str
    seed: int
    command: str
    """the command of the run, with S in place of the seed"""
    processor: str
    points: list[tuple[int, float]] = []
    """for each evaluation, the env steps and the mean return of its greedy episodes"""

    @property
    def key(self) -> tuple[str, str, str, int]:
        """The fields that identify the curve: a newer curve with the same key replaces it."""
        return self.env, self.system, self.algo, self.seed


class _Point(msgspec.Struct):
    env_steps: int
    returned: float = msgspec.field(name="return")


def read_curves() -> list[Curve]:
    """Read the kept curves."""
    return kept_records.read(CURVES, Curve)


def write_curves(curves: Iterable[Curve]) -> None:
    """Write these curves to the file of kept curves."""
    kept_records.write(CURVES, curves)


def found_in(folder: Path, made_on: str | None) -> Iterator[Curve]:
    """The curves of all runs in this folder. `made_on`: the processor of millrace's runs, if it isn't this machine's."""
    for path in sorted(folder.rglob(THEIR_CURVE)):
        yield of_their_file(path)
    for path in sorted(folder.rglob(CONFIG_FILE)):
        yield of_run(path.parent, made_on or processor())


def of_run(path: Path, made_on: str) -> Curve:
    """The curve of a run folder of millrace."""
    config = config_of_run(path)
    table = path / METRICS_FILE
    rows = read_rows(table) if table.exists() else []
    points = [(int(row.get(EVALUATED_KEY) or row[ENV_STEPS_KEY]), row[RETURN_KEY]) for row in rows if RETURN_KEY in row]
    summary = RunFolder.open(path).summary()
    if summary is not None and summary.evaluation is not None and not (points and points[-1][0] >= summary.env_steps):
        points.append((summary.env_steps, summary.evaluation.return_mean))  # the final one isn't in metrics.jsonl
    words = shlex.split(results.command(config))
    if "--workers" not in words:  # left out where it has no effect, but readers look for it
        words += ["--workers", str(local_workers(config))]
    return Curve(
        env=config.env,
        system=OURS,
        algo=config.algo,
        seed=config.seed,
        command=shlex.join(words),
        processor=made_on,
        points=_rounded(points),
    )


def of_their_file(path: Path) -> Curve:
    """A curve that `benchmarks/wall_clock_stable_baselines3.py` wrote. An incomplete last line is ignored."""
    first, *lines = path.read_bytes().split(b"\n")[:-1]
    read = [msgspec.json.decode(line, type=_Point) for line in lines]
    points = _rounded((point.env_steps, point.returned) for point in read)
    return msgspec.structs.replace(msgspec.json.decode(first, type=Curve), points=points)


def _rounded(points: Iterable[tuple[int, float]]) -> list[tuple[int, float]]:
    return [(env_steps, round(returned, 1)) for env_steps, returned in points]
