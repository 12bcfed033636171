"""`python -m tests.system.random_faults.killed_runs`: small runs, each killed at random times, and resumed until it is done.

Rule: only the learner is killed, by SIGKILL; its workers must end by themselves. Each run ends, its ledger is exact, every
update has one row of metrics, every evaluation was made once, and with a checkpoint after every k-th update a kill costs the
work of at most k updates: of those that were whole and not saved, and of the one in progress. No worker process is left. A
learner that is killed when its workers have left leaves an empty folder for temporary files, which is counted. The seed
decides the settings and the kills. The exit code is 1 if this fails. Learners are forked from a process that has imported
PyTorch, except those that are killed while they start.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import IO, Any, NamedTuple, Protocol

from millrace.learner.run_folder import checkpoint
from millrace.learner.run_folder.metrics_log import read_rows
from tests.system.random_faults.marked_train import Marks, Phase, read_marks
from tests.system.stage.processes import ROOT, crowding, wait_for
from tests.system.stage.runs import accounted

AT_ONCE = 3  # runs at a time
ENDS_S = 120.0  # a run that is not killed any more
GONE_S = 15.0  # the workers of a learner that was killed, on an idle machine
LOOK_EVERY_S = 0.001
LANES, ENVS, ROWS, EVERY = 2, 4, 64, 200  # env steps of an update, and between two evaluations
COMMON: dict[str, object] = {
    "lanes": LANES, "envs": ENVS, "net": 8, "steps": 1000, "rollout-steps": ROWS // ENVS, "checkpoint-every-s": 1000,
    "eval-every": EVERY, "eval-episodes": 4, "eval-copies": 2,
}  # fmt: skip
DQN: dict[str, object] = {"algo": "dqn", "learning-starts": 64, "gradient-steps": 4, "replay-size": 600, "batch-size": 16}
PPO: dict[str, object] = {"n-epochs": 2, "batch-size": 32}
TARGET = 9  # a return that an evaluation of a policy at random reaches in nearly every run
VARIANTS: dict[str, dict[str, object]] = {
    "ppo": {**PPO, "checkpoint-every-s": 0, "workers": 2},
    "dqn, prioritized": {**DQN, "priority-alpha": 0.6, "checkpoint-every-s": 0, "workers": 1},
    "a2c, lag 1": {"algo": "a2c", "max-lag": 1, "workers": 2},
    "impala, lag 2": {"algo": "impala", "max-lag": 2, "checkpoint-every-s": 0, "workers": 1},
    "reinforce": {
        "algo": "reinforce", "rollout-steps": 501, "steps": 12_000, "eval-every": 3_000, "checkpoint-every-s": 0,
        "workers": 1,
    },
    "ppo, lstm": {**PPO, "core": "lstm", "core-size": 8, "workers": 1},
    "ppo, learner inference": {**PPO, "inference": "learner", "checkpoint-every-s": 0, "workers": 1},
    "dqn, lag 1, tcp": {
        **DQN, "max-lag": 1, "transport": "tcp", "keep-checkpoints": 1, "workers": 2,
    },
    "ppo to a return": {**PPO, "target-return": TARGET, "checkpoint-every-s": 0, "workers": 1},
}  # fmt: skip
"""Flags of `millrace train CartPole-v1`."""
TIMES_S = {  # from the beginning of a phase until the kill, at most, on an idle machine
    Phase.STARTING: 4.0,
    Phase.COLLECTING: 0.01,
    Phase.UPDATING: 0.02,
    Phase.RECORDING: 0.01,
    Phase.CHECKPOINTING: 0.03,
    Phase.EVALUATING: 0.1,
    Phase.DRAINING: 0.2,
    Phase.LEAVING: 0.3,
}
OCCURS = {Phase.STARTING: 1, Phase.EVALUATING: 3, Phase.DRAINING: 1, Phase.LEAVING: 1}  # how often at least; else 12 times


class Kill(NamedTuple):
    """When a learner is killed: so long after it entered a phase for the n-th time."""

    phase: Phase
    occurrence: int
    after_s: float

    @staticmethod
    def drawn(generator: random.Random) -> Kill:
        """A kill in any phase."""
        phase = generator.choice(list(Phase))
        return Kill(phase, generator.randint(1, OCCURS.get(phase, 12)), generator.uniform(0, TIMES_S[phase]))


@dataclass
class Account:
    """What has happened in all runs."""

    kills: Counter[str] = field(default_factory=Counter)
    """By the phase in which they hit."""
    lost: Counter[str] = field(default_factory=Counter)
    """Kills by whole updates that were made again, and updates between two checkpoints."""
    runs: Counter[str] = field(default_factory=Counter)
    again: int = 0
    """Learners that ended before they were killed."""
    torn: int = 0
    """Kills that left a file that was not written whole."""
    folders: int = 0
    """Temporary folders of learners whose workers had left."""
    tickets: Counter[str] = field(default_factory=Counter)
    short: list[str] = field(default_factory=list)
    """What was not as it must be."""


class Process(Protocol):
    """A learner that was started."""

    def poll(self) -> int | None:
        """The exit code, or None while it runs."""
        ...

    def kill(self) -> None:
        """Send SIGKILL."""
        ...

    def wait(self) -> int:
        """Wait until it has ended. Returns the exit code."""
        ...


class Forker:
    """A process that has imported PyTorch, and forks learners, one at a time."""

    def __init__(self) -> None:
        command = [sys.executable, "-m", "tests.system.random_faults.marked_train", "--fork"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        self._server = subprocess.Popen(
            command, bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT, env=environment
        )

    def start(self, order: Mapping[str, object]) -> Forked:
        """Fork a learner."""
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        self._server.stdin.write(json.dumps(order).encode() + b"\n")
        return Forked(int(self._server.stdout.readline()), self._server.stdout)

    def close(self) -> None:
        """End the process."""
        self._server.kill()
        self._server.communicate()


class Forked:
    """A learner that was forked."""

    def __init__(self, pid: int, says: IO[bytes]) -> None:
        """`says`: gives its exit code as a line, when it has ended."""
        self._pid, self._says = pid, says
        self._code: int | None = None

    def poll(self) -> int | None:
        """The exit code, or None while it runs."""
        if self._code is None and select.select([self._says], [], [], 0)[0]:
            self._code = int(self._says.readline())
        return self._code

    def kill(self) -> None:
        """Send SIGKILL."""
        if self.poll() is None:
            os.kill(self._pid, signal.SIGKILL)

    def wait(self) -> int:
        """Wait until it has ended. Returns the exit code."""
        while (code := self.poll()) is None:
            time.sleep(LOOK_EVERY_S)
        return code


class OneRun:
    """One run: its flags, its kills and its processes."""

    def __init__(self, folder: Path, seed: str, variant: str, account: Account, forker: Forker) -> None:
        self.folder, self.variant, self.account, self._forker = folder, variant, account, forker
        self.random = random.Random(seed)
        self.flags = {**COMMON, **VARIANTS[variant], "seed": self.random.randint(1, 1000)}
        self._name = f"{folder.name}-{os.getpid()}"
        self._numbers = itertools.count()
        folder.mkdir(parents=True)

    def play(self) -> None:
        """Kill and resume the run, then let it end, and check it. Raises AssertionError."""
        kills = self.random.choices([1, 2, 3], [7, 2, 1])[0]
        made = 0
        while made < kills:
            if self._killed(Kill.drawn(self.random)):
                made += 1
            else:
                self.account.again += 1
                if made:
                    break  # the run has ended
                shutil.rmtree(self.folder / "runs")  # each run is killed at least once
        process, said, _ = self._start(forked=True)
        try:
            wait_for(lambda: process.poll() is not None, ENDS_S * crowding(), lambda: f"the end: {_text(said)}", 0.05)
        finally:
            process.kill()
        _ended_well(process, said)
        self._nothing_is_left(Phase.STARTING)
        self._check()

    # ---------------------------------------------------------------- a learner

    def _start(self, *, forked: bool) -> tuple[Process, Path, Path]:
        """Start the run, or go on with it. Returns the process, what it says and its marks."""
        number = next(self._numbers)
        said, marks = self.folder / f"said-{number}.log", self.folder / f"marks-{number}"
        arguments = ["train", "CartPole-v1", "--preset", "none", "--resume", "auto", "--run-dir", str(self.folder / "runs")]
        arguments += ["--tensorboard"]  # one more file that a kill may cut
        for name, value in self.flags.items():
            arguments += [f"--{name}", str(value)]
        (self.folder / "tmp").mkdir(exist_ok=True)
        own = {"TMPDIR": str(self.folder / "tmp"), "KILLED_RUN": self._name}
        if forked:
            order = {"marks": str(marks), "said": str(said), "arguments": arguments, "environment": own}
            return self._forker.start(order), said, marks
        command = [sys.executable, "-m", "tests.system.random_faults.marked_train", str(marks), *arguments]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), **own}
        with said.open("wb") as file:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=file, stderr=file, cwd=ROOT, env=environment
            )
        return process, said, marks

    def _killed(self, kill: Kill) -> bool:
        """Start a learner and kill it. False if it ended before."""
        process, said, file = self._start(forked=kill.phase is not Phase.STARTING)
        if not self._wait(process, file, kill):
            _ended_well(process, said)
            self._nothing_is_left(Phase.STARTING)
            return False
        process.kill()
        process.wait()
        marks = read_marks(file)
        self.account.kills[marks.phase.name.lower()] += 1
        self._nothing_is_left(marks.phase)
        self.account.torn += any((self.folder / "runs").glob("**/*.tmp"))
        self._compare(marks)
        return True

    def _wait(self, process: Process, file: Path, kill: Kill) -> bool:
        """Wait until it is time for the kill. False if the process has ended."""
        deadline, count, entered = time.monotonic() + ENDS_S * crowding(), 0, -1
        while process.poll() is None:
            marks = read_marks(file)
            if marks.phase is kill.phase and marks.entered != entered:
                entered, count = marks.entered, count + 1
            if count >= kill.occurrence:
                break
            assert time.monotonic() < deadline, f"{kill} did not come"
            time.sleep(LOOK_EVERY_S)
        hit_s = time.monotonic() + kill.after_s * (crowding() if kill.phase is Phase.STARTING else 1)
        while time.monotonic() < hit_s and process.poll() is None:
            time.sleep(min(LOOK_EVERY_S, max(0.0, hit_s - time.monotonic())))
        return process.poll() is None

    def _nothing_is_left(self, phase: Phase) -> None:
        """Wait until all processes of this run have ended, by themselves. `phase`: in which the learner was killed."""
        wait_for(
            lambda: not self._processes(),
            GONE_S * crowding(),
            lambda: f"the end of the workers {[Path(f'/proc/{one}/cmdline').read_text() for one in self._processes()]}",
            0.05,
        )
        left = [path for path in (self.folder / "tmp").iterdir() if path.name.startswith("millrace-")]
        # A worker removes the folder of its killed learner: before the first one has started, nobody can.
        without_workers = phase in (Phase.DRAINING, Phase.LEAVING) or not any((self.folder / "runs").glob("*/workers/*"))
        assert not left or without_workers, f"temporary folders were left behind: {left}"
        for path in left:
            shutil.rmtree(path)
            self.account.folders += 1

    def _processes(self) -> list[int]:
        mark = f"KILLED_RUN={self._name}".encode()
        found = []
        for path in Path("/proc").glob("[0-9]*/environ"):
            with suppress(OSError):  # it has ended, or is not ours
                if mark in path.read_bytes().split(b"\0"):
                    found.append(int(path.parent.name))
        return found

    # ---------------------------------------------------------------- what must hold

    def _run(self) -> Path | None:
        """The run folder, if there is one with a checkpoint."""
        found = {path.parent.parent for path in (self.folder / "runs").glob("*/checkpoints/*.pt")}
        assert len(found) < 2, f"the run was begun again: {found}"
        return next(iter(found), None)

    def _compare(self, marks: Marks) -> None:
        """Compare what was done with the checkpoint that the run goes on from."""
        run = self._run()
        if run is None:
            assert marks.saved < 0, f"a checkpoint was written and is gone: {marks}"
            return
        found, warnings = checkpoint.newest(run)
        assert not warnings, warnings
        saved = int(found.state["past"]["state"]["version"])
        every = -(-EVERY // ROWS) if self.flags["checkpoint-every-s"] else 1  # a checkpoint comes before each evaluation
        assert saved >= marks.saved, f"an older checkpoint than the one that was written: {saved}, {marks}"
        table = run / "metrics.jsonl"
        seen = max((int(row["time/iterations"]) for row in read_rows(table)), default=0) if table.exists() else 0
        done = max(seen, marks.whole)
        lost = max(0, done - saved)
        assert lost <= every, f"{lost} whole updates are lost, at most {every} may be: {saved} saved, {seen} seen, {marks}"
        if marks.phase in (Phase.COLLECTING, Phase.UPDATING):
            assert lost < every, f"{lost} whole updates and a part of one are lost: {saved} saved, {seen} seen, {marks}"
        self.account.lost[f"{lost} of {every}"] += 1

    def _check(self) -> None:
        """Check the run that has ended."""
        run = self._run()
        assert run is not None
        summary: dict[str, Any] = json.loads((run / "summary.json").read_text())
        T, steps, most_lag = (int(str(self.flags.get(name, 0))) for name in ("rollout-steps", "steps", "max-lag"))
        ledger = accounted(summary, lanes=LANES, rows=T * ENVS // LANES, max_lag=most_lag)
        self.account.tickets.update({name: ledger[name] for name in ("issued", "used", "lost", "outstanding")})
        rows = read_rows(run / "metrics.jsonl")
        assert [row["time/iterations"] for row in rows] == list(range(1, summary["updates"] + 1)), "rows of metrics"
        assert all("train/n_updates" in row for row in rows[1:] if "eval/mean_reward" not in row)
        returns = self._check_evaluations(rows, summary)
        reached = "target-return" in self.flags and max(returns, default=0.0) >= TARGET
        assert summary["stop_reason"] == (f"target return {TARGET} reached" if reached else "all steps done"), summary
        assert reached or steps - T * ENVS < summary["env_steps"] <= steps
        left = [path.name for path in run.glob("**/*.tmp")]
        assert not left, f"files that a killed process left: {left}"

    def _check_evaluations(self, rows: list[dict[str, Any]], summary: dict[str, Any]) -> list[float]:
        """Each evaluation was made when it was due, and the best of them was kept. Returns their mean returns."""
        every = due = int(str(self.flags["eval-every"]))
        returns = []
        for row in rows:
            is_due = row["time/total_timesteps"] >= due
            assert is_due == ("eval/mean_reward" in row), f"an evaluation at {row['time/total_timesteps']}, due at {due}"
            if is_due:
                due += every
                returns.append(row["eval/mean_reward"])
        # A run that an evaluation has ended reports the newest policy by another one, on which nothing was selected.
        newest = summary["evaluation"]["return_mean"] if summary.get("ended_by") is None else summary["ended_by"]
        best = summary["best"]
        assert best["chosen_by"] == max([*returns, newest]), (best, returns)
        return returns


def _text(said: Path) -> str:
    """What a learner has said; nothing if it has not begun."""
    return said.read_text(errors="replace") if said.exists() else ""


def _ended_well(process: Process, said: Path) -> None:
    assert (code := process.wait()) == 0, f"exit code {code}: {_text(said)}"


def killed_runs(runs: int, seed: int, folder: Path, account: Account, at_once: int = AT_ONCE) -> None:
    """Make this many runs, `at_once` at a time, and count into `account`."""
    variants = list(VARIANTS)

    forkers: SimpleQueue[Forker] = SimpleQueue()

    def one(number: int) -> None:
        forker = forkers.get()
        run = OneRun(folder / f"run-{number}", f"{seed}-{number}", variants[number % len(variants)], account, forker)
        try:
            run.play()
        except AssertionError as error:
            account.short.append(f"run {number}, {run.variant}: {error}")
            print(f"falls short: {account.short[-1]}", file=sys.stderr, flush=True)
        else:
            account.runs[run.variant] += 1
            shutil.rmtree(run.folder)
        finally:
            forkers.put(forker)

    with ThreadPoolExecutor(at_once) as pool, ExitStack() as stack:
        for _ in range(at_once):
            forkers.put(made := Forker())
            stack.callback(made.close)
        for done, _ in enumerate(pool.map(one, range(runs)), 1):
            if done % 10 == 0:
                print(f"{done} of {runs} runs, {sum(account.kills.values())} kills", flush=True)


def show(account: Account, seconds: float) -> None:
    """Print the account."""
    rows: dict[str, object] = {f"kills while {phase}": count for phase, count in sorted(account.kills.items())}
    rows |= {f"runs that ended: {name}": count for name, count in sorted(account.runs.items())}
    rows |= {f"kills after which {name} updates were made again": count for name, count in sorted(account.lost.items())}
    rows |= {f"tickets {name}": f"{count:,}" for name, count in account.tickets.items()}
    rows |= {
        "kills": sum(account.kills.values()),
        "kills that left a file that was not whole": account.torn,
        "kills that left a temporary folder": account.folders,
        "learners that ended before their kill": account.again,
        "runs that ended": sum(account.runs.values()),
        "seconds": f"{seconds:.0f}",
    }
    for name, value in rows.items():
        print(f"  {name:52} {value:>12}")


def main() -> int:
    """Run the program. Returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.system.random_faults.killed_runs", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=random.SystemRandom().getrandbits(31), help="default: any, printed")
    parser.add_argument("--at-once", type=int, default=AT_ONCE, help="runs at a time")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="killed-runs-"))
    print(f"killed runs: seed {options.seed}, {options.runs} runs", flush=True)
    began_s, account = time.monotonic(), Account()
    killed_runs(options.runs, options.seed, folder, account, options.at_once)
    show(account, time.monotonic() - began_s)
    if account.short:
        print(f"killed runs: what the runs said lies in {folder}", file=sys.stderr)
    else:
        shutil.rmtree(folder)
    held = "falls short" if account.short else "all held"
    print(f"killed runs: {held}; again with --runs {options.runs} --seed {options.seed}")
    return 1 if account.short else 0


if __name__ == "__main__":
    sys.exit(main())
