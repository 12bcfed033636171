"""The section of the page that lists the runs' warnings, as HTML text. Pure."""

from __future__ import annotations

from html import escape

from millrace.extras.monitoring.report.html_parts import section
from millrace.extras.monitoring.report.reported_runs import ReportData
from millrace.learner.run_folder.json_log import LoggedLine
from millrace.protocol.bounds import escaped

MOST_HISTORY = 30  # largest number of lines on the page
AT_ONCE = 8  # number of lines shown at first; the others are in a block that the reader can open


def history(report: ReportData) -> str:
    """The warnings and notices of the runs, the newest first."""
    names = report.short_names() if len(report.runs) > 1 else [""]
    lines = [(line, name) for name, (_, run) in zip(names, report.runs, strict=True) for line in reversed(run.log)]
    lines.sort(key=lambda each: each[0].time, reverse=True)
    items = [_logged(line, name) for line, name in lines[:MOST_HISTORY]]
    about = "Warnings and notices of the learner, the newest first." if lines else "There were no warnings."
    if len(lines) > MOST_HISTORY:
        about += f" {len(lines) - MOST_HISTORY} earlier lines are in log.jsonl of the run folder."
    first, more = (f'<ol class="history">{"".join(part)}</ol>' * bool(part) for part in (items[:AT_ONCE], items[AT_ONCE:]))
    folded = f"<details><summary>{len(items) - AT_ONCE} before these</summary>{more}</details>" * bool(more)
    return section("What happened", about, first + folded, "history")


def clock_time(line: LoggedLine) -> str:
    """The local time of the line."""
    return f"{line.time:%Y-%m-%d %H:%M:%S}"


def _logged(line: LoggedLine, run: str) -> str:
    text, _, more = escaped(line.message).partition("\n")
    when = ", ".join(filter(None, (clock_time(line), run)))
    said = f"<small>{escape(when)}</small> {escape(text)}"
    if more:
        said = f'<details><summary>{said}</summary><pre class="log" tabindex="0">{escape(more)}</pre></details>'
    return f'<li class="{"notice" if line.level == "info" else "warning"}">{said}</li>'
