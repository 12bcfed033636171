"""Trains a run while injecting faults: it kills and suspends the run's processes, at times that depend only on a seed.

`python -m benchmarks.killed FOLDER --faults 40 -- millrace train ENV ...` repeats the command with `--resume auto` whenever
the learner ends before the run is finished. `--faults 0` trains the same run undisturbed. `benchmarks.killed_tables`
compares such runs.

Rule: a fault is injected when the run reaches a certain number of env steps, so that a slow machine gets as many faults as a
fast one. Only processes that descend from this one are affected. FOLDER contains the run folder, the output of the learners,
and faults.jsonl.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import psutil

LOOK_EVERY_S = 0.05
STOPPED_S, HANGS_S = 8.0, 30.0
FAULTS, SAID = "faults.jsonl", "said.log"
WORKER, NOT_A_SIMULATOR = " -m millrace.workers ", "resource_tracker"
FIRST_STEPS, LAST_PART = 500, 0.97
"""faults are injected between this number of env steps and this fraction of the run"""


@dataclass
class Fault:
    """A fault, and how long it took until training continued."""

    kind: str
    due: int
    """number of env steps at which the fault is due"""
    time: str = ""
    """time at which the fault was injected"""
    env_steps: int = 0
    """env steps of the newest update at that time"""
    saved: int = 0
    """env steps of the newest checkpoint at that time"""
    seconds: float = 0.0
    """seconds from the fault until an update with more env steps"""


class Run:
    """A run, and the learner process that trains it."""

    def __init__(self, folder: Path, command: list[str]) -> None:
        self.folder = folder
        self._command = [*command, "--resume", "auto", "--run-dir", str(folder)]
        self.learner = self._started()

    def _started(self) -> psutil.Popen:
        with (self.folder / SAID).open("a") as said:
            return psutil.Popen(self._command, stdin=subprocess.DEVNULL, stdout=said, stderr=said)

    def resume(self) -> None:
        """Wait until the learner has ended, and start the next one."""
        self.learner.wait()
        self.learner = self._started()

    def workers(self) -> list[psutil.Process]:
        """The local workers that are running."""
        return [one for one in _children(self.learner) if WORKER in _line(one)]

    def simulators(self) -> list[psutil.Process]:
        """The processes that workers have started, except Python's resource tracker."""
        found = [one for worker in self.workers() for one in _children(worker)]
        return [one for one in found if NOT_A_SIMULATOR not in _line(one)]

    def env_steps(self) -> int:
        """The env steps of the newest update."""
        found = 0
        for rows in self.folder.glob("*/metrics.jsonl"):
            with rows.open("rb") as file:
                file.seek(max(0, file.seek(0, 2) - 20_000))
                found = max([found, *(int(n) for n in re.findall(rb'"time/total_timesteps":(\d+)', file.read()))])
        return found

    def saved(self) -> int:
        """The env steps of the newest checkpoint; 0 before the first one."""
        return max((int(path.stem) for path in self.folder.glob("*/checkpoints/*.pt")), default=0)


Cause = Callable[[Run, random.Random], bool]
"""Injects a fault. Returns False if there is no process yet that it could affect."""


def _children(process: psutil.Process) -> list[psutil.Process]:
    with suppress(psutil.Error):
        return sorted((one for one in process.children() if _lives(one)), key=lambda one: one.pid)
    return []


def _lives(process: psutil.Process) -> bool:
    with suppress(psutil.Error):
        return bool(process.status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_STOPPED))
    return False


def _line(process: psutil.Process) -> str:
    with suppress(psutil.Error):
        return " ".join(process.cmdline())
    return ""


def _to(processes: Callable[[Run], list[psutil.Process]], number: signal.Signals, stopped_s: float = 0.0) -> Cause:
    """A fault that sends a signal to one of these processes. If the signal suspends it, it resumes after `stopped_s`."""

    def fault(run: Run, generator: random.Random) -> bool:
        if not (found := processes(run)):
            return False
        one = generator.choice(found)
        with suppress(psutil.NoSuchProcess):
            one.send_signal(number)
            if stopped_s:
                time.sleep(stopped_s)
                one.send_signal(signal.SIGCONT)
        return True

    return fault


