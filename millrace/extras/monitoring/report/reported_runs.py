"""The page's data: the runs, read from their folders, and the groups of runs.

Rule: if a run hasn't finished, the page shows its curve and its progress. Runs whose environments have different keyword
arguments are runs of different environments. Runs form a group if they differ only in their seeds and in settings that don't
affect what is learned from an env step. A run ended by an error or an interrupt belongs to its group but isn't part of the
mean.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from millrace import Evaluation, Summary
from millrace.extras.monitoring.report.curve import Curve, points, read_run_files
from millrace.learner.run_folder.json_log import LoggedLine, newest_lines
from millrace.learner.run_folder.progress_file import last_progress
from millrace.learner.run_folder.regular_files import regular_files
from millrace.learner.run_folder.results import EVALUATION_KEY
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.learner.run_lines import algorithm_label
from millrace.protocol.arrays import Doubles
from millrace.protocol.progress import RunProgress

MAY_DIFFER_IN_A_GROUP = frozenset({
    # what distinguishes the runs of a group
    "seed",
    # when training ends, how often and how long policies are evaluated; but not on which environment (eval_env_kwargs)
    "steps", "target_return", "target_mean_return",
    "eval_episodes", "eval_every", "eval_workers", "eval_copies", "eval_max_steps",
    # where rollouts and updates are computed, and by which processes: except for rounding, the results are the same
    "workers", "min_workers", "launched_workers", "max_env_copies", "inference", "device", "torch_threads",
    "transport", "bind", "advertise", "keys", "insecure",
    # how failures are handled
    "worker_timeout_s", "no_workers_timeout_s", "start_timeout_s", "step_timeout_s", "grace_s", "max_env_failures",
    # what is saved or shown, and where
    "run_dir", "checkpoint_every_s", "keep_checkpoints", "record", "info_keys", "metrics_bind", "dashboard",
})  # fmt: skip
"""Settings that don't affect what is learned from an env step, so runs of a group may differ in them"""
MOST_IMAGES = 16  # largest number of pictures of one observation
MOST_DIFFERENCES = 3  # number of settings listed after a group's name, unless more are needed to distinguish groups
ELSEWHERE = "started elsewhere"
"""Shown as the number of workers if the learner started none"""


@dataclass(frozen=True)
class ReportedRun:
    """A run, as the page shows it."""

    path: Path
    env: str
    algo: str
    seed: int
    settings: dict[str, str]
    """All settings of config.toml, as text."""
    algorithm_settings: frozenset[str]
    """Names of the settings that belong to the algorithm."""
    progress: RunProgress
    """the progress now, or when the run ended"""
    summary: Summary | None
    """the summary; None if the run has not ended"""
    curve: Curve | None
    """the learning curve; None before the first episode has ended"""
    evaluations: Doubles  # [K, 2] env steps and mean return of the evaluations during training
    videos: tuple[Path, ...]
    images: tuple[Path, ...]
    """pictures of what the policy sees, one for each image of an observation"""
    log: tuple[LoggedLine, ...] = ()
    """the run's newest warnings and notices, the oldest of them first"""

    @property
    def evaluation(self) -> Evaluation | None:
        """The evaluation of the final policy, if there was one."""
        return None if self.summary is None else self.summary.evaluation

    @property
    def of_group(self) -> dict[str, str]:
        """The settings that all runs of the group share, by name.

        They include `steps` if a schedule depends on it, such as a learning rate that decreases until all steps are done.
        """
        schedules = [self.settings.get(name) for name in ("learning_rate_schedule", "clip_range_schedule")]
        until_done = "linear" in schedules or self.settings.get("priority_alpha", "0") != "0" or ":" in self.algo
        may_differ = MAY_DIFFER_IN_A_GROUP - {"steps"} if until_done else MAY_DIFFER_IN_A_GROUP
        return {name: value for name, value in self.settings.items() if name not in may_differ}


@dataclass(frozen=True)
class RunGroup:
    """Runs of one environment whose mean is meaningful. They have one color on the page."""

    env: str
    name: str
    """Name of the algorithm, and a letter if the environment has several groups of that algorithm."""
    differences: str
    """Settings that distinguish this group from the other groups of that algorithm; empty if there are none."""
    color: int
    """number of the group's color; groups of the same environment have different colors"""
    runs: tuple[ReportedRun, ...]

    @property
    def curves(self) -> list[Curve]:
        """The curves of the runs in which an episode has ended."""
        return [run.curve for run in self.runs if run.curve is not None]

    @property
    def averaged(self) -> list[Curve]:
        """The curves that are averaged for the mean and the band; empty if there is no mean.

        Runs that were cut short are left out.
        """
        whole = [run.curve for run in self.runs if run.curve is not None and not run.progress.cut_short]
        return whole if len(whole) > 1 else []

    @property
    def label(self) -> str:
        """The group's name and its differences."""
        return f"{self.name} ({self.differences})" if self.differences else self.name

    def legend(self) -> str:
        """The text in the legend: which runs the group's color stands for."""
        label = self.label
        curves = self.curves
        if not curves:
            return f"{label}: no episode has ended yet"
        one_each = len({curve.seed for curve in curves}) == len(curves)
        ended = [run.seed for run in self.runs if run.curve is not None and run.progress.cut_short]
        early = f"seed {', '.join(map(str, ended))} ended early" if one_each else f"{len(ended)} of them ended early"
        if mean := self.averaged:
            kind = "seeds" if one_each else "runs"
            return f"{label}, mean of {len(mean)} {kind}" + (f"; {early}, not in the mean" if ended else "")
        if len(curves) == 1:
            return f"{label}, seed {curves[0].seed}" + (", ended early" if ended else "")
        no_mean = f"; {early}, so there is no mean" if ended else ""
        return f"{label}, {len(curves)} {'seeds' if one_each else 'runs'}{no_mean}"


