"""The parts of a run's page that a report doesn't have: its current state, its workers, a curve of any metric. Pure.

Rule: text from run folders and from learners is escaped. The page uses plain words, and shows a field's name next to them if
    a reader may know it from elsewhere.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np

from millrace.extras.monitoring.dashboard.lookout import LaneSample, Seen
from millrace.extras.monitoring.metric_names import METRICS, NONE, described, label
from millrace.extras.monitoring.report.charts import DOT_KEY, Segment, Series, bar, chart_for_all_widths
from millrace.extras.monitoring.report.curve import points
from millrace.extras.monitoring.report.history import clock_time
from millrace.extras.monitoring.report.html_parts import return_text, section
from millrace.extras.monitoring.report.reported_runs import ReportedRun
from millrace.learner.members.held_up import in_words
from millrace.learner.run_folder.json_log import LoggedLine
from millrace.learner.run_folder.progress import ENV_STEPS_KEY, RETURN_KEY
from millrace.learner.run_folder.results import EVALUATION_KEY, Best
from millrace.learner.run_folder.sentences import (
    bottleneck,
    duration,
    per_second,
    weights_in_words,
    went_wrong,
    workers_here,
)
from millrace.learner.run_lines import RunLine, algorithm_label, headline
from millrace.protocol.arrays import Doubles
from millrace.protocol.bounds import escaped
from millrace.protocol.messages import Status, WorkerStatus

WIDE = 1080, 360
SHOWN_S = 180.0  # the time that the picture "Who waits for whom" covers
LEAST_SHOWN_S = 30.0
COLORS = {
    "collecting": "b1",
    "updating": "b0",
    "resetting": "b2",
    "evaluating": "b4",
    "starting": "b6",
    "waiting": "wait",
    "no worker": "gone",
}
"""For each activity of a lane or the learner, its class in the style sheet"""
COLUMNS = {"Worker": "", "Process": "late", "Doing": "", "Lanes": "", "Steps/s": "number", "Weights": "",
           "Heard": "number", "Memory": "number"}  # fmt: skip
"""The columns of the table of workers, with their classes in the style sheet"""
MOST_SMOOTHED = 100
MOST_LINES = 10  # largest number of evaluations in the table
MIB = 2**20


class Choice(NamedTuple):
    """The curve that the reader has chosen."""

    metric: str = RETURN_KEY
    over_time: bool = False
    smooth: int = 1
    """number of rows in the moving mean; 1: no smoothing"""

    @staticmethod
    def of(query: Mapping[str, Sequence[str]]) -> Choice:
        """The choice that a URL's query asks for. Missing or invalid parameters get their defaults."""

        def first(name: str, default: str) -> str:
            return query.get(name, [default])[0]

        smooth = first("smooth", "1")
        rows = int(smooth) if smooth.isascii() and smooth.isdecimal() and len(smooth) < 4 else 1
        return Choice(first("metric", RETURN_KEY), first("over", "") == "time", min(max(rows, 1), MOST_SMOOTHED))


def head(line: RunLine, seen: Seen, report: ReportedRun | None, home: str) -> str:
    """The head of the page: which run it is, what it is doing or how it ended, and its newest warning.

    `home`: the address of the page of all runs; empty if the dashboard shows only this run.
    """
    warned = "" if report is None else last_warning(report.log)
    kicker = f'<a href="{home}">millrace: all runs</a>' if home else "millrace"
    title = f"{escape(line.env or line.name)} <small>{escape(algorithm_label(line.algo))}, seed {line.seed}</small>"
    return (
        f'<header><p class="kicker">{kicker}</p><h1>{title}</h1>'
        f'<p class="now {line.state}">{escape(now_sentence(line, seen.problem))}</p>{warned}'
        f'<p class="kicker">{escape(line.name)}</p></header>'
    )


def now_sentence(line: RunLine, problem: str) -> str:
    """Text about what the run is doing now, what slows it down, and what went wrong.

    `problem`: why its learner doesn't answer, if it doesn't.
    """
    if line.state != "training":
        return headline(line)
    held_up = f"Who waits for whom is not known: {problem}." if problem else bottleneck(line.progress)
    wrong = went_wrong(line.progress.ledger)
    return " ".join(filter(None, [headline(line), held_up, f"{wrong}." if wrong else ""]))


