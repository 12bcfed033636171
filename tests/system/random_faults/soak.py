"""`python -m tests.system.random_faults.soak`: eight workers learn in a slow environment, with a fault every two seconds.

Rule: in spite of the faults, training goes on for the given time and ends; the policy is as good as without faults; every
ticket, transition and evaluation is accounted for; memory, open files and logs do not grow; nothing is left behind; and the
traces of the learner and of the workers are accepted by the model (`tests/model/traces/accept.py`). The seed decides the
faults. The exit code is 1 if this fails.

Two of the workers are on the learner's host, and no fault happens to them. In their environment, as in all, some calls take
longer than the worker timeout. They must never be given up for that.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from millrace.protocol.keys.key_folder import KeyFolder
from tests.model.traces.accept import accept
from tests.model.traces.replay import NotAccepted
from tests.system.random_faults.soak_faults import FAULTS, KILL_A_WORKER, PORT, Fault, Scene
from tests.system.stage.network import Network, why_not
from tests.system.stage.processes import START_S, Learner, Running, Stage, Worker, wait_for
from tests.system.stage.runs import accounted

PROXY_PORT = 5556
WORKERS, CALM_WORKERS = 6, 2
FAULT_EVERY_S, HEALED_WITHIN_S = 2.0, (0.5, 4.0)
EPISODES = 40  # of an evaluation
MORE_STEPS = 20_000  # env steps of the run's last part, without faults
SLOW = "tests.system.environments.slow_envs:SometimesSlow-v0"
SLOW_RESET_EVERY, SLOW_STEP_EVERY = 5, 1_000  # calls of a process, for each minute of the soak: so a soak has some dozens
SETTINGS: dict[str, object] = {
    "env-kwargs": "",
    "rollout-steps": 32,
    "batch-size": 256,
    "n-epochs": 20,
    "gamma": 0.98,
    "gae-lambda": 0.8,
    "eval-episodes": EPISODES,
    "checkpoint-every-s": 2,
    "max-env-failures": 10_000,  # a hostile worker that gets a lane may say that its environment failed
}
LOOK_EVERY_S = 1.0  # at memory and open files
SETTLED_S = 15.0  # before the second half the learner is killed no more, so that its memory is that of a warm process
MOST_MB, MOST_MB_PER_MIN = 4.0, 1.0  # growth of a process in the second half: at most this, and so much more a minute
JUDGED_MINUTES = 2.0  # a shorter time shows how a process begins, not whether it grows
ENOUGH_STEPS = 100_000  # env steps after which these settings solve CartPole; on a full machine a soak makes fewer
MOST_MORE_FILES = 5
MOST_LOG_BYTES = 1_500_000  # of one learner process
GONE_WITHIN_S = 10.0


class Samples:
    """Memory and open files of one process, over time."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, float, int]] = []  # seconds, MB, open files

    def look(self, running: Running, now: float) -> None:
        """Take a sample, unless the process has just ended."""
        with suppress(psutil.Error):
            self._rows.append((now, running.memory_mb(), running.descriptors()))

    def growth(self) -> tuple[float, float, float]:
        """MB a minute (slope of a straight line), minutes, and open files (median of the last half minus the first's)."""
        rows = np.array(self._rows)
        minutes = rows[:, 0] / 60
        half = len(rows) // 2
        files = float(np.median(rows[half:, 2]) - np.median(rows[:half, 2]))
        return float(np.polyfit(minutes, rows[:, 1], 1)[0]), float(np.ptp(minutes)), files


