"""The report: one HTML page that compares runs.

Rule: the page is one file. It loads nothing from the network and runs no script; its Content-Security-Policy forbids
both. All its data come from the run folders, and text from them is escaped. The same runs give the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from millrace.extras.monitoring.report import ledger_and_stages, sections
from millrace.extras.monitoring.report.history import history
from millrace.extras.monitoring.report.html_parts import document
from millrace.extras.monitoring.report.reported_runs import group_runs, read_run
from millrace.learner.run_folder.atomic_write import write_file
from millrace.protocol.errors import UsageError

CONTENT_SECURITY_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:"
STYLE = Path(__file__).with_name("style.css")


def write_page(runs: Sequence[Path], out: Path) -> Path:
    """Write the page about these run folders. Returns `out`.

    Raises `UserFacingError`, with a one-line message, if a folder cannot be read or `out` cannot be written.
    """
    if out.is_dir():
        raise UsageError(f"{out} is a folder; expected the file to write, as in: --out report.html")
    text = page(runs)
    write_file(out, lambda file: file.write(text.encode(errors="replace")))  # file names may not be UTF-8
    return out


def page(runs: Sequence[Path]) -> str:
    """The page about these run folders, as HTML text.

    Raises `UsageError`, with a one-line message, if a run folder can't be read.
    """
    report = group_runs([read_run(run) for run in dict.fromkeys(runs)])
    body = [
        sections.head(report),
        sections.results(report),
        sections.curves(report),
        sections.images(report),
        sections.videos(report),
        history(report),
        sections.settings(report),
        ledger_and_stages.ledgers(report),
        ledger_and_stages.stages(report),
        sections.foot(report),
    ]
    policy = f'<meta http-equiv="Content-Security-Policy" content="{CONTENT_SECURITY_POLICY}">'
    title = f"{sections.title(report)}: millrace report"
    return document(title, [policy, f"<style>\n{STYLE.read_text()}</style>"], "\n".join(filter(None, body)))