def last_warning(log: Sequence[LoggedLine]) -> str:
    """The newest warning, with a link to the others; empty if there was none."""
    warnings = [line for line in log if line.level != "info"]
    if not warnings:
        return ""
    newest = warnings[-1]
    count = f"newest of {len(warnings)} warnings" if len(warnings) > 1 else "warning"
    said = escape(escaped(newest.message).partition("\n")[0])
    return f'<p class="warned"><a href="#history">{count.capitalize()}</a>, {clock_time(newest)}: {said}</p>'


def facts(line: RunLine) -> str:
    """The most important numbers of the run."""
    progress = line.progress
    evaluation = line.summary.evaluation if line.summary else None
    cells = {
        "Return, last 100 episodes": "none yet" if progress.return_mean is None else return_text(progress.return_mean),
        f"Env steps of {progress.total_steps:,}": f"{progress.env_steps_made:,}",
        "Env steps per second": per_second(progress.steps_per_s),
        "Updates": f"{progress.updates:,}",
        "Time of training": duration(progress.wall_s),
        "Started": line.started,
    }
    if evaluation is not None:
        spread = f"{return_text(evaluation.return_mean)} ± {evaluation.return_std:,.1f}"
        cells = {f"Final policy, {evaluation.episodes} greedy episodes": spread} | cells
    items = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(text)}</dd></div>" for name, text in cells.items())
    return f'<section id="facts"><dl class="facts">{items}</dl></section>'


def curve(rows: Sequence[Mapping[str, Any]], choice: Choice) -> str:
    """The curve of one metric, and a form to choose another."""
    names = dict.fromkeys(name for row in rows for name in row if name != ENV_STEPS_KEY)
    if not names:
        return section("Curves", "The first update has not been made yet.", "", "curve")
    metric = choice.metric if choice.metric in names else RETURN_KEY
    meaning = described(metric)[1]
    x, y = _points(rows, metric, choice.over_time)
    series = [Series("thin" if choice.smooth > 1 else "line", 0, x, y, "")] if x.size else []
    if choice.smooth > 1 and x.size:
        series.append(Series("line", 0, x, smoothed(y, choice.smooth), ""))
    if metric == RETURN_KEY:
        at, returns = _points(rows, EVALUATION_KEY, choice.over_time)
        series += [Series("dots", 1, at, returns, "greedy evaluations")] if at.size else []
    x_label = "minutes of training" if choice.over_time else "env steps"
    what = f"{meaning.label} over {x_label}"
    drawn = chart_for_all_widths(series, WIDE, x_label, what) if series else "<p>No value yet.</p>"
    has_dots = any(each.kind == "dots" for each in series)
    legend = f'<ul class="legend"><li>{DOT_KEY}greedy evaluations</li></ul>' if has_dots else ""
    about = meaning.text + f" Unit: {meaning.unit}." * (meaning.unit != NONE)
    form = _form(names, metric, choice)
    figure = f'<div class="panels"><figure>{legend}{drawn}</figure></div>'
    return section(meaning.label.capitalize(), about, form + figure, "curve")


def smoothed(y: Doubles, rows: int) -> Doubles:
    """The moving mean of each value [K] and the values before it, over at most this many rows."""
    sums = np.concatenate([[0.0], np.cumsum(y / rows)])
    ends = np.arange(1, len(y) + 1)
    begins = np.maximum(0, ends - rows)
    return np.asarray((sums[ends] - sums[begins]) * (rows / (ends - begins)))


def _points(rows: Sequence[Mapping[str, Any]], metric: str, over_time: bool) -> tuple[Doubles, Doubles]:
    x, y = points(rows, metric, over_time=over_time).T
    return x / (60.0 if over_time else 1.0), y