def _to_the_learner(number: signal.Signals) -> Cause:
    """A fault that ends the learner, and starts the next one. It can't be injected before the run has a checkpoint."""

    def fault(run: Run, generator: random.Random) -> bool:
        if not run.saved():
            return False
        run.learner.send_signal(number)
        run.resume()
        return True

    return fault


KINDS: Mapping[str, Cause] = {
    "worker: SIGKILL": _to(Run.workers, signal.SIGKILL),
    "worker: SIGTERM": _to(Run.workers, signal.SIGTERM),
    f"worker: SIGSTOP for {STOPPED_S:.0f} s": _to(Run.workers, signal.SIGSTOP, STOPPED_S),
    "learner: SIGKILL": _to_the_learner(signal.SIGKILL),
    "learner: SIGTERM": _to_the_learner(signal.SIGTERM),
    "simulator: SIGKILL": _to(Run.simulators, signal.SIGKILL),
    f"simulator: SIGSTOP for {HANGS_S:.0f} s": _to(Run.simulators, signal.SIGSTOP, HANGS_S),
}
WEIGHTS = {"worker: SIGKILL": 3, "learner: SIGKILL": 2, "simulator: SIGKILL": 2}
"""relative frequency with which a kind is sampled; other kinds have 1"""


def drawn(count: int, steps: int, victims: list[str], generator: random.Random) -> list[Fault]:
    """Sample `count` faults for a run of `steps` env steps, in order. Each kind occurs, if there are enough faults.

    `victims`: the kinds of processes that faults affect.
    """
    kinds = [kind for kind in KINDS if kind.partition(":")[0] in victims]
    weights = [WEIGHTS.get(kind, 1) for kind in kinds]
    chosen = (kinds + generator.choices(kinds, weights, k=count))[:count]
    generator.shuffle(chosen)
    due = sorted(generator.randint(FIRST_STEPS, int(LAST_PART * steps)) for _ in range(count))
    return [Fault(kind, at) for kind, at in zip(chosen, due, strict=True)]


def disturbed(run: Run, faults: list[Fault], generator: random.Random) -> Iterator[Fault]:
    """Train to the end, and yield each fault once training has continued after it."""
    coming, open_faults = list(faults), list[tuple[float, Fault]]()
    while True:
        code, now, steps = run.learner.poll(), time.monotonic(), run.env_steps()
        for began_s, fault in list(open_faults):
            if steps > fault.env_steps or code == 0:
                fault.seconds = round(now - began_s, 1)
                open_faults.remove((began_s, fault))
                yield fault
        if code == 0:
            return
        if code is not None:
            run.resume()
        elif coming and steps >= coming[0].due:
            fault = coming[0]
            fault.time, fault.env_steps, fault.saved = datetime.now(UTC).isoformat(), steps, run.saved()
            if KINDS[fault.kind](run, generator):
                open_faults.append((now, coming.pop(0)))
        time.sleep(LOOK_EVERY_S)


def main() -> int:
    """Train with faults, and log them. Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--faults", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1, help="of the faults")
    parser.add_argument("--victims", nargs="+", default=["worker", "learner", "simulator"])
    parser.add_argument("command", nargs="+", help="after --: millrace train ENV ... --steps N")
    flags = parser.parse_args()
    steps = int(flags.command[flags.command.index("--steps") + 1])
    generator = random.Random(flags.seed)
    faults = drawn(flags.faults, steps, flags.victims, generator)
    flags.folder.mkdir(parents=True)
    run = Run(flags.folder, flags.command)
    with (flags.folder / FAULTS).open("w") as log:
        for fault in disturbed(run, faults, generator):
            log.write(json.dumps(asdict(fault)) + "\n")
            log.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
