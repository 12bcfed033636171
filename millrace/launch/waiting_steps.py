"""Tells the user if env steps mostly wait for a timer, a GPU or another machine, instead of this machine's cores. Pure.

By default there is one worker for each core. If steps wait, the cores are idle, and a run collects faster if each lane has a
worker of its own. This can't be known before the run, so the workers are watched while they collect.

Rule: a worker counts as computing if any of its threads or processes is running or ready to run, so a worker that lacks a
core isn't taken for one that waits. A simulator may compute outside of its worker's session, as a server on this machine or
in a container. Therefore, the cores must have been idle as well. Only the time between two looks at which workers collected
counts, because an update on these cores, or on a GPU, says nothing about steps. An update that is shorter than the time
between two looks may still count, and if many do, the suggestion may be missing or wrong.

Rule: more workers are only suggested. If some joined during the run, lanes would move to them, and episodes that can't be
replayed would end, so results would depend on the time of joining.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from millrace.learner.config.local_workers import enough_workers
from millrace.protocol.call_timeouts import Doing
from millrace.protocol.machine.core_times import CoreTimes, idle_share
from millrace.workers.supervise.process_group import SessionUse

LOOK_EVERY_S = 0.1
MOST_TIME = 0.05  # share of the time that looks may take, because each reads all of /proc
LOOKS = 50  # this many looks at which workers collected are judged together
# Steps are unlikely to begin to wait after this many looks, counted from the first one at which a worker collected. Earlier
# looks don't count, because simulators that take long to construct may also have slow steps.
MOST_LOOKS = 1000
ENOUGH = 0.5  # if workers wait, and cores are idle, for this share of the time, a core has time for a second worker
OF_MEMORY = 0.8  # share of the available memory that additional workers may take
COLLECTING: frozenset[Doing] = frozenset({"resetting", "stepping", "repeating", "acting"})


class SeenWorker(NamedTuple):
    """A worker at one moment."""

    doing: Doing
    uses: SessionUse


class WaitingSteps:
    """Watches the workers of one run."""

    def __init__(self, workers: int, lanes: int, envs: int) -> None:
        """`workers`: the number that collect. `lanes`, `envs`: those of the run. Without lanes, nothing is watched."""
        self._workers = workers
        self._lanes = lanes
        self._envs = envs
        self._look_at_s = 0.0
        self._looks = 0  # from the first one at which a worker collected
        self._to_judge = 0  # looks at which workers collected, since the last judgement
        self._collecting = 0  # workers seen collecting at these looks, in total
        self._waiting = 0  # how often these workers waited
        self._cores_then: CoreTimes | None = None  # at the last look, if a worker collected
        self._cores = CoreTimes()  # total time between two successive looks at which workers collected

    def is_due(self, now: float) -> bool:
        """Whether to look at the workers now."""
        return self._workers < self._lanes and self._looks < MOST_LOOKS and now >= self._look_at_s

    def look(
        self, workers: Sequence[SeenWorker], cores: CoreTimes, free_bytes: int | None, began_s: float, ended_s: float
    ) -> str:
        """Record what the workers do, as seen from `began_s` to `ended_s`. Returns a line for the user, usually empty.

        `cores`: the times of this machine's cores. `free_bytes`: its available memory; None if it isn't known.
        """
        self._look_at_s = ended_s + max(LOOK_EVERY_S, (ended_s - began_s) / MOST_TIME)
        collecting = [worker for worker in workers if worker.doing in COLLECTING]
        self._looks += bool(collecting or self._looks)
        before = self._cores_then
        self._cores_then = cores if collecting else None
        if not collecting:
            return ""
        if before is not None:
            so_far = self._cores
            self._cores = CoreTimes(so_far.idle + cores.idle - before.idle, so_far.total + cores.total - before.total)
        self._to_judge += 1
        self._collecting += len(collecting)
        self._waiting += sum(not worker.uses.computes for worker in collecting)
        if self._to_judge < LOOKS:
            return ""
        share = self._waiting / self._collecting
        idle = idle_share(CoreTimes(), self._cores)
        self._to_judge = self._collecting = self._waiting = 0
        self._cores = CoreTimes()
        if min(share, idle) < ENOUGH:
            return ""
        self._looks = MOST_LOOKS
        return self._line(share, max(worker.uses.resident for worker in collecting), free_bytes)

    def _line(self, share: float, worker_bytes: int, free_bytes: int | None) -> str:
        most = self._lanes
        if free_bytes is not None:
            most = min(most, self._workers + int(OF_MEMORY * free_bytes / max(worker_bytes, 1)))
        better = enough_workers(self._lanes, most)
        waits = f"env steps wait for {share:.0%} of their time"
        if better <= self._workers:
            return f"{waits}: more workers would be faster, but their memory isn't free"
        whose = "one for each lane" if better == self._lanes else "all that fit into the memory"
        line = f"{waits}: --workers {better}, {whose}, would be faster, with the same results"
        if self._lanes < self._envs:
            line += f"; --lanes {self._envs} would let each env copy have a worker"
        return line
