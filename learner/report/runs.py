"""What the page tells of each run, read from its folder; and which runs belong together.

The law: a run that has not finished is told as far as its metrics go. Runs belong together when every setting that decides
how they go is the same, but for the seed; those are the seeds of one line.
"""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from learner.report.learning_curves import Curve
from learner.run_folder.metrics_log import read_rows
from learner.run_folder.progress import ENV_STEPS_KEY, EVALUATION_KEY, RETURN_KEY
from learner.run_folder.results import Evaluation
from learner.run_folder.run_folder import RunFolder
from learner.run_folder.run_format import check_format
from protocol.arrays import Doubles
from protocol.errors import UsageError

NOT_THE_SAME_LINE = ("seed", "run_dir")  # settings that may differ between the runs of one line
NAMED = 3  # differing settings that are told with the name of a line


class Numbers(NamedTuple):
    """How far a run got, and how."""

    env_steps: int
    updates: int
    wall_s: float
    env_steps_per_s: float
    return_mean_100: float | None
    evaluation: Evaluation | None
    ended: str
    """why it stopped, in words; that it has not, if it has not"""
    ledger: dict[str, int]
    stages: dict[str, float]


@dataclass(frozen=True)
class Run:
    """One run."""

    path: Path
    env: str
    algo: str
    seed: int
    settings: dict[str, str]
    """all of config.toml, flatly"""
    own: frozenset[str]
    """which of them are the algorithm's own"""
    numbers: Numbers
    curve: Curve | None
    """None before the first episode has ended"""
    evaluations: Doubles  # [K, 2] env steps and greedy return, while it trained
    films: tuple[Path, ...]


@dataclass(frozen=True)
class Line:
    """Runs that differ in their seeds alone."""

    env: str
    name: str
    """the algorithm, and a letter if the environment has several lines of it"""
    differs: str
    """the settings that tell it from those, as far as they are few; empty if there are none"""
    colour: int
    """which of the page's colours, among the lines of its environment"""
    runs: tuple[Run, ...]

    @property
    def curves(self) -> list[Curve]:
        """Of the runs in which an episode has ended."""
        return [run.curve for run in self.runs if run.curve is not None]


@dataclass(frozen=True)
class Told:
    """All that the page is about."""

    lines: tuple[Line, ...]
    """those of one environment beside each other"""

    @property
    def runs(self) -> list[tuple[Line, Run]]:
        """Every run with its line."""
        return [(line, run) for line in self.lines for run in line.runs]

    @property
    def envs(self) -> list[str]:
        """Every environment once."""
        return list(dict.fromkeys(line.env for line in self.lines))

    def short_names(self) -> list[str]:
        """A name for each run that no other has: the environment and the line only where there are several."""
        of_env = Counter(line.env for line in self.lines)
        names = []
        for line, run in self.runs:
            env = [line.env] if len(of_env) > 1 else []
            names.append(", ".join([*env, *([line.name] if of_env[line.env] > 1 else []), f"seed {run.seed}"]))
        return [f"{name} ({names[:i].count(name) + 1})" if names.count(name) > 1 else name for i, name in enumerate(names)]


def read_run(path: Path) -> Run:
    """A run folder. Raises `UsageError` in one line."""
    check_format(path)
    try:
        config = tomllib.loads((path / "config.toml").read_text())
        env, algo, seed = str(config["env"]), str(config["algo"]), int(config["seed"])
        rows = read_rows(path / "metrics.jsonl")
    except FileNotFoundError as error:
        what = f"no {Path(error.filename).name}" if path.is_dir() else "no such folder"
        raise UsageError(f"run {path}: expected a run folder to report on, got {what}") from error
    except (OSError, ValueError, KeyError, TypeError, msgspec.MsgspecError) as error:
        raise UsageError(f"run {path} cannot be reported on: {error}") from error
    points = [(row[ENV_STEPS_KEY], row[RETURN_KEY]) for row in rows if row.get(RETURN_KEY) is not None]
    greedy = [(row[ENV_STEPS_KEY], row[EVALUATION_KEY]) for row in rows if row.get(EVALUATION_KEY) is not None]
    return Run(
        path=path,
        env=env,
        algo=algo,
        seed=seed,
        settings=flat(config, algo),
        own=frozenset(config.get(algo) or ()),
        numbers=_numbers(path, rows),
        curve=Curve(env, algo, seed, *np.asarray(points, np.float64).T) if points else None,
        evaluations=np.asarray(greedy, np.float64).reshape(-1, 2),
        films=tuple(sorted((path / "videos").glob("*.mp4"))),
    )