@dataclass(frozen=True)
class ReportData:
    """All runs of the page, in groups."""

    groups: tuple[RunGroup, ...]
    """the groups; those of the same environment are adjacent"""

    @property
    def runs(self) -> list[tuple[RunGroup, ReportedRun]]:
        """Every run with its group."""
        return [(group, run) for group in self.groups for run in group.runs]

    @property
    def envs(self) -> list[str]:
        """Every environment once."""
        return list(dict.fromkeys(group.env for group in self.groups))

    def short_names(self) -> list[str]:
        """A unique name for each run, in the order of `runs`. If there are several environments or groups, it names them."""
        groups_of_env = Counter(group.env for group in self.groups)
        names = []
        for group, run in self.runs:
            parts = [group.env] if len(groups_of_env) > 1 else []
            parts += [group.name] if groups_of_env[group.env] > 1 else []
            names.append(", ".join([*parts, f"seed {run.seed}"]))
        return [f"{name} ({names[:i].count(name) + 1})" if names.count(name) > 1 else name for i, name in enumerate(names)]


def read_run(path: Path, rows: list[dict[str, Any]] | None = None) -> ReportedRun:
    """Read a run folder. `rows`: the rows of its metrics, if they have already been read.

    Raises `UsageError`, with a one-line message, if the folder can't be read.
    """
    files = read_run_files(path, rows)
    of_algorithm = files.config.get(files.algo)
    summary = RunFolder(path).summary()
    return ReportedRun(
        path=path,
        env=files.env,
        algo=files.algo,
        seed=files.seed,
        settings=_flatten(files.config, files.algo) | ({"workers": ELSEWHERE} if files.workers_elsewhere else {}),
        algorithm_settings=frozenset(of_algorithm if isinstance(of_algorithm, dict) else ()),
        progress=last_progress(path, summary),
        summary=summary,
        curve=files.curve(),
        evaluations=points(files.rows, EVALUATION_KEY),
        videos=tuple(regular_files(path, "videos/*.mp4")),
        images=tuple(regular_files(path, "observation*.png")[:MOST_IMAGES]),
        log=tuple(newest_lines(path)),
    )


def group_runs(runs: Sequence[ReportedRun]) -> ReportData:
    """Put runs into groups. Environments are in the order of their first runs; the runs of a group are sorted by seed."""
    groups = []
    for env in dict.fromkeys(run.env for run in runs):
        by_settings: dict[frozenset[tuple[str, str]], list[ReportedRun]] = {}
        for run in runs:
            if run.env == env:
                by_settings.setdefault(frozenset(run.of_group.items()), []).append(run)
        names: dict[Path, tuple[str, str]] = {}
        for algo in dict.fromkeys(members[0].algo for members in by_settings.values()):
            names |= _names([members[0] for members in by_settings.values() if members[0].algo == algo])
        for color, members in enumerate(by_settings.values()):
            name, differences = names[members[0].path]
            groups.append(RunGroup(env, name, differences, color, tuple(sorted(members, key=lambda run: run.seed))))
    return ReportData(tuple(groups))


def differing_settings(settings: Sequence[Mapping[str, str]]) -> list[str]:
    """Names of the settings that differ between these runs, in the order of the configuration."""
    names = dict.fromkeys(name for each in settings for name in each)
    return [name for name in names if len({each.get(name) for each in settings}) > 1]


def _names(firsts: Sequence[ReportedRun]) -> Iterator[tuple[Path, tuple[str, str]]]:
    """The name and the differences of each group of an algorithm, by the path of the group's first run.

    `firsts`: the first run of each group.
    """
    label = algorithm_label(firsts[0].algo)
    if len(firsts) == 1:
        yield firsts[0].path, (label, "")
        return
    differing = differing_settings([run.of_group for run in firsts])
    differing.sort(key=lambda name: name not in firsts[0].algorithm_settings)  # the algorithm's settings first
    needed = _distinguishing(firsts, differing)
    names = [*needed, *(name for name in differing if name not in needed)]
    shown = names[: max(len(needed), MOST_DIFFERENCES)]
    for i, run in enumerate(firsts):
        texts = [f"{name} {run.settings[name]}" if name in run.settings else f"no {name}" for name in shown]
        texts += [f"{len(names) - len(shown)} more"] if len(names) > len(shown) else []
        yield run.path, (f"{label} {_letters(i)}", ", ".join(texts))


def _distinguishing(runs: Sequence[ReportedRun], names: Sequence[str]) -> list[str]:
    """A few of these settings whose values together distinguish all runs. Earlier settings are preferred."""
    chosen: list[str] = []

    def kinds(more: str) -> int:
        return len({tuple(run.settings.get(name) for name in (*chosen, more)) for run in runs})

    while names and (not chosen or kinds(chosen[-1]) < len(runs)):
        chosen.append(max(names, key=kinds))
    return chosen


def _letters(i: int) -> str:
    """A to Z, then AA, AB and so on."""
    return (_letters(i // 26 - 1) if i >= 26 else "") + chr(ord("A") + i % 26)


def _flatten(config: dict[str, Any], algo: str) -> dict[str, str]:
    """All settings as text. Names of settings in tables other than the algorithm's include the table, as in env_kwargs.g."""
    settings: dict[str, str] = {}
    for name, value in config.items():
        if isinstance(value, dict):
            settings |= {key if name == algo else f"{name}.{key}": _text(inner) for key, inner in value.items()}
        else:
            settings[name] = _text(value)
    return settings


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
