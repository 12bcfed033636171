"""Makes the pages of the dashboard: turns a request into HTML. It reads everything through `KnownRuns` and `Lookout`.

/TOKEN/                         all runs
/TOKEN/run/KEY?metric=…         one run
/TOKEN/compare?run=KEY&run=KEY  several runs, as `millrace report` shows them
/TOKEN/file/KEY/FOLDER/NAME     a video or a picture of a run
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

from millrace.extras.monitoring.dashboard import run_page
from millrace.extras.monitoring.dashboard.http import PageAnswer, PageRequest, StoredBody, refusal
from millrace.extras.monitoring.dashboard.known_runs import KnownRuns, key_of, newest_logs
from millrace.extras.monitoring.dashboard.lookout import Seen
from millrace.extras.monitoring.dashboard.run_page import Choice
from millrace.extras.monitoring.report import ledger_and_stages, sections
from millrace.extras.monitoring.report.history import history
from millrace.extras.monitoring.report.html_parts import document, return_text, section
from millrace.extras.monitoring.report.page import STYLE
from millrace.extras.monitoring.report.reported_runs import ReportData, group_runs
from millrace.learner.run_folder.regular_files import open_regular
from millrace.learner.run_folder.sentences import duration, per_second
from millrace.learner.run_lines import RunLine, algorithm_label
from millrace.protocol.errors import UsageError

SCRIPT = Path(__file__).with_name("page.js")
MOST_FILM_BYTES = 64 * 2**20
MOST_COMPARED = 50
MEDIA = {".mp4": "video/mp4", ".png": "image/png"}

Look = Callable[[Path], Seen]
"""Returns what is known about the learner of a run. From then on, the learner is asked regularly."""


class Site:
    """Makes the page for a request."""

    def __init__(self, runs: KnownRuns, look: Look) -> None:
        self._runs = runs
        self._look = look

    def answer(self, request: PageRequest) -> PageAnswer:
        """The page, or the part of it that was requested. The token in the path was already checked."""
        home = f"/{quote(request.path[0])}/"
        match request.path[1:]:
            case ("",) if (run := self._runs.only) is not None:
                title = run.name
                main = self._run(run, request, home)
            case ("",):
                title = "Runs"
                main = all_runs([self._runs.line(run) for run in self._runs.find().values()], home)
            case ("run", key):
                run = self._runs.find().get(key)
                if run is None:
                    return refusal(404)
                title = run.name
                main = self._run(run, request, home)
            case ("compare",):
                title = "Comparison"
                main = self._compare(request.query.get("run", []), home)
            case ("file", key, *parts):
                return self._file(key, parts)
            case ("style.css",):
                return PageAnswer(STYLE.read_bytes(), "text/css; charset=utf-8")
            case ("page.js",):
                return PageAnswer(SCRIPT.read_bytes(), "text/javascript; charset=utf-8")
            case _:
                return refusal(404)
        head = [
            f'<link rel="stylesheet" href="{home}style.css">',
            f'<script src="{home}page.js" defer></script>',
            '<link rel="icon" href="data:,">',
        ]
        text = f"<main>\n{main}\n</main>" if "part" in request.query else document(f"{title}: millrace", head, main)
        return PageAnswer(text.encode(errors="replace"))

    def _run(self, run: Path, request: PageRequest, home: str) -> str:
        line = self._runs.line(run)
        back = "" if self._runs.only else home
        seen = self._look(run) if line.state == "training" else Seen()
        try:
            content = self._runs.content(run)
        except UsageError as error:
            return run_page.head(line, Seen(problem=str(error)), None, back)
        report = group_runs([content.report])
        parts = [
            run_page.head(line, seen, content.report, back),
            run_page.facts(line),
            run_page.curve(content.rows, Choice.of(request.query)),
            run_page.who_waits(seen),
            run_page.workers(seen),
            run_page.evaluations(content.evaluations, None if line.summary is None else line.summary.best),
            sections.videos(report, _addresses(home, run)),
            sections.images(report, _addresses(home, run)),
            history(report),
            ledger_and_stages.stages(report),
            ledger_and_stages.ledgers(report),
            sections.settings(report),
            run_page.logs(newest_logs(run)),
            run_page.join(line),
            sections.foot(report),
        ]
        return "\n".join(filter(None, parts))

    def _compare(self, keys: Sequence[str], home: str) -> str:
        known = self._runs.find()
        problems = list[str]()
        contents = []
        for key in list(dict.fromkeys(keys))[:MOST_COMPARED]:
            try:
                contents += [self._runs.content(known[key])] if key in known else []
            except UsageError as error:
                problems.append(f'<p class="bad">{escape(str(error))}</p>')
        back = f'<p class="kicker"><a href="{home}">millrace: all runs</a></p>'
        if not contents:
            none = "<p>Choose runs in the list of all runs, then press Compare.</p>"
            return f"<header>{back}<h1>Comparison</h1>{none}{''.join(problems)}</header>"
        report = group_runs([content.report for content in contents])
        parts = [back, *problems, sections.head(report), *comparison(report)]
        return "\n".join(filter(None, parts))

    def _file(self, key: str, parts: Sequence[str]) -> PageAnswer:
        """One of a run's files, if the run's page shows it; otherwise status 404."""
        run = self._runs.find().get(key)
        try:
            shown = self._runs.content(run).report if run is not None else None
        except UsageError:
            shown = None
        if run is None or shown is None:
            return refusal(404)
        wanted = run.joinpath(*parts)
        if wanted not in (*shown.videos, *shown.images):
            return refusal(404)
        try:
            return PageAnswer(_stored(wanted), MEDIA[wanted.suffix])
        except OSError:
            return refusal(404)


def _stored(path: Path) -> StoredBody:
    """The content of a file. Raises `OSError` if it is too large or can't be read."""

    def read(begin: int, end: int) -> bytes:
        with os.fdopen(open_regular(path), "rb") as file:
            return os.pread(file.fileno(), end - begin, begin)

    with os.fdopen(open_regular(path), "rb") as file:
        status = os.fstat(file.fileno())
    if status.st_size > MOST_FILM_BYTES:
        raise OSError(errno.EFBIG, "too large for a page", str(path))
    return StoredBody(f"{status.st_ino}-{status.st_size}-{status.st_mtime_ns}", status.st_size, read)