def _form(names: Mapping[str, None], metric: str, choice: Choice) -> str:
    groups = dict.fromkeys(METRICS, "")
    for name in sorted(names, key=label):
        groups[described(name)[0]] += _option(name, label(name), metric)
    options = "".join(f'<optgroup label="{escape(title)}">{inner}</optgroup>' for title, inner in groups.items() if inner)

    def choose(name: str, chosen: str, values: Mapping[str, str]) -> str:
        return f'<select name="{name}">{"".join(_option(value, text, chosen) for value, text in values.items())}</select>'

    over = choose("over", "time" if choice.over_time else "steps", {"steps": "env steps", "time": "time of training"})
    kinds = {"1": "not smoothed", "10": "10 rows", "30": "30 rows", "100": "100 rows"}
    smooth = choose("smooth", str(choice.smooth), kinds)
    return (
        f'<form class="choose" method="get"><label>Show <select name="metric">{options}</select></label>'
        f"<label>over {over}</label><label>mean over {smooth}</label><button>Show</button></form>"
    )


def _option(value: str, text: str, chosen: str) -> str:
    return f'<option value="{escape(value)}"{" selected" * (value == chosen)}>{escape(text)}</option>'


def workers(seen: Seen) -> str:
    """The table of workers, grouped by machine; empty if the learner hasn't answered."""
    if seen.status is None:
        return ""
    hosts: dict[str, list[WorkerStatus]] = {}
    for worker in seen.status.workers:
        hosts.setdefault(worker.host, []).append(worker)
    heads = "".join(f'<th scope="col" class="{css}">{name}</th>' for name, css in COLUMNS.items())
    bodies = []
    for host, members in hosts.items():
        speed = sum(worker.steps_per_s for worker in members)
        count = f"{len(members)} worker{'s' * (len(members) > 1)}"
        title = f"<b>{escape(host)}</b><span>{count}, {per_second(speed)} env steps per second</span>"
        rows = "".join(_worker(worker, seen.status) for worker in members)
        bodies.append(
            f'<tbody><tr class="line"><th scope="rowgroup" colspan="{len(COLUMNS)}">{title}</th></tr>{rows}</tbody>'
        )
    about = f"{workers_here(seen.status)}."
    table = f'<table class="runs workers"><thead><tr>{heads}</tr></thead>{"".join(bodies)}</table>'
    return section("Workers", about, f'<div class="scroll">{table}</div>', "workers")


def _worker(worker: WorkerStatus, status: Status) -> str:
    strikes = f' <span class="bad">{worker.strikes} bad messages</span>' if worker.strikes else ""
    name = f'<th scope="row">{escape(worker.worker)}{strikes}</th>'
    slow = worker.doing_s >= 10 and worker.doing != "waiting"
    doing = f"<td{' class=bad' * slow}>{escape(in_words(worker.doing, worker.doing_s))}</td>"
    lanes = ", ".join(map(str, worker.lanes)) if worker.state == "active" else worker.state
    weights = weights_in_words(worker.version, status.version)
    numbers = (
        per_second(worker.steps_per_s),
        f"{worker.silent_s:.0f} s ago",
        f"{worker.resident_bytes / MIB:,.0f} MB" if worker.resident_bytes else "–",
    )
    speed, heard, memory = (f'<td class="number">{text}</td>' for text in numbers)
    name += f'<td class="late">{worker.pid}</td>'
    return f"<tr>{name}{doing}<td>{escape(lanes)}</td>{speed}<td>{weights}</td>{heard}{memory}</tr>"


def who_waits(seen: Seen) -> str:
    """The picture of who waits: a row for the learner and for each lane, with their activities in the last minutes."""
    if not seen.samples:
        return ""
    end_s = seen.samples[-1].at_s
    samples = [each for each in seen.samples if end_s - each.at_s <= SHOWN_S]
    lanes = sorted({lane for each in samples for lane in each.lanes})
    rows = {"learner": _segments(samples, [each.learner for each in samples])}
    rows |= {f"lane {lane}": _segments(samples, [each.lanes.get(lane, "") for each in samples]) for lane in lanes}
    kinds = [kind for kind in COLORS if any(kind in (each.learner, *each.lanes.values()) for each in samples)]
    legend = "".join(f'<li><i class="{COLORS[kind]}"></i>{kind}</li>' for kind in kinds)
    bars = "".join(f'<span class="who">{name}</span>{bar(segments)}<span></span>' for name, segments in rows.items())
    about = "Looked at twice a second since you opened this page, for the last three minutes at most. Now is at the right."
    content = f'<div class="stages lanes"><ul class="legend">{legend}</ul><div class="rows">{bars}</div></div>'
    return section("Who waits for whom", about, content, "lanes")


