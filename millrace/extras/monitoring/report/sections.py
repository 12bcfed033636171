"""The sections of the page, as HTML text: results, curves, videos, settings. Pure, except that it reads videos and pictures.

Rule: text from run folders is escaped.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from html import escape
from pathlib import Path

from millrace.extras.monitoring.report.charts import chart_for_all_widths, key
from millrace.extras.monitoring.report.html_parts import return_text, section
from millrace.extras.monitoring.report.panels import WHAT_IS_DRAWN, how_it_is_drawn, panels
from millrace.extras.monitoring.report.reported_runs import ReportData, RunGroup, differing_settings
from millrace.learner.run_folder.episode_window import WINDOW_EPISODES
from millrace.learner.run_folder.regular_files import read
from millrace.learner.run_folder.results import FactMean
from millrace.learner.run_folder.sentences import duration, per_second

WIDE = (1080, 360)
NARROW = (540, 320)
MOST_BYTES_OF_ONE = 4 * 2**20  # largest size of a video or picture on the page
MOST_BYTES_OF_ALL = 24 * 2**20


def title(report: ReportData) -> str:
    """The title of the page: the names of its environments."""
    return report.envs[0] if len(report.envs) == 1 else f"{', '.join(report.envs[:-1])} and {report.envs[-1]}"


def head(report: ReportData) -> str:
    """The head of the page: its title, and totals over all runs."""
    runs = [run.progress for _, run in report.runs]
    facts = [
        f"{len(runs)} runs" if len(runs) > 1 else "1 run",
        f"{sum(run.env_steps for run in runs):,} env steps",
        f"{duration(sum(run.wall_s for run in runs))} of training",
    ]
    return (
        f'<header><p class="kicker">millrace report</p><h1>{escape(title(report))}</h1><p>{" · ".join(facts)}</p></header>'
    )


def results(report: ReportData) -> str:
    """The table of results: a row for each run, under its group."""
    last = f"Last {WINDOW_EPISODES} episodes"
    numbers = dict.fromkeys(("Greedy return", last, "Env steps", "Steps/s", "Wall time", "Updates"), "number")
    columns = {"Run": "text", **numbers, "Ended": "text"}
    heads = "".join(f'<th scope="col" class="{css}">{name}</th>' for name, css in columns.items())
    bodies = "".join(_rows_of_group(group) for group in report.groups)
    table = f'<table class="runs"><thead><tr>{heads}</tr></thead>{bodies}</table>'
    return section("Runs", "", f'<div class="scroll">{table}</div>')


def _rows_of_group(group: RunGroup) -> str:
    rows = []
    for run in group.runs:
        progress = run.progress
        evaluation = run.evaluation
        if evaluation is None:
            greedy = '<strong class="none">–</strong><small>not evaluated</small>'
        else:
            spread = f"± {evaluation.return_std:,.1f}, {evaluation.episodes} episodes"
            cut = f", {evaluation.cut} cut" if evaluation.cut else ""
            greedy = f"<strong>{return_text(evaluation.return_mean)}</strong><small>{escape(spread + cut)}</small>"
            greedy += _facts(evaluation.facts)
        mean = "" if progress.return_mean is None else return_text(progress.return_mean)
        mean += "" if run.summary is None else _facts(run.summary.facts_100)
        cells = [
            greedy,
            mean,
            f"{progress.env_steps:,}",
            per_second(progress.steps_per_s),
            duration(progress.wall_s),
            f"{progress.updates:,}",
        ]
        numbers = "".join(f'<td class="number">{cell}</td>' for cell in cells)
        where = f'<th scope="row" title="{escape(str(run.path))}">seed {run.seed}</th>'
        rows.append(f'<tr>{where}{numbers}<td class="text">{escape(progress.stop_reason or "not finished")}</td></tr>')
    name = f"{key(group.color)}<b>{escape(group.env)}</b> {escape(group.name)}"
    if group.differences:
        name += f"<span>{escape(group.differences)}</span>"
    whole = [run.evaluation for run in group.runs if not run.progress.cut_short]
    returns = [evaluation.return_mean for evaluation in whole if evaluation is not None]
    if len(returns) > 1:
        mean, worst, best = map(return_text, (sum(returns) / len(returns), min(returns), max(returns)))
        which = f" of {len(returns)} of {len(group.runs)} runs" if len(returns) < len(group.runs) else ""
        name += f"<span>greedy {mean} on average{which}, {worst} to {best}</span>"
    return f'<tbody><tr class="line"><th scope="rowgroup" colspan="8">{name}</th></tr>{"".join(rows)}</tbody>'


def _facts(facts: Mapping[str, FactMean]) -> str:
    return "".join(f"<small>{escape(f'{name} {fact}')}</small>" for name, fact in facts.items())


def curves(report: ReportData) -> str:
    """Learning curves: a panel for each environment."""
    size = WIDE if len(report.envs) == 1 else NARROW
    figures = []
    for panel in panels(report):
        legend = "".join(f"<li>{sample}{escape(text)}</li>" for sample, text in panel.legend)
        what = f"Learning curves of {panel.env}"
        drawn = chart_for_all_widths(panel.series, size, "env steps", what) if panel.series else ""
        figures.append(f'<figure><h3>{escape(panel.env)}</h3><ul class="legend">{legend}</ul>{drawn}</figure>')
    about = f"{WHAT_IS_DRAWN}. {how_it_is_drawn(report)}"
    return section("Learning curves", about, f'<div class="panels n{min(len(report.envs), 2)}">{"".join(figures)}</div>')


class Embedded:
    """Puts videos and pictures into the page itself, if they are small enough."""

    def __init__(self) -> None:
        self._room = MOST_BYTES_OF_ALL

    def __call__(self, path: Path, kind: str) -> str:
        """The address of a file: a data URL with its content; empty if the file is too large. `kind`: its media type."""
        size = path.stat().st_size
        if size > min(MOST_BYTES_OF_ONE, self._room):
            return ""
        self._room -= size
        return f"data:{kind};base64,{base64.b64encode(read(path, MOST_BYTES_OF_ONE)).decode()}"


AddressOf = Callable[[Path, str], str]
"""Returns the address of a video or picture from its path and media type; empty if it is too large for the page."""


def images(report: ReportData, address_of: AddressOf | None = None) -> str:
    """What the policy sees: for each environment with images, the pictures of the first run that has some."""
    figures = []
    address_of = address_of or Embedded()
    for env in report.envs:
        runs = [run for group, run in report.runs if group.env == env and run.images]
        for path in runs[0].images if runs else ():
            name = path.stem.removeprefix("observation").lstrip("-")
            alt = escape(f"Image observations of {env}")
            shown = _shown(path, address_of(path, "image/png"), f'<img alt="{alt}" src="', '">')
            caption = f"<figcaption>{escape(env)}<span>{escape(name)}</span></figcaption>"
            figures.append(f"<figure>{shown}{caption}</figure>")
    if not figures:
        return ""
    about = "Image observations at four steps of the first rollout, from above. Stacked frames are side by side."
    return section("What the policy sees", about, f'<div class="seen">{"".join(figures)}</div>')


def videos(report: ReportData, address_of: AddressOf | None = None) -> str:
    """The newest video of each run. If it is too large, only its path is shown."""
    figures = []
    address_of = address_of or Embedded()
    for name, (group, run) in zip(report.short_names(), report.runs, strict=True):
        if not run.videos:
            continue
        newest = max(run.videos, key=lambda path: (path.stat().st_mtime_ns, path.name))
        shown = _shown(newest, address_of(newest, "video/mp4"), '<video controls muted loop playsinline src="', '"></video>')
        caption = f"<figcaption>{key(group.color)}{escape(name)}<span>{escape(newest.name)}</span></figcaption>"
        figures.append(f"<figure>{shown}{caption}</figure>")
    if not figures:
        return ""
    return section("Videos", "Greedy episodes.", f'<div class="films">{"".join(figures)}</div>')


def _shown(path: Path, address: str, before: str, after: str) -> str:
    """A video or picture as part of the page, or a message that it is too large."""
    if not address:
        return f'<p class="none">{path.stat().st_size / 2**20:.1f} MiB, too large for this page:<br>{escape(str(path))}</p>'
    return f"{before}{escape(address)}{after}"


def settings(report: ReportData) -> str:
    """The settings that differ, with a column for each group; the others are in a block that the reader can open."""
    runs = [run for _, run in report.runs]
    differ = differing_settings([run.settings for run in runs])
    same = {name: value for name, value in runs[0].settings.items() if name not in differ}
    folded = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in same.items())
    summary = f"{len(same)} settings are the same in all runs" if len(runs) > 1 else f"{len(same)} settings"
    rest = f'<details><summary>{summary}</summary><dl class="same">{folded}</dl></details>'
    if not differ:
        return section("Settings", "", rest)
    heads = "".join(
        f'<th scope="col">{key(group.color)}<b>{escape(group.env)}</b><br>{escape(group.name)}</th>'
        for group in report.groups
    )
    rows = "".join(_setting(name, report) for name in differ)
    head = f'<thead><tr><th scope="col">What differs</th>{heads}</tr></thead>'
    table = f'<table class="settings">{head}<tbody>{rows}</tbody></table>'
    return section("Settings", "", f'<div class="scroll">{table}</div>{rest}')


def _setting(name: str, report: ReportData) -> str:
    """A row of the table: the value or values of a setting in each group."""
    cells = []
    for group in report.groups:
        values = dict.fromkeys(run.settings[name] for run in group.runs if name in run.settings)
        cells.append(f"<td>{escape(', '.join(values))}</td>" if values else '<td class="none">–</td>')
    return f'<tr><th scope="row"><code>{escape(name)}</code></th>{"".join(cells)}</tr>'


def foot(report: ReportData) -> str:
    """The foot of the page: the paths of the run folders."""
    paths = "".join(f"<li><code>{escape(str(run.path))}</code></li>" for _, run in report.runs)
    return f"<footer><details><summary>Run folders</summary><ul>{paths}</ul></details></footer>"