class Soak:
    """The course of a soak, and what was seen on the way."""

    def __init__(self, stage: Stage, network: Network, seed: int, eval_every: int, minutes: float) -> None:
        self.seconds = 60 * minutes
        self._eval_every = eval_every
        hosts = [network.host(number) for number in (1, 2, 3)]
        here = hosts[0]
        self.address = f"tcp://{here.address}:{PORT}"
        self.stage, self.notes = stage, stage.tmp_path / "slow-calls"
        self.notes.touch()
        keys, self._token = stage.keys()
        hostile_token = KeyFolder(keys).new("mallory", datetime.now(UTC).replace(microsecond=0))
        often = f"reset {round(SLOW_RESET_EVERY * minutes)} step {round(SLOW_STEP_EVERY * minutes)}"
        settings = {**SETTINGS, "env-kwargs": f"notes {self.notes} {often}", "seed": seed, "eval-every": eval_every}
        learner = stage.learner(
            self.address, {**settings, "min-workers": WORKERS, "keys": keys}, env=SLOW, before=here.before
        )
        proxy = [*here.before, sys.executable, "-m", "tests.system.stage.proxy", str(PORT), here.address, str(PROXY_PORT)]
        self.calm = [stage.worker(self.address, f"calm{n}", *self._flags, before=here.before) for n in range(CALM_WORKERS)]
        self.scene = Scene(
            stage=stage,
            hosts=hosts,
            random=random.Random(seed),
            learner=learner,
            resume=self._resume,
            proxy=stage.start(proxy, "proxy", told=True),
            workers={},
            hostile_token=hostile_token,
        )
        self.learners = [learner]
        self.scene.workers |= {number: self._worker(number) for number in range(WORKERS)}
        self.faults: Counter[str] = Counter()
        self.in_evaluations: Counter[str] = Counter()
        self.own_ends: list[str] = []
        self._calm_pids: list[int] = []
        self.longest_pause: tuple[float, str] = (0.0, "")
        self.samples: dict[str, Samples] = {}  # of the second half
        self._made: list[tuple[float, str]] = []
        self._evaluation = ""  # the checkpoint before the evaluation that is under way, or the newest one
        self._rows_bytes, self._row_s, self._looked_s = 0, 0.0, 0.0
        self._due: list[tuple[float, Callable[[], None]]] = []

    @property
    def _flags(self) -> tuple[str, str]:
        return "--token", str(self._token)

    def _worker(self, number: int) -> Worker:
        host = self.scene.hosts[1 + number % 2]
        port = PORT if number % 2 == 0 else PROXY_PORT
        address = f"tcp://{self.scene.hosts[0].address}:{port}"
        return self.stage.worker(address, f"w{number}", *self._flags, before=host.before)

    def _resume(self, settings: Mapping[str, object] = {}) -> Learner:
        run, here = self.scene.learner.folder, self.scene.hosts[0]
        self.learners.append(self.stage.learner(self.address, settings, resume=run, before=here.before))
        return self.learners[-1]

    # ---------------------------------------------------------------- the course of things

    def play(self) -> None:
        """Make faults for `seconds` after the first update, then undo them all."""
        scene = self.scene
        coming = scene.random.sample(FAULTS, len(FAULTS))  # each fault once, then at random
        scene.learner.trains(1)
        self._calm_pids = [psutil.Process(worker.pid).children()[0].pid for worker in self.calm]
        began_s = time.monotonic()
        half_s, end_s, next_s = began_s + self.seconds / 2, began_s + self.seconds, began_s + FAULT_EVERY_S
        while (now := time.monotonic()) < end_s:
            assert scene.learner.alive(), f"the learner ended:\n{scene.learner.said()[-3000:]}"
            may_kill_it = now < min(half_s - SETTLED_S, began_s + 0.4 * self.seconds)
            if self._an_evaluation_began():
                self._make(KILL_A_WORKER, now)
            elif now >= next_s:
                next_s = now + FAULT_EVERY_S
                possible = [fault for fault in FAULTS if fault.at_any_time or may_kill_it]
                fault = coming.pop() if coming else scene.random.choices(possible, [one.weight for one in possible])[0]
                if fault in possible:
                    self._make(fault, now)
            for due in [due for due in self._due if due[0] <= now]:
                self._due.remove(due)
                due[1]()
            self._look(now, judged=now >= half_s)
            time.sleep(0.1)
        for _, undo in self._due:
            undo()

    def end(self) -> None:
        """Without faults: kill the learner, resume the run for a little longer with all workers, and let it end."""
        learner = self.scene.learner
        learner.kill()
        self._restart_workers()
        steps = int(learner.checkpoints()[-1].stem) + MORE_STEPS
        everybody = {"min-workers": WORKERS + CALM_WORKERS, "no-workers-timeout-s": START_S}
        self.scene.learner = self._resume({"steps": steps, **everybody})
        code = self.scene.learner.ends(START_S + 120)
        assert code == 0, f"the last learner ended with {code}: {self.scene.learner.said()[-3000:]}"

    def _an_evaluation_began(self) -> bool:
        """Whether an evaluation is under way that was not seen before."""
        checkpoints = self.scene.learner.checkpoints()
        if not checkpoints or checkpoints[-1].name == self._evaluation or not self._evaluates(checkpoints[-1]):
            return False
        self._evaluation = checkpoints[-1].name
        return True

    def _evaluates(self, newest: Path) -> bool:
        """Whether an evaluation is due after the newest row, its checkpoint is written, and its result is not."""
        with (self.scene.learner.folder / "metrics.jsonl").open("rb") as file:
            file.seek(max(0, file.seek(0, 2) - 20_000))
            lines = file.read().splitlines(keepends=True)[1:]
        rows = [json.loads(line) for line in lines if line.endswith(b"\n")]
        if not rows or int(rows[-1]["time/total_timesteps"]) != int(newest.stem) or "eval/mean_reward" in rows[-1]:
            return False
        earlier = [steps for row in rows if (steps := int(row["time/total_timesteps"])) < int(newest.stem)]
        return bool(earlier) and int(newest.stem) // self._eval_every > earlier[-1] // self._eval_every

    def _make(self, fault: Fault, now: float) -> None:
        self.faults[fault.name] += 1
        self._made.append((now, fault.name))
        if (checkpoints := self.scene.learner.checkpoints()) and self._evaluates(checkpoints[-1]):
            self.in_evaluations[fault.name] += 1
        undo = fault.do(self.scene)
        if undo is not None:
            self._due.append((time.monotonic() + self.scene.random.uniform(*HEALED_WITHIN_S), undo))

    def _look(self, now: float, *, judged: bool) -> None:
        """Restart workers that were killed, record those that ended by themselves, and take samples."""
        self._look_at_updates(now)
        self._restart_workers()
        if not judged or now - self._looked_s < LOOK_EVERY_S:
            return
        self._looked_s = now
        for name, running in {"learner": self.scene.learner, **{f"calm{n}": one for n, one in enumerate(self.calm)}}.items():
            self.samples.setdefault(name, Samples()).look(running, now)

    def _restart_workers(self) -> None:
        for number, worker in self.scene.workers.items():
            if worker.alive():
                continue
            if worker.pid not in self.scene.killed:
                self.own_ends.append(f"w{number}: exit code {worker.process.returncode}: {worker.said()[-300:]}")
            self.scene.workers[number] = self._worker(number)

    def _look_at_updates(self, now: float) -> None:
        """Record the longest time without an update, and the faults shortly before and during it."""
        rows_bytes = (self.scene.learner.folder / "metrics.jsonl").stat().st_size
        if rows_bytes == self._rows_bytes:
            return
        pause_s = now - self._row_s if self._row_s else 0.0
        if pause_s > self.longest_pause[0]:
            since = self._row_s - HEALED_WITHIN_S[1]
            causes = [f"{at - self._row_s:+.1f} s {name}" for at, name in self._made if at >= since]
            self.longest_pause = pause_s, ", ".join(causes)
        self._rows_bytes, self._row_s = rows_bytes, now

    # ---------------------------------------------------------------- what must hold: each returns what falls short

    def everybody_left(self) -> list[str]:
        """The workers ended by themselves, with exit code 0, and no process of theirs is left on any host."""
        short = list(self.own_ends)
        workers = [*self.scene.workers.values(), *self.calm]
        failed = [worker for worker in workers if worker.ends(START_S) != 0]
        short += [f"{one.said_in.name}: exit code {one.process.returncode}: {one.said()[-300:]}" for one in failed]
        for other in [*self.scene.strangers, *self.scene.hostile]:
            if other.alive():
                other.kill()
        self.scene.proxy.kill()
        hosts = self.scene.hosts
        with suppress(AssertionError):
            wait_for(lambda: not any(host.processes() for host in hosts), GONE_WITHIN_S)
        left = [psutil.Process(pid).cmdline() for host in hosts for pid in host.processes()]
        return short + [f"left behind: {' '.join(command)}" for command in left]

    def nobody_calm_was_given_up(self) -> list[str]:
        """Slow is not dead: a learner never loses a worker to which nothing happened, and that made slow calls."""
        short = []
        for n in range(CALM_WORKERS):
            for learner in self.learners:
                said = learner.said()
                if f"worker calm{n} silent" in said or len(re.findall(rf"worker calm{n} \(.*joined", said)) > 1:
                    lines = [line for line in said.splitlines() if f"calm{n}" in line]
                    short.append(f"calm{n} was given up: {lines}")
            if not self.slow_calls(n):
                short.append(f"calm{n} made no slow call")
        missing = {"construct", "reset", "step"} - self.slow_calls().keys()
        return short + [f"no {call} was slow" for call in sorted(missing)]

    def slow_calls(self, calm: int | None = None) -> Counter[str]:
        """How many calls were slow, by kind; of one calm worker, or of all processes."""
        lines = [line.split() for line in self.notes.read_text().splitlines()]
        return Counter(call for pid, call in lines if calm is None or int(pid) == self._calm_pids[calm])

    def flat(self) -> list[str]:
        """In the second half neither memory nor the number of open files grows."""
        short = []
        for name, samples in self.samples.items():
            slope, minutes, files = samples.growth()
            most = MOST_MB + MOST_MB_PER_MIN * minutes
            if minutes >= JUDGED_MINUTES and slope * minutes > most:
                short.append(
                    f"{name} grew by {slope * minutes:.1f} MB in {minutes:.1f} minutes, at most {most:.1f} expected"
                )
            if files > MOST_MORE_FILES:
                short.append(f"{name} opened {files:.0f} more files and sockets, at most {MOST_MORE_FILES} expected")
        return short

    def little_said(self) -> list[str]:
        """No learner process logs much, and nobody of ours a traceback or an error of the program."""
        long = [one for one in self.learners if len(one.said()) > MOST_LOG_BYTES]
        short = [f"{one.said_in.name}: {len(one.said()):,} bytes logged, expected {MOST_LOG_BYTES:,}" for one in long]
        ours = [one for one in self.stage.started if one not in self.scene.strangers and one not in self.scene.hostile]
        words = ("Traceback", "internal error", "led to an error in the learner")
        said = [(one, word) for one in ours for word in words if word in one.said()]
        return short + [f"{one.said_in.name} says {word}: {one.said()[-3000:]}" for one, word in said]