def comparison(report: ReportData) -> list[str]:
    """The sections that compare runs: those of a report, without videos and pictures."""
    parts = [
        sections.results,
        sections.curves,
        sections.settings,
        ledger_and_stages.ledgers,
        ledger_and_stages.stages,
        sections.foot,
    ]
    return [part(report) for part in parts]


def all_runs(lines: Sequence[RunLine], home: str) -> str:
    """The table of all runs. The user can select several of them for a comparison."""
    training = sum(line.state == "training" for line in lines)
    about = f"{len(lines)} run{'s' * (len(lines) != 1)}, {training} training"
    header = f'<header><p class="kicker">millrace</p><h1>Runs</h1><p>{about}</p></header>'
    if not lines:
        return f"{header}<section><p>No run is here yet. This page shows the first one as soon as it begins.</p></section>"
    columns = {"Run": "", "State": "", "Return": "number", "Done": "number", "Steps/s": "number late", "Started": "late"}
    heads = "".join(f'<th scope="col" class="{css}">{name}</th>' for name, css in columns.items())
    rows = "".join(_run_row(line, home) for line in lines)
    table = (
        f'<div class="scroll"><table class="all"><thead><tr><th></th>{heads}</tr></thead><tbody>{rows}</tbody></table></div>'
    )
    form = f'<form method="get" action="{home}compare">{table}<button>Compare</button></form>'
    return header + section("All runs", "Choose two or more to compare them.", form)


def _run_row(line: RunLine, home: str) -> str:
    key = key_of(line.path)
    choose = f'<td><input type="checkbox" name="run" value="{key}" aria-label="Compare {escape(line.name)}"></td>'
    about = f"{line.env}, {algorithm_label(line.algo)}, seed {line.seed}" if line.env else line.problem
    name = f'<th scope="row"><a href="{home}run/{key}">{escape(about)}</a><small>{escape(line.name)}</small></th>'
    progress = line.progress
    score = "–" if progress.return_mean is None else return_text(progress.return_mean)
    left = "" if line.left_s is None else f"<small>{duration(line.left_s)} left</small>"
    cells = [
        f'<td><b class="state {line.state}">{line.state}</b></td>',
        f'<td class="number">{score}</td>',
        f'<td class="number">{escape(line.done)}{left}</td>',
        f'<td class="number late">{per_second(progress.steps_per_s) if line.has_numbers else "–"}</td>',
        f'<td class="late">{line.started}</td>',
    ]
    return f'<tr id="run-{key}">{choose}{name}{"".join(cells)}</tr>'


def _addresses(home: str, run: Path) -> sections.AddressOf:
    def address(path: Path, kind: str) -> str:
        if path.stat().st_size > MOST_FILM_BYTES:
            return ""
        return f"{home}file/{key_of(run)}/{quote(str(path.relative_to(run)), errors='surrogateescape')}"

    return address
