"""The sections of the page, as HTML text. Pure but for reading the films that it holds; text from run folders is escaped."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape

import numpy as np

from learner.report.charts import Trace, chart
from learner.report.html_parts import dot, return_text, section, time_text
from learner.report.learning_curves import common_grid
from learner.report.runs import Line, Told, differing
from learner.run_folder.episode_window import WINDOW_EPISODES

WIDE, NARROW = (1080, 360), (540, 320)
FILM_BYTES, ALL_FILMS_BYTES = 4 * 2**20, 24 * 2**20


def title(told: Told) -> str:
    """What the page is about."""
    return told.envs[0] if len(told.envs) == 1 else f"{', '.join(told.envs[:-1])} and {told.envs[-1]}"


def head(told: Told) -> str:
    """Title and totals."""
    numbers = [run.numbers for _, run in told.runs]
    seeds = f"{len(numbers)} runs" if len(numbers) > 1 else "1 run"
    facts = [
        seeds,
        f"{sum(number.env_steps for number in numbers):,} env steps",
        f"{time_text(sum(number.wall_s for number in numbers))} of training",
    ]
    return f'<header><p class="kicker">millrace report</p><h1>{escape(title(told))}</h1><p>{" · ".join(facts)}</p></header>'


def headlines(told: Told) -> str:
    """A row for each run, under the line it belongs to."""
    columns = (
        "Run",
        "Greedy return",
        f"Last {WINDOW_EPISODES} episodes",
        "Env steps",
        "Steps/s",
        "Wall time",
        "Versions",
        "Ended",
    )
    heads = "".join(f'<th scope="col" class="{_side(name)}">{escape(name)}</th>' for name in columns)
    bodies = "".join(_line_of_runs(line) for line in told.lines)
    table = f'<table class="runs"><thead><tr>{heads}</tr></thead>{bodies}</table>'
    return section("Runs", "", f'<div class="scroll">{table}</div>')


def _side(column: str) -> str:
    return "text" if column in ("Run", "Ended") else "number"


def _line_of_runs(line: Line) -> str:
    rows = []
    for run in line.runs:
        n = run.numbers
        if n.evaluation is None:
            greedy = '<strong class="none">–</strong><small>not evaluated</small>'
        else:
            spread = f"± {n.evaluation.return_std:,.1f}, {n.evaluation.episodes} episodes"
            cut = f", {n.evaluation.cut} cut" if n.evaluation.cut else ""
            greedy = f"<strong>{return_text(n.evaluation.return_mean)}</strong><small>{escape(spread + cut)}</small>"
        mean = "" if n.return_mean_100 is None else return_text(n.return_mean_100)
        cells = [greedy, mean, f"{n.env_steps:,}", f"{n.env_steps_per_s:,.0f}", time_text(n.wall_s), f"{n.updates:,}"]
        numbers = "".join(f'<td class="number">{cell}</td>' for cell in cells)
        where = f'<th scope="row" title="{escape(str(run.path))}">seed {run.seed}</th>'
        rows.append(f'<tr>{where}{numbers}<td class="text">{escape(n.ended)}</td></tr>')
    name = f"{dot(line)}<b>{escape(line.env)}</b> {escape(line.name)}"
    if line.differs:
        name += f"<span>{escape(line.differs)}</span>"
    found = [run.numbers.evaluation.return_mean for run in line.runs if run.numbers.evaluation is not None]
    if len(found) > 1:
        mean, worst, best = map(return_text, (sum(found) / len(found), min(found), max(found)))
        name += f"<span>greedy {mean} on average, {worst} to {best}</span>"
    return f'<tbody><tr class="line"><th scope="rowgroup" colspan="8">{name}</th></tr>{"".join(rows)}</tbody>'


def curves(told: Told) -> str:
    """A panel for each environment, a colour for each line, seeds as a band."""
    size = WIDE if len(told.envs) == 1 else NARROW
    panels = []
    for env in told.envs:
        lines = [line for line in told.lines if line.env == env]
        traces = [trace for line in lines for trace in _traces(line)]
        legend = "".join(f"<li>{dot(line)}{escape(_legend(line))}</li>" for line in lines)
        if any(trace.kind == "dots" for trace in traces):
            legend += '<li><i class="ring"></i>greedy evaluations</li>'
        drawn = chart(traces, *size, "env steps", f"Learning curves of {env}") if traces else ""
        panels.append(f'<figure><h3>{escape(env)}</h3><ul class="legend">{legend}</ul>{drawn}</figure>')
    about = f"Return, mean of the last {WINDOW_EPISODES} training episodes."
    if any(len(line.curves) > 1 for line in told.lines):
        about += " Bold: the mean over seeds. Band: from the worst to the best. Thin: each seed."
    return section("Learning curves", about, f'<div class="panels n{min(len(told.envs), 2)}">{"".join(panels)}</div>')


def _legend(line: Line) -> str:
    name = f"{line.name} ({line.differs})" if line.differs else line.name
    found = line.curves
    if not found:
        return f"{name}: no episode has ended yet"
    if len(found) == 1:
        return f"{name}, seed {found[0].seed}"
    kind = "seeds" if len({curve.seed for curve in found}) == len(found) else "runs"
    return f"{name}, {len(found)} {kind}"


def _traces(line: Line) -> Iterable[Trace]:
    found = line.curves
    for curve in found:
        last = f"{return_text(float(curve.returns[-1]))} at {curve.env_steps[-1]:,.0f} env steps"
        says = f"{line.name}, seed {curve.seed}: {last}"
        yield Trace("thin" if len(found) > 1 else "line", line.colour, curve.env_steps, curve.returns, says)
    for run in line.runs:
        if len(run.evaluations):
            steps, returns = run.evaluations.T
            yield Trace("dots", line.colour, steps, returns, f"{line.name}, seed {run.seed}: greedy evaluations")
    if len(found) > 1:
        grid, returns = common_grid(found)
        if grid.size:
            band = np.column_stack([returns.min(0), returns.max(0)])
            yield Trace("band", line.colour, grid, band)
            yield Trace("line", line.colour, grid, returns.mean(0), f"{line.name}: mean of {len(found)}")


def films(told: Told) -> str:
    """The newest film of each run, if it is small enough to be part of the page."""
    figures, left = [], ALL_FILMS_BYTES
    for name, (line, run) in zip(told.short_names(), told.runs, strict=True):
        if not run.films:
            continue
        newest = max(run.films, key=lambda path: (path.stat().st_mtime_ns, path.name))
        size = newest.stat().st_size
        caption = f"<figcaption>{dot(line)}{escape(name)}<span>{escape(newest.name)}</span></figcaption>"
        if size > min(FILM_BYTES, left):
            shown = f'<p class="none">{size / 2**20:.1f} MiB, too large for this page:<br>{escape(str(newest))}</p>'
        else:
            left -= size
            data = base64.b64encode(newest.read_bytes()).decode()
            shown = f'<video controls muted loop playsinline src="data:video/mp4;base64,{data}"></video>'
        figures.append(f"<figure>{shown}{caption}</figure>")
    if not figures:
        return ""
    return section("Films", "Greedy episodes.", f'<div class="films">{"".join(figures)}</div>')


def settings(told: Told) -> str:
    """What differs first, a column for each line; the rest folded."""
    runs = [run for _, run in told.runs]
    differ = differing(runs)
    same = {name: value for name, value in runs[0].settings.items() if name not in differ}
    folded = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in same.items())
    said = f"{len(same)} settings are the same in all runs" if len(runs) > 1 else f"{len(same)} settings"
    rest = f'<details><summary>{said}</summary><dl class="same">{folded}</dl></details>'
    if not differ:
        return section("Settings", "", rest)
    heads = "".join(
        f'<th scope="col">{dot(line)}<b>{escape(line.env)}</b><br>{escape(line.name)}</th>' for line in told.lines
    )
    rows = "".join(_setting(name, told) for name in differ)
    head = f'<thead><tr><th scope="col">What differs</th>{heads}</tr></thead>'
    table = f'<table class="settings">{head}<tbody>{rows}</tbody></table>'
    return section("Settings", "", f'<div class="scroll">{table}</div>{rest}')


def _setting(name: str, told: Told) -> str:
    """Its value in each line: one, but for the seeds."""
    cells = []
    for line in told.lines:
        values = dict.fromkeys(run.settings[name] for run in line.runs if name in run.settings)
        cells.append(f"<td>{escape(', '.join(values))}</td>" if values else '<td class="none">–</td>')
    return f'<tr><th scope="row"><code>{escape(name)}</code></th>{"".join(cells)}</tr>'


def foot(told: Told) -> str:
    """Where all this was read."""
    paths = "".join(f"<li><code>{escape(str(run.path))}</code></li>" for _, run in told.runs)
    return f"<footer><details><summary>Run folders</summary><ul>{paths}</ul></details></footer>"
