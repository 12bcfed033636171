"""Times several implementations of the same work in turns. Reports medians of the times, and of the ratios within a turn.

It measures this process's CPU seconds with one thread, which depend less on other load than wall-clock time does.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

from benchmarks.arithmetic import products_ms
from millrace.learner.algorithms.kernels import trained_networks


class Contest(NamedTuple):
    """A piece of work, and several implementations of it."""

    title: str
    rows: int
    """number of rows in an update"""
    peer: str
    """the system that the run `peer` measures"""
    repeats: int
    """number of updates in one call of a run"""
    target: float | None
    """the largest fraction of the peer's time that `ours` should take"""
    runs: Mapping[str, Callable[[], float]]
    """`peer`, `graph` (millrace with autograd) and `ours` (what millrace chooses): functions that perform some updates and
    return the CPU seconds of one
    """


@contextmanager
def passes_in_torch(all_of_them: bool) -> Iterator[None]:
    """Within this context, all networks that are made run in torch if `all_of_them`.

    Otherwise, as in a run, networks run in torch only if they aren't small or aren't on the CPU.
    """
    is_small = trained_networks.is_small
    if all_of_them:
        trained_networks.is_small = lambda spec, device: False
    try:
        yield
    finally:
        trained_networks.is_small = is_small


def repeated(work: Callable[[], object], times: int) -> float:
    """Mean CPU seconds of one call, over `times` calls."""
    start = time.process_time()
    for _ in range(times):
        work()
    return (time.process_time() - start) / times


def measure(contest: Contest, rounds: int) -> dict[str, object]:
    """Medians of the times in milliseconds, and of the ratios. Every other round runs in reverse order."""
    names = list(contest.runs)
    times: dict[str, list[float]] = {name: [] for name in names}
    for turn in range(-3, rounds):
        for name in names[:: 1 if turn % 2 else -1]:
            taken = contest.runs[name]()
            if turn >= 0:  # earlier turns are warm-up
                times[name].append(taken * 1e3)

    def ratio(other: str) -> float:
        return statistics.median(our / its for our, its in zip(times["ours"], times[other], strict=True))

    medians = {f"{name}_ms": statistics.median(found) for name, found in times.items()}
    about = {"update": contest.title, "rows": contest.rows, "peer": contest.peer, "target": contest.target}
    about["products_ms"] = products_ms(contest.runs["graph"], contest.repeats)
    return about | medians | {"ratio": ratio("peer"), "ratio_to_graph": ratio("graph")}