def _segments(samples: Sequence[LaneSample], kinds: Sequence[str]) -> list[Segment]:
    """The segments of a row. Neighbors of the same kind are joined. A sample lasts until the next one, at most 2 s."""
    end_s = samples[-1].at_s + 1.0
    segments = list[Segment]()
    span_s = max(LEAST_SHOWN_S, end_s - samples[0].at_s)
    for i, (at_s, kind) in enumerate(zip((each.at_s for each in samples), kinds, strict=True)):
        until_s = min(samples[i + 1].at_s if i + 1 < len(samples) else end_s, at_s + 2.0)
        begin = 1 - (end_s - at_s) / span_s
        share = (until_s - at_s) / span_s
        if kind not in COLORS:
            continue
        if (
            segments
            and segments[-1].tooltip == kind
            and math.isclose(segments[-1].begin + segments[-1].share, begin, abs_tol=1e-6)
        ):
            segments[-1] = segments[-1]._replace(share=segments[-1].share + share)
        else:
            segments.append(Segment(begin, share, COLORS[kind], kind))
    return segments


def evaluations(made: Doubles, kept: Best | None = None) -> str:
    """The table of the newest evaluations, with a sentence about the best one.

    `made`: see `MetricsTail.evaluations`. `kept`: the best evaluation in the summary of a run that has ended. It may be the
    evaluation of the final policy, which isn't in `made`.
    """
    if not len(made):
        return ""
    best = len(made) - 1 - int(made[::-1, 1].argmax())  # the newest of equally good evaluations, as in the run itself
    at, highest = made[best, :2] if kept is None else (kept.env_steps, kept.chosen_by)
    which = f"The best of {len(made):,}" if kept is None else "The best of all, that at the end included,"
    about = f"{which} was at {at:,.0f} env steps, with a mean return of {return_text(highest)}."
    lines = [
        f'<tr><th scope="row" class="number">{steps:,.0f}</th><td class="number">{return_text(value)}</td>'
        f'<td class="number">{length:,.1f}</td><td>{"the best" if steps == at else ""}</td></tr>'
        for steps, value, length in made[: -MOST_LINES - 1 : -1]
    ]
    heads = "".join(f'<th scope="col" class="number">{name}</th>' for name in ("Env steps", "Return", "Episode length"))
    table = f"<table><thead><tr>{heads}<th></th></tr></thead><tbody>{''.join(lines)}</tbody></table>"
    return section("Evaluations", about, f'<div class="scroll">{table}</div>', "evaluations")


def logs(newest: Sequence[tuple[str, str]]) -> str:
    """The last lines of the logs of local workers."""
    blocks = "".join(f"<details><summary>{escape(name)}</summary>{_typed(text)}</details>" for name, text in newest)
    return section("Logs of the workers", "The last lines of each.", f"<div>{blocks}</div>", "logs") if blocks else ""


def join(line: RunLine) -> str:
    """The command with which one more worker joins from another machine."""
    if line.owner is None:
        return ""
    if not line.owner.address.startswith("tcp://"):
        about = "Only its own machine reaches this learner. With --bind tcp://0.0.0.0:5555, workers of others can join."
        return section("One more worker", about, "", "join")
    token = " --token default.token" if line.owner.keys else " --insecure"
    command = f"millrace worker {shlex.quote(line.owner.address)}{token}"
    about = "Type this on another machine."
    if line.owner.keys:
        about += f" It needs a join token from {line.owner.keys} of {line.owner.host}."
    return section("One more worker", about, f"<div>{_typed(command)}</div>", "join")


def _typed(text: str) -> str:
    return f'<pre class="log" tabindex="0">{escape(text)}</pre>'
