"""`python -m tests.system.soak`: eight workers on two hosts learn CartPole, with a fault every two seconds.

Rule: in spite of the faults, training ends, the policy is as good as without faults, every ticket and transition is
accounted for, and nothing is left behind. The seed decides the faults and their times. The exit code is 1 if this fails.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.system.network import Network, why_not
from tests.system.processes import START_S, Learner, Running, Stage, wait_for
from tests.system.rubbish import NAME
from tests.system.runs import accounted

PORT, PROXY_PORT = 5555, 5556
WORKERS = 8
FAULT_EVERY_S, HEALED_WITHIN_S = 2.0, (0.5, 4.0)
STEPS_FIRST_MINUTE, STEPS_PER_MINUTE = 150_000, 270_000  # env steps that are trained with these faults on two cores, about
SETTINGS: dict[str, object] = {
    "env-kwargs": "",
    "rollout-steps": 32,
    "batch-size": 256,
    "n-epochs": 20,
    "eval-episodes": 100,
    "checkpoint-every-s": 2,
}
WARM_S = 10.0  # seconds after a learner's start in which its memory still grows
LIFE_S = 30.0  # the shortest time that shows a slope
MOST_MB_PER_MIN = 6.0
MOST_MORE_DESCRIPTORS = 40
Undo = Callable[[], None]


class Soak:
    """A learner on the first host, and workers on the other two, one of which is behind a proxy; and the faults."""

    def __init__(self, stage: Stage, network: Network, steps: int, seed: int) -> None:
        self.stage, self.random = stage, random.Random(seed)
        self.hosts = [network.host(number) for number in (1, 2, 3)]
        here = self.hosts[0]
        self.address = f"tcp://{here.address}:{PORT}"
        keys, self._token = stage.keys()
        settings = {**SETTINGS, "steps": steps, "seed": seed, "min-workers": WORKERS, "keys": keys}
        self.learner = stage.learner(self.address, settings, env="CartPole-v1", before=here.before)
        proxy = [*here.before, sys.executable, "-m", "tests.system.proxy", str(PORT), here.address, str(PROXY_PORT)]
        self.proxy = stage.start(proxy, "proxy", told=True)
        self.workers = {number: self._worker(number) for number in range(WORKERS)}
        self.stopped: set[int] = set()
        self.bad_ways: set[int] = set()
        self.faults: Counter[str] = Counter()
        self.strangers: list[Running] = []
        self.own_ends: list[str] = []
        self.memory: list[tuple[int, float, float]] = []  # pid of the learner, seconds, MB
        self.descriptors: dict[int, list[int]] = {}
        self.killed: set[int] = set()
        self.longest_pause: tuple[float, str] = (0.0, "")
        self._made: list[tuple[float, str]] = []
        self._rows_bytes, self._row_s = 0, 0.0
        self._due: list[tuple[float, Undo]] = []

    def _worker(self, number: int) -> Running:
        host = self.hosts[1 + number % 2]
        port = PORT if number % 2 == 0 else PROXY_PORT
        address = f"tcp://{self.hosts[0].address}:{port}"
        return self.stage.worker(address, f"w{number}", "--token", str(self._token), before=host.before)

    # ---------------------------------------------------------------- what goes wrong

    def kill_a_worker(self) -> None:
        number = self.random.choice(sorted(self.workers.keys() - self.stopped))
        self.killed.add(self.workers[number].pid)
        self.workers[number].kill()

    def stop_a_worker(self) -> Undo | None:
        number = self.random.choice(sorted(self.workers.keys() - self.stopped))
        worker = self.workers[number]
        if not worker.alive():
            return None
        self.stopped.add(number)
        worker.pause()

        def go_on() -> None:
            self.stopped.discard(number)
            worker.go_on()

        return go_on

    def cut_a_host(self) -> Undo | None:
        return self._way(lambda host: self.hosts[host].cut(), lambda host: self.hosts[host].heal())

    def lose_a_tenth(self) -> Undo | None:
        return self._way(lambda host: self.hosts[host].lose(10), lambda host: self.hosts[host].lose(0))

    def _way(self, spoil: Callable[[int], None], mend: Callable[[int], None]) -> Undo | None:
        host = self.random.choice([1, 2])
        if host in self.bad_ways:
            return None
        self.bad_ways.add(host)
        spoil(host)

        def heal() -> None:
            self.bad_ways.discard(host)
            mend(host)

        return heal

    def delay(self) -> Undo:
        self.proxy.tell("delay 0.2")
        return lambda: self.proxy.tell("delay 0")

    def reset_connections(self) -> None:
        self.proxy.tell("reset")

    def talk_rubbish(self) -> None:
        host = self.hosts[self.random.choice([1, 2])]
        arguments = (self.hosts[0].address, str(PORT), str(self.random.getrandbits(32)))
        self.strangers.append(
            self.stage.start([*host.before, sys.executable, "-m", "tests.system.rubbish", *arguments], NAME.decode())
        )

    def kill_the_learner(self) -> None:
        self.learner.is_open()
        wait_for(self.learner.checkpoints, START_S, "a checkpoint")
        self.learner.kill()
        self.learner = self.stage.learner(self.address, resume=self.learner.folder, before=self.hosts[0].before)

    # ---------------------------------------------------------------- the course of things

    def play(self, deadline_s: float) -> None:
        """Inject faults until the learner ends."""
        draw: dict[Callable[[], Undo | None], int] = {
            self.kill_a_worker: 6,
            self.stop_a_worker: 6,
            self.cut_a_host: 3,
            self.lose_a_tenth: 3,
            self.delay: 3,
            self.reset_connections: 3,
            self.talk_rubbish: 2,
            self.kill_the_learner: 1,
        }
        coming = self.random.sample(list(draw), len(draw))  # each fault once, then at random
        self.learner.is_open()
        wait_for(self.learner.checkpoints, START_S, "the first checkpoint")
        next_s = time.monotonic() + FAULT_EVERY_S
        while self.learner.alive():
            now = time.monotonic()
            assert now < deadline_s, f"training did not end in time; the learner says:\n{self.learner.said()[-3000:]}"
            if now >= next_s:
                next_s = now + FAULT_EVERY_S
                self._make(coming.pop() if coming else self.random.choices(list(draw), list(draw.values()))[0])
            for due in [due for due in self._due if due[0] <= now]:
                self._due.remove(due)
                due[1]()
            self._look_after(now)
            time.sleep(0.1)
        for _, undo in self._due:
            undo()

    def _make(self, fault: Callable[[], Undo | None]) -> None:
        name = fault.__name__.replace("_", " ")
        self.faults[name] += 1
        self._made.append((time.monotonic(), name))
        undo = fault()
        if undo is not None:
            self._due.append((time.monotonic() + self.random.uniform(*HEALED_WITHIN_S), undo))

    def _look_after(self, now: float) -> None:
        """Restart workers that were killed, record those that ended by themselves, and measure memory and descriptors."""
        self._look_at_updates(now)
        for number, worker in self.workers.items():
            if not worker.alive() and self.learner.alive():
                if worker.pid not in self.killed and worker.process.returncode != 0:
                    self.own_ends.append(f"w{number}: exit code {worker.process.returncode}: {worker.said()[-300:]}")
                if worker.process.returncode != 0:
                    self.workers[number] = self._worker(number)
        for running in (self.learner, *self.workers.values()):
            try:
                descriptors, memory_mb = running.descriptors(), running.memory_mb()
            except Exception:  # the process has just ended
                continue
            self.descriptors.setdefault(running.pid, []).append(descriptors)
            if running is self.learner:
                self.memory.append((running.pid, now, memory_mb))

    def _look_at_updates(self, now: float) -> None:
        """Record the longest time without an update, and the faults shortly before and during it."""
        rows_bytes = (self.learner.folder / "metrics.jsonl").stat().st_size
        if rows_bytes == self._rows_bytes:
            return
        pause_s = now - self._row_s if self._row_s else 0.0
        if pause_s > self.longest_pause[0]:
            since = self._row_s - HEALED_WITHIN_S[1]
            causes = [f"{at - self._row_s:+.1f} s {name}" for at, name in self._made if at >= since]
            self.longest_pause = pause_s, ", ".join(causes)
        self._rows_bytes, self._row_s = rows_bytes, now

    # ---------------------------------------------------------------- the account

    def slope_mb_per_min(self) -> float:
        """Growth of the learner's memory, without the first seconds of each process: a mean, weighted by their length."""
        slopes, weights = [], []
        for pid in {pid for pid, _, _ in self.memory}:
            points = np.array([(s, mb) for found, s, mb in self.memory if found == pid])
            points = points[points[:, 0] > points[0, 0] + WARM_S]
            if len(points) and np.ptp(points[:, 0]) > LIFE_S:
                slopes.append(float(np.polyfit(points[:, 0] / 60, points[:, 1], 1)[0]))
                weights.append(len(points))
        return float(np.average(slopes, weights=weights)) if slopes else 0.0

    def more_descriptors(self) -> int:
        """The largest growth of the number of open files and sockets of a process after its first seconds."""
        return max((max(seen[20:]) - seen[20] for seen in self.descriptors.values() if len(seen) > 40), default=0)


