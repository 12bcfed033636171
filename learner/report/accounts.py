"""The page's accounts of runs, as HTML text: the ledger as sums that balance, and where the time went. Pure."""

from __future__ import annotations

from html import escape

from learner.report.charts import COLOURS, MINUS
from learner.report.html_parts import dot, section, time_text
from learner.report.runs import Told

TICKETS = ("issued", ("used", "outstanding", "stale", "lost"))
TRANSITIONS = ("received", ("used", "waiting", "stale", "duplicate", "late", "invalid"))
WHOSE = {"learner": "The learner", "worker": "All workers together"}


def ledgers(told: Told) -> str:
    """What became of every ticket and every transition, as sums."""
    tables = _balance(told, "Tickets", "", TICKETS) + _balance(told, "Transitions", "transitions_", TRANSITIONS)
    bad = sum(run.numbers.ledger.get("messages_bad", 0) for _, run in told.runs)
    about = "What became of every ticket that was dealt, and of every transition that reached the learner."
    if bad:
        about += f" {bad:,} messages could not be read."
    return section("Ledger", about, f'<div class="scroll">{tables}</div>')


def _balance(told: Told, name: str, prefix: str, kinds: tuple[str, tuple[str, ...]]) -> str:
    whole, parts = kinds
    heads = f'<th scope="col">{name}</th><th scope="col" class="number">{whole}</th>'
    heads += "".join(f'<th></th><th scope="col" class="number">{part}</th>' for part in parts)
    rows = []
    for short, (line, run) in zip(told.short_names(), told.runs, strict=True):
        counts = run.numbers.ledger
        row = f'<th scope="row">{dot(line)}{escape(short)}</th>'
        if prefix + whole not in counts:
            rows.append(f'<tr>{row}<td class="none" colspan="{2 * len(parts) + 1}">not known</td><td></td></tr>')
            continue
        row += f'<td class="number whole">{counts[prefix + whole]:,}</td>'
        for part, sign in zip(parts, "=" + "+" * len(parts), strict=False):
            count = counts.get(prefix + part, 0)
            row += f'<td class="sign">{sign}</td><td class="number{"" if count else " none"}">{count:,}</td>'
        off = counts[prefix + whole] - sum(counts.get(prefix + part, 0) for part in parts)
        wrong = f"off by {off:,}".replace("-", MINUS)
        verdict = f'<td class="bad">{wrong}</td>' if off else '<td class="good">balances</td>'
        rows.append(f"<tr>{row}{verdict}</tr>")
    return f'<table class="ledger"><thead><tr>{heads}<th></th></tr></thead><tbody>{"".join(rows)}</tbody></table>'


def stages(told: Told) -> str:
    """Where the time went, as bars of shares."""
    blocks = "".join(_bars(told, whose, name) for whose, name in WHOSE.items())
    about = "Where the time went. A worker acts with the policy and steps its environments; waiting is grey."
    return section("Stages", about, blocks) if blocks else ""


def _bars(told: Told, whose: str, name: str) -> str:
    """Stages of all runs have the same colours: waiting is grey, the others in the order they come."""
    spent = [
        {key.removeprefix(f"{whose}_"): s for key, s in run.numbers.stages.items() if key.startswith(f"{whose}_")}
        for _, run in told.runs
    ]
    kinds = sorted(dict.fromkeys(kind for seconds in spent for kind in seconds), key=lambda kind: kind == "wait")
    if not any(sum(seconds.values()) > 0 for seconds in spent):
        return ""
    colour = {kind: "wait" if kind == "wait" else f"b{i % COLOURS}" for i, kind in enumerate(kinds)}
    rows = []
    for short, (line, _), seconds in zip(told.short_names(), told.runs, spent, strict=True):
        total = sum(seconds.values())
        shares = {kind: seconds[kind] / total for kind in kinds if total and seconds.get(kind)}
        bar = "".join(
            f'<span class="{colour[kind]}" style="width:{100 * share:.2f}%" '
            f'title="{escape(kind)}: {seconds[kind]:,.1f} s, {100 * share:.1f} %">'
            f"{f'{100 * share:.0f} %' if share > 0.06 else ''}</span>"
            for kind, share in shares.items()
        )
        rows.append(
            f'<span class="who" title="{escape(short)}">{dot(line)}{escape(short)}</span>'
            f'<span class="bar">{bar}</span><span class="total">{time_text(total)}</span>'
        )
    legend = "".join(f'<li><i class="{colour[kind]}"></i>{escape(kind)}</li>' for kind in kinds)
    return (
        f'<div class="stages"><h3>{name}</h3><ul class="legend">{legend}</ul><div class="rows">{"".join(rows)}</div></div>'
    )