def missing_evaluations(rows: Sequence[Mapping[str, Any]], every: int) -> list[str]:
    """Which evaluations are missing, and which were not due. Several rows may be of the same number of env steps."""
    found: dict[int, bool] = {}
    for row in rows:
        steps = int(row["time/total_timesteps"])
        found[steps] = found.get(steps, False) or "eval/mean_reward" in row
    due, short = every, []
    for steps, evaluated in found.items():
        if evaluated != (steps >= due):
            short.append(f"after {steps:,} env steps: {'an evaluation was not due' if evaluated else 'no evaluation'}")
        due += every * (steps >= due)
    return short


def without_faults(stage: Stage, steps: int, seed: int, eval_every: int) -> dict[str, Any]:
    """The summary of as long a run on loopback, without faults and slow calls."""
    settings = {**SETTINGS, "steps": steps, "seed": seed, "min-workers": 2, "eval-every": eval_every}
    learner = stage.learner("tcp://127.0.0.1:5557", settings, env="CartPole-v1")
    workers = [stage.worker("tcp://127.0.0.1:5557", f"w{number}") for number in range(2)]
    assert learner.ends(START_S + steps / 100) == 0, learner.said()
    for worker in workers:
        assert worker.ends() == 0, worker.said()
    return learner.summary()


