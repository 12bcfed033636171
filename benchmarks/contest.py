"""The same work in several ways, timed in turns: medians of many short turns, and of the ratios within each.

CPU seconds of this process, one thread: what else the machine does moves them less than the clock on the wall.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple


class Contest(NamedTuple):
    """A piece of work; each run does some of it and gives its CPU seconds."""

    title: str
    rows: int
    peer: str
    """who the run `peer` is; the others are `graph` (ours by autograd) and `ours` (as it is chosen)"""
    target: float | None
    """what our time may be, as a share of the peer's"""
    runs: Mapping[str, Callable[[], float]]


def repeated(work: Callable[[], object], times: int) -> float:
    """CPU seconds of one, over so many."""
    start = time.process_time()
    for _ in range(times):
        work()
    return (time.process_time() - start) / times


def measure(contest: Contest, rounds: int) -> dict[str, object]:
    """Medians in milliseconds, and of the ratios; every other round goes backwards."""
    names = list(contest.runs)
    times: dict[str, list[float]] = {name: [] for name in names}
    for turn in range(-3, rounds):
        for name in names[:: 1 if turn % 2 else -1]:
            taken = contest.runs[name]()
            if turn >= 0:  # those before warm up
                times[name].append(taken * 1e3)

    def ratio(other: str) -> float:
        return statistics.median(our / its for our, its in zip(times["ours"], times[other], strict=True))

    medians = {f"{name}_ms": statistics.median(found) for name, found in times.items()}
    about = {"update": contest.title, "rows": contest.rows, "peer": contest.peer, "target": contest.target}
    return about | medians | {"ratio": ratio("peer"), "ratio_to_graph": ratio("graph")}