def without_faults(stage: Stage, steps: int, seed: int) -> Learner:
    """The same run on loopback, without faults."""
    settings = {**SETTINGS, "steps": steps, "seed": seed, "min-workers": 2}
    learner = stage.learner("tcp://127.0.0.1:5557", settings, env="CartPole-v1")
    workers = [stage.worker("tcp://127.0.0.1:5557", f"w{number}") for number in range(2)]
    assert learner.ends(START_S + steps / 100) == 0, learner.said()
    for worker in workers:
        assert worker.ends() == 0, worker.said()
    return learner


def soak(minutes: float, seed: int, folder: Path) -> list[str]:
    """Run it and print the table. Returns the requirements that were not met."""
    steps = STEPS_FIRST_MINUTE + int((minutes - 1) * STEPS_PER_MINUTE)
    print(f"soak: seed {seed}, {steps:,} env steps, about {minutes:g} minutes", flush=True)
    short: list[str] = []
    calm_stage = Stage(folder / "calm")
    try:
        calm = without_faults(calm_stage, steps, seed).summary()
    finally:
        calm_stage.close()
    stage = Stage(folder)
    with Network() as network:
        try:
            began_s = time.monotonic()
            scene = Soak(stage, network, steps, seed)
            scene.play(began_s + START_S + 180 * minutes)
            took_s = time.monotonic() - began_s
            learner = scene.learner
            if learner.ends() != 0:
                short.append(f"the learner ended with {learner.process.returncode}: {learner.said()[-3000:]}")
            time.sleep(2.0)
            # These were cut off, or just started, when the learner told the workers to leave.
            deaf = [worker for worker in scene.workers.values() if worker.alive()]
            for worker in deaf:
                worker.signal(signal.SIGTERM)
            for number, worker in scene.workers.items():
                if worker.ends() != 0 and worker.pid not in scene.killed:
                    short.append(f"w{number} ended with {worker.process.returncode}: {worker.said()[-300:]}")
            for stranger in scene.strangers:
                stranger.ends(60)
        finally:
            stage.close()
    summary = learner.summary()
    ledger = accounted(summary, rows=32 * 2)
    found, wanted = (run["evaluation"] for run in (summary, calm))
    if found is None:
        return [*short, f"no evaluation; stop reason: {summary['stop_reason']}"]
    noise = 2 * (found["return_std"] ** 2 / 100 + wanted["return_std"] ** 2 / 100) ** 0.5
    slope, more = scene.slope_mb_per_min(), scene.more_descriptors()
    if summary["stop_reason"] != "all steps done":
        short.append(f"stop reason: {summary['stop_reason']}")
    if found["return_mean"] < wanted["return_mean"] - noise - 25:
        short.append(f"greedy return {found['return_mean']:.1f}, without faults {wanted['return_mean']:.1f}")
    if slope > MOST_MB_PER_MIN:
        short.append(f"the learner grew by {slope:.1f} MB a minute, at most {MOST_MB_PER_MIN} expected")
    if more > MOST_MORE_DESCRIPTORS:
        short.append(f"a process opened {more} more files and sockets, at most {MOST_MORE_DESCRIPTORS} expected")
    if any("Traceback" in running.said() for running in stage.started if running not in scene.strangers):
        short.append("a traceback was said: " + next(r.said()[-3000:] for r in stage.started if "Traceback" in r.said()))
    short += scene.own_ends
    rows = {
        **{f"fault: {name}": count for name, count in sorted(scene.faults.items())},
        "seconds": f"{took_s:.0f}",
        "updates, env steps": f"{summary['updates']:,}, {summary['env_steps']:,}",
        "longest pause between updates": f"{scene.longest_pause[0]:.1f} s",
        "greedy return": f"{found['return_mean']:.1f} ± {found['return_std']:.1f}",
        "greedy return without faults": f"{wanted['return_mean']:.1f} ± {wanted['return_std']:.1f}",
        **{f"ledger: {name}": f"{count:,}" for name, count in ledger.items()},
        "learner's memory": f"{slope:+.2f} MB a minute",
        "more descriptors than when warm": more,
        "workers that did not hear the end": len(deaf),
        "workers that ended by themselves": len(scene.own_ends),
    }
    for name, value in rows.items():
        print(f"  {name:36} {value:>20}")
    print(f"  in the longest pause: {scene.longest_pause[1]}")
    (folder / "soak.json").write_text(json.dumps(rows, indent=2))
    return short


def main() -> int:
    """Run the program. Returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.system.soak", description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=random.SystemRandom().getrandbits(31), help="default: any, printed")
    options = parser.parse_args()
    if why := why_not():
        print(f"soak: {why}", file=sys.stderr)
        return 2
    folder = Path(tempfile.mkdtemp(prefix="soak-"))
    short = soak(options.minutes, options.seed, folder)
    if short:
        print(f"soak: what everybody said lies in {folder}", file=sys.stderr)
    else:
        shutil.rmtree(folder)
    for line in short:
        print(f"falls short: {line}", file=sys.stderr)
    print(f"soak: {'falls short' if short else 'all held'}; again with --minutes {options.minutes:g} --seed {options.seed}")
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())