def soak(minutes: float, seed: int, folder: Path, eval_every: int = 25_000) -> list[str]:
    """Run it and print the table. Returns the requirements that were not met."""
    print(f"soak: seed {seed}, {minutes:g} minutes of faults", flush=True)
    traces = folder / "traces"
    stage = Stage(folder, traces)
    with Network() as network:
        try:
            course = Soak(stage, network, seed, eval_every, minutes)
            course.play()
            course.end()
            short = course.everybody_left()
        finally:
            stage.close()
    learner = course.scene.learner
    summary = learner.summary()
    ledger = accounted(summary, rows=32 * 2)
    for check in (course.nobody_calm_was_given_up, course.flat, course.little_said):
        short += check()
    short += missing_evaluations(learner.rows(), eval_every)
    if not course.in_evaluations["kill a worker"]:
        short.append("no worker was killed in an evaluation")
    accepted = "not accepted"
    try:
        accepted = str(accept(traces))
    except NotAccepted as error:
        short.append(f"traces: {error}")
    if summary["stop_reason"] != "all steps done":
        short.append(f"stop reason: {summary['stop_reason']}")
    calm_stage = Stage(folder / "calm")
    try:
        calm = without_faults(calm_stage, summary["env_steps"], seed, eval_every)
    finally:
        calm_stage.close()
    found, wanted = (run["best"]["evaluation"] for run in (summary, calm))
    noise = 2 * (found["return_std"] ** 2 / EPISODES + wanted["return_std"] ** 2 / EPISODES) ** 0.5
    if summary["env_steps"] >= ENOUGH_STEPS and found["return_mean"] < wanted["return_mean"] - noise - 25:
        short.append(f"best greedy return {found['return_mean']:.1f}, without faults {wanted['return_mean']:.1f}")
    rows = {
        **{f"fault: {name}": count for name, count in sorted(course.faults.items())},
        **{f"in an evaluation: {name}": count for name, count in sorted(course.in_evaluations.items())},
        **{f"slow calls: {name}": count for name, count in sorted(course.slow_calls().items())},
        "learner processes": len(course.learners),
        "messages of hostile workers": sum(_said(running) for running in course.scene.hostile),
        "updates, env steps": f"{summary['updates']:,}, {summary['env_steps']:,}",
        "evaluations": sum("eval/mean_reward" in row for row in learner.rows()),
        "longest pause between updates": f"{course.longest_pause[0]:.1f} s",
        "best greedy return": f"{found['return_mean']:.1f} ± {found['return_std']:.1f}",
        "best greedy return without faults": f"{wanted['return_mean']:.1f} ± {wanted['return_std']:.1f}",
        **{f"ledger: {name}": f"{count:,}" for name, count in ledger.items()},
        **{
            f"memory of {name}": "{:+.2f} MB a minute for {:.1f} minutes".format(*one.growth())
            for name, one in course.samples.items()
        },
        **{f"open files of {name}": f"{one.growth()[2]:+.0f}" for name, one in course.samples.items()},
        "largest log of a learner process": f"{max(len(one.said()) for one in course.learners):,} bytes",
        "workers that ended by themselves": len(course.own_ends),
    }
    for name, value in rows.items():
        print(f"  {name:36} {value:>20}")
    print(f"  in the longest pause: {course.longest_pause[1]}")
    print(f"  traces: {sum(path.stat().st_size for path in traces.iterdir()) / 1e6:.1f} MB; {accepted}")
    (folder / "soak.json").write_text(json.dumps(rows, indent=2))
    return short


def _said(hostile: Running) -> int:
    """How many messages a hostile worker said; 0 if it was ended before it could tell."""
    found = re.search(r"said (\d+) messages", hostile.said())
    return int(found[1]) if found else 0


def main() -> int:
    """Run the program. Returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.system.random_faults.soak", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("--minutes", type=float, default=10.0, help="of faults, after the first update")
    parser.add_argument("--eval-every", type=int, default=25_000, help="env steps between evaluations")
    parser.add_argument("--seed", type=int, default=random.SystemRandom().getrandbits(31), help="default: any, printed")
    options = parser.parse_args()
    if why := why_not():
        print(f"soak: {why}", file=sys.stderr)
        return 2
    folder = Path(tempfile.mkdtemp(prefix="soak-"))
    print(f"soak: what everybody says lies in {folder}; it is removed if all holds", flush=True)
    short = soak(options.minutes, options.seed, folder, options.eval_every)
    if not short:
        shutil.rmtree(folder)
    for line in short:
        print(f"falls short: {line}", file=sys.stderr)
    print(f"soak: {'falls short' if short else 'all held'}; again with --minutes {options.minutes:g} --seed {options.seed}")
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())
