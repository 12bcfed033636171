"""Prints the tables of docs/explanation/killed.md: `python -m benchmarks.killed_tables FOLDER ...`.

The folders are those that `benchmarks.killed` wrote, with runs that had `--log-json`; name the undisturbed run first. A
fault's report is what the learner logged between the fault and the next one.
"""

from __future__ import annotations

import hashlib
import json
import re
import statistics
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.killed import FAULTS, SAID
from benchmarks.markdown_tables import table
from millrace.learner.run_folder.metrics_log import read_rows

CONTINUES = re.compile(r"continues at ([\d,]+) env steps")
REPORTS = ("process_failed", "left", "environment_raised", "not_started")
NOTHING = "nothing before the next fault"
SHORTER = (
    (r"(?s)\n.*", ""), (r"; (this counts|\d).*", ""), (r", after update.*", ""), (r"^run \S+ cont", "the run cont"),
    (r", at /\S+, in \w+", ""), (r" w\d( \(\S+\))?", ""), (r"lane \d, copy \d, step \d+: ", ""), (r"[\d,]+ env", "… env"),
)  # fmt: skip
"""Patterns in which reports of the same kind differ, with their replacements"""
Events = list[dict[str, Any]]


class Killed:
    """A run, its faults, and the events that its learners logged."""

    def __init__(self, folder: Path) -> None:
        self.name = folder.name
        (run,) = {path.parent for path in folder.glob("*/config.toml")}
        self.faults: Events = sorted(_lines(folder / FAULTS), key=lambda fault: fault["time"])
        self.events: Events = [event for event in _lines(folder / SAID) if event["event"] != "progress"]
        self.summary: dict[str, Any] = json.loads((run / "summary.json").read_text())
        rows = read_rows(run / "metrics.jsonl")
        self.returns = [row["eval/mean_reward"] for row in rows if "eval/mean_reward" in row]
        self.policy = hashlib.sha256((run / "policy.safetensors").read_bytes()).hexdigest()

    def after(self, number: int) -> Events:
        """The events that were logged between this fault and the next one."""
        begins = self.faults[number]["time"]
        ends = self.faults[number + 1]["time"] if number + 1 < len(self.faults) else "later"
        return [event for event in self.events if begins <= event["time"] < ends]

    def replayed(self) -> int:
        """Number of env steps that new env copies replayed in order to continue their episodes."""
        return sum(event["repeated_steps"] for event in self.events if event["event"] == "lane_continued")

    def begun(self) -> int:
        """Number of env copies that began new episodes instead."""
        return sum(event["new_episodes"] for event in self.events if event["event"] == "lane_continued")

    def made_again(self) -> int:
        """Number of env steps that were taken twice, because they followed the checkpoint from which a run was resumed."""
        found = 0
        for number, fault in enumerate(self.faults):
            saved = [CONTINUES.search(event["message"]) for event in self.after(number)]
            for match in filter(None, saved):
                found += max(0, fault["env_steps"] - int(match[1].replace(",", "")))
        return found

    def column(self) -> list[str]:
        """The run's column in the table that compares runs."""
        learners = 1 + sum(bool(CONTINUES.search(event["message"])) for event in self.events)
        return [
            f"{len(self.faults)}",
            f"{learners}",
            f"{self.summary['env_steps']:,}",
            f"{self.made_again():,}",
            f"{self.replayed():,}",
            f"{self.begun()}",
            ", ".join(f"{each:.1f}" for each in self.returns),
            f"{self.summary['evaluation']['return_mean']:.1f}",
            f"`{self.policy[:12]}`",
        ]


ROWS = (
    "faults", "learner processes", "env steps of the run", "env steps made again after a checkpoint",
    "env steps replayed so that episodes continue", "env copies that began a new episode instead",
    "greedy returns after 4,000, 8,000, 12,000 and 16,000 env steps", "greedy return at the end",
    "SHA-256 of `policy.safetensors`",
)  # fmt: skip


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    """The lines of JSON in a file. Other lines, such as a run's last ones, are text for people."""
    for line in path.read_text().splitlines():
        if line.startswith("{"):
            yield json.loads(line)


def _report(events: Events) -> str:
    """The first report about a fault, without the numbers of workers, lanes and steps."""
    for event in events:
        if event["event"] in REPORTS or CONTINUES.search(event["message"]):
            line = str(event["message"])
            for pattern, replacement in SHORTER:
                line = re.sub(pattern, replacement, line)
            return line
    return NOTHING


def kinds(runs: Sequence[Killed]) -> str:
    """The table with a row for each kind of fault."""
    seconds: dict[str, list[float]] = defaultdict(list)
    reports: dict[str, Counter[str]] = defaultdict(Counter)
    for run in runs:
        for number, fault in enumerate(run.faults):
            seconds[fault["kind"]].append(fault["seconds"])
            reports[fault["kind"]][_report(run.after(number))] += 1
    rows = []
    for kind in sorted(seconds):
        often = [f"{count} × {report}" for report, count in reports[kind].most_common(2)]
        after = seconds[kind]
        rows.append((kind, f"{len(after)}", "; ".join(often), f"{statistics.median(after):.0f} s", f"{max(after):.0f} s"))
    return table(("fault", "times", "what the log said most often", "until the next update: median", "longest"), rows)


def main(folders: Sequence[str]) -> int:
    """Print both tables. Returns the exit code."""
    runs = [Killed(Path(folder)) for folder in folders]
    columns = zip(ROWS, *(run.column() for run in runs), strict=True)
    sys.stdout.write(table(("", *(run.name for run in runs)), columns) + "\n" + kinds(runs))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