def flat(config: dict[str, Any], algo: str) -> dict[str, str]:
    """Settings by name, as text; those of the algorithm by their own names, those of other tables by the table's too."""
    settings: dict[str, str] = {}
    for name, value in config.items():
        if isinstance(value, dict):
            settings |= {key if name == algo else f"{name}.{key}": _text(inner) for key, inner in value.items()}
        else:
            settings[name] = _text(value)
    return settings


def differing(runs: Sequence[Run], but: Iterable[str] = ()) -> list[str]:
    """Settings that are not the same in all of these runs, in the order of the configuration."""
    names = dict.fromkeys(name for run in runs for name in run.settings)
    return [name for name in names if name not in but and len({run.settings.get(name) for run in runs}) > 1]


def group(runs: Sequence[Run]) -> Told:
    """Runs as lines: environments in the order of their first run, seeds in order."""
    lines = []
    for env in dict.fromkeys(run.env for run in runs):
        here = [run for run in runs if run.env == env]
        together: dict[tuple[tuple[str, str], ...], list[Run]] = {}
        for run in here:
            same = tuple(sorted((k, v) for k, v in run.settings.items() if k not in NOT_THE_SAME_LINE))
            together.setdefault(same, []).append(run)
        firsts = [members[0] for members in together.values()]
        for colour, members in enumerate(together.values()):
            name, differs = _name(members[0], [run for run in firsts if run.algo == members[0].algo])
            lines.append(Line(env, name, differs, colour, tuple(sorted(members, key=lambda run: run.seed))))
    return Told(tuple(lines))


def _name(run: Run, rivals: Sequence[Run]) -> tuple[str, str]:
    """Name and differing settings of the line that this run is the first of, among the first of all with its algorithm."""
    if len(rivals) == 1:
        return run.algo.upper(), ""
    names = [n for n in differing(rivals, NOT_THE_SAME_LINE) if all(n in rival.settings for rival in rivals)]
    names.sort(key=lambda name: name not in run.own)  # those of the algorithm say most
    more = [f"{len(names) - NAMED} more"] if len(names) > NAMED else []
    said = ", ".join([*(f"{name} {run.settings[name]}" for name in names[:NAMED]), *more])
    return f"{run.algo.upper()} {_letters(rivals.index(run))}", said


def _letters(i: int) -> str:
    """A to Z, then AA, AB and so on."""
    return (_letters(i // 26 - 1) if i >= 26 else "") + chr(ord("A") + i % 26)


def _numbers(path: Path, rows: Sequence[dict[str, Any]]) -> Numbers:
    summary = RunFolder(path).summary()
    if summary is not None:
        return Numbers(
            summary.env_steps, summary.updates, summary.wall_s, summary.env_steps_per_s, summary.return_mean_100,
            summary.evaluation, summary.stop_reason, summary.ledger, summary.stages,
        )  # fmt: skip
    last = rows[-1] if rows else {}
    env_steps, wall_s = int(last.get(ENV_STEPS_KEY) or 0), float(last.get("time/time_elapsed") or 0)
    return Numbers(
        env_steps=env_steps,
        updates=int(last.get("time/iterations") or 0),
        wall_s=wall_s,
        env_steps_per_s=env_steps / wall_s if wall_s else 0.0,
        return_mean_100=last.get(RETURN_KEY),
        evaluation=None,
        ended="not finished",
        ledger={name.removeprefix("ledger/"): int(last[name]) for name in last if name.startswith("ledger/")},
        stages={name.removeprefix("stage/"): float(last[name]) for name in last if name.startswith("stage/")},
    )


def _text(value: Any) -> str:
    match value:
        case bool():
            return "yes" if value else "no"
        case list():
            return " ".join(map(_text, value)) or "none"
        case float():
            return f"{value:g}" if float(f"{value:g}") == value else repr(value)
        case _:
            return str(value)
