"""The report about a client, as lines for people and as plain data for programs. Pure.

Rule: a reader who has never seen the code must understand a failure. The report quotes the broken rule in the words of the
wire document, says where the rule is, what was expected, what the client did, and what to do next.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from textwrap import wrap
from typing import Any

from millrace.extras.conformance.examiner import CheckResult
from millrace.extras.conformance.mends import MENDS, TOO_SLOW
from millrace.protocol.rules import Rule

WIDTH = 110
NUMBER = re.compile(r"\d{3,}")  # matches sessions and tickets, but not shapes or exit codes, which have fewer digits
MARKS = {"passed": "ok     ", "failed": "FAILED ", "skipped": "skipped"}


def line_of(result: CheckResult) -> str:
    """One line about the outcome of a check."""
    note = f"  ({result.note})" if result.note else ""
    return f"{MARKS[result.outcome]}  {result.name}{note}"


def explanation(result: CheckResult, earlier: Sequence[CheckResult] = ()) -> list[str]:
    """Indented lines that explain a failure; none for other outcomes.

    If an earlier check failed in the same way, the only line is a reference to that check.
    """
    if result.outcome != "failed":
        return []
    same = next((each for each in earlier if _essence(each) == _essence(result)), None)
    if same is not None:
        return [f"           as in: {same.name}"]
    parts = {
        "rule": _rule(result.rule),
        "expected": result.expected,
        "got": result.got,
        "next": _next(result.rule),
    }
    return [
        f"           {label if not at else '':9} {line}"
        for label, text in parts.items()
        for at, line in enumerate(wrap(text, WIDTH - 21) or [""])
    ]


def _rule(rule: Rule | None) -> str:
    if rule is None:
        return "A check ends within its deadline"
    return f"{rule}: {rule.words.text}. ({rule.words.where})"


def _next(rule: Rule | None) -> str:
    return TOO_SLOW if rule is None else MENDS[rule]


def _essence(result: CheckResult) -> tuple[object, str, str]:
    """A failure without its numbers, such as sessions and tickets, which differ from check to check."""
    return result.rule, NUMBER.sub("", result.expected), NUMBER.sub("", result.got)


def summary(results: Sequence[CheckResult]) -> str:
    """The last line of the report."""
    counts = {outcome: sum(each.outcome == outcome for each in results) for outcome in MARKS}
    seconds = sum(each.seconds for each in results)
    skipped = f", {counts['skipped']} skipped" if counts["skipped"] else ""
    verdict = "the client does not conform" if counts["failed"] else "the client conforms"
    return f"{counts['passed']} checks passed, {counts['failed']} failed{skipped}, {seconds:.0f} s: {verdict}"


def as_data(results: Sequence[CheckResult], profile: str, command: Sequence[str]) -> dict[str, Any]:
    """The report as plain data, for a program."""
    return {
        "profile": profile,
        "command": list(command),
        "conforms": all(each.outcome != "failed" for each in results),
        "checks": [
            {
                "name": each.name,
                "outcome": each.outcome,
                "seconds": round(each.seconds, 3),
                "section": each.rule.words.section if each.rule else "",
                "name_of_rule": each.rule.name if each.rule else "",
                "rule": each.rule.words.text if each.rule else "",
                "expected": each.expected,
                "got": each.got,
                "next": _next(each.rule) if each.outcome == "failed" else "",
                "note": each.note,
            }
            for each in results
        ],
    }
