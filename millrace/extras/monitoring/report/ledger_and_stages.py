"""Two sections of the page, as HTML text: the ledger as sums that balance, and the time spent in each stage. Pure."""

from __future__ import annotations

from html import escape

from millrace.extras.monitoring.report.charts import COLORS, MINUS, Segment, bar, key
from millrace.extras.monitoring.report.html_parts import section
from millrace.extras.monitoring.report.reported_runs import ReportData
from millrace.learner.run_folder.sentences import duration

TICKETS = ("issued", ("used", "outstanding", "lost"))
TRANSITIONS = ("received", ("used", "waiting", "duplicate", "late", "invalid"))
PROCESSES = {"learner": "The learner", "worker": "All workers together"}


def ledgers(report: ReportData) -> str:
    """The ledger: the number of tickets and transitions that ended in each state, as sums."""
    tables = _balance(report, "Tickets", "", TICKETS) + _balance(report, "Transitions", "transitions_", TRANSITIONS)
    bad = sum(run.progress.ledger.get("messages_bad", 0) for _, run in report.runs)
    about = "How every ticket that was dealt, and every transition that reached the learner, ended."
    if bad:
        about += f" {bad:,} messages could not be read."
    return section("Ledger", about, f'<div class="scroll">{tables}</div>')


def _balance(report: ReportData, name: str, prefix: str, terms: tuple[str, tuple[str, ...]]) -> str:
    total, parts = terms
    heads = f'<th scope="col">{name}</th><th scope="col" class="number">{total}</th>'
    heads += "".join(f'<th></th><th scope="col" class="number">{part}</th>' for part in parts)
    rows = []
    for short, (group, run) in zip(report.short_names(), report.runs, strict=True):
        counts = run.progress.ledger
        row = f'<th scope="row">{key(group.color)}{escape(short)}</th>'
        if prefix + total not in counts:
            rows.append(f'<tr>{row}<td class="none" colspan="{2 * len(parts) + 1}">not known</td><td></td></tr>')
            continue
        row += f'<td class="number whole">{counts[prefix + total]:,}</td>'
        for part, sign in zip(parts, "=" + "+" * len(parts), strict=False):
            count = counts.get(prefix + part, 0)
            row += f'<td class="sign">{sign}</td><td class="number{"" if count else " none"}">{count:,}</td>'
        difference = counts[prefix + total] - sum(counts.get(prefix + part, 0) for part in parts)
        wrong = f"off by {difference:,}".replace("-", MINUS)
        verdict = f'<td class="bad">{wrong}</td>' if difference else '<td class="good">balances</td>'
        rows.append(f"<tr>{row}{verdict}</tr>")
    return f'<table class="ledger"><thead><tr>{heads}<th></th></tr></thead><tbody>{"".join(rows)}</tbody></table>'


def stages(report: ReportData) -> str:
    """The share of time in each stage, as bars."""
    blocks = "".join(_bars(report, process, name) for process, name in PROCESSES.items())
    about = "Where the time went. A worker acts with the policy and steps its environments; waiting is grey."
    return section("Stages", about, blocks) if blocks else ""


def _bars(report: ReportData, process: str, name: str) -> str:
    """A bar for each run. A stage has the same color in all runs; waiting is gray."""
    spent = [
        {key.removeprefix(f"{process}_"): s for key, s in run.progress.stages.items() if key.startswith(f"{process}_")}
        for _, run in report.runs
    ]
    kinds = sorted(dict.fromkeys(kind for seconds in spent for kind in seconds), key=lambda kind: kind == "wait")
    if not any(sum(seconds.values()) > 0 for seconds in spent):
        return ""
    color = {kind: "wait" if kind == "wait" else f"b{i % COLORS}" for i, kind in enumerate(kinds)}
    rows = []
    for short, (group, _), seconds in zip(report.short_names(), report.runs, spent, strict=True):
        total = sum(seconds.values())
        shares = {kind: seconds[kind] / total for kind in kinds if total and seconds.get(kind)}
        segments = list[Segment]()
        end = 0.0
        for kind, share in shares.items():
            tooltip = f"{kind}: {seconds[kind]:,.1f} s, {100 * share:.1f} %"
            text = f"{100 * share:.0f} %"
            segments.append(Segment(end, share, color[kind], tooltip, text if share > 0.06 else ""))
            end += share
        rows.append(
            f'<span class="who" title="{escape(short)}">{key(group.color)}{escape(short)}</span>'
            f'{bar(segments)}<span class="total">{duration(total)}</span>'
        )
    legend = "".join(f'<li><i class="{color[kind]}"></i>{escape(kind)}</li>' for kind in kinds)
    return (
        f'<div class="stages"><h3>{name}</h3><ul class="legend">{legend}</ul><div class="rows">{"".join(rows)}</div></div>'
    )
