"""Compares training on a slow environment: `python -m benchmarks.slow`, or `millrace bench slow`.

PPO with 64 steps, minibatches of 256 and 10 epochs, on 16 env copies in 16 processes. The environment sleeps
(`benchmarks/slow_env.py`), so that the number of cores does not matter and waiting is all that is measured. The ideal is 16
copies that never wait: 16 processes that step and do nothing else. They reach less than the durations say, because a machine
wakes a process a little late. Each run is a process tree of its own; all take turns. Two more rows are loops over
`millrace.make_vec` that act at random and learn nothing: by `step`, and by `send` and `recv`. `--only-loops` measures these
and the ideal. `--peers` adds the installed systems that can run 16 processes. `--picture FILE` draws who waits for whom.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
import sys
import tempfile
import time
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import millrace
from benchmarks import programs
from benchmarks.programs import CONTENDERS, Contender, contenders
from benchmarks.slow_env import STEPS_PER_S, TIMELINE, Lognormal
from benchmarks.writing import COLORS, DPI, GREY, write

COPIES = 16
IDEAL = COPIES * STEPS_PER_S  # if a machine woke every process in time
NEVER_WAIT, NEVER_WAIT_S = "copies that never wait", 12.0
WARM_UP = 3  # updates
LOOPS_WARM_UP_S = 2.0
BY_STEP, BY_RECV = "make_vec, step", "make_vec, send and recv"
SETTINGS: dict[str, Any] = {
    "env": "benchmarks.slow_env:Lognormal-v0", "algo": "ppo", "envs": COPIES, "rollout_steps": 64, "batch_size": 256,
    "n_epochs": 10, "gamma": 0.99, "gae_lambda": 0.95, "ent_coef": 0.0, "vf_coef": 0.5, "max_grad_norm": 0.5,
    "learning_rate": 3e-4, "learning_rate_schedule": "constant", "clip_range": 0.2, "clip_range_schedule": "constant",
    "eval_every": 0, "eval_episodes": 1, "processes": COPIES, "normalize_observations": False, "normalize_rewards": False,
}  # fmt: skip
UPDATES, UPDATES_OF_PEERS = 24, 8
SUBPROC = "SB3, SubprocVecEnv"
OURS = {
    f"millrace, --max-lag {lag}": Contender(
        "millrace", flags=(*f"--workers {COPIES} --lanes {COPIES} --max-lag {lag}".split(),)
    )
    for lag in (0, 1, 2)
}
OURS |= {
    f"{name}, ResetAhead": each._replace(flags=(*each.flags, "--wrapper", "millrace:ResetAhead"))
    for name, each in list(OURS.items())[:2]
}
PEERS = ("TorchRL, 2 workers", "RLlib, 2 runners", "Sample Factory, 2 workers")
"""Systems that can run 16 processes; their programs take the number from the settings."""


def rate(name: str, contender: Contender, seed: int) -> float:
    """Env steps/s after the warm-up. Raises `RuntimeError`."""
    updates = UPDATES if contender.ours else UPDATES_OF_PEERS
    settings = SETTINGS | {"steps": updates * COPIES * SETTINGS["rollout_steps"], "seed": seed}
    if contender.ours:
        del settings["processes"]
    return programs.run(name, settings, contender=contender).steps_per_s(after_updates=WARM_UP)


def rate_without_waiting(seed: int) -> float:
    """Env steps/s of copies in processes that only step and reset."""
    context = multiprocessing.get_context("spawn")
    begin, counts = context.Barrier(COPIES), context.Queue()
    loops = [context.Process(target=_step_only, args=(COPIES * seed + n, begin, counts), daemon=True) for n in range(COPIES)]
    for loop in loops:
        loop.start()
    steps: int = sum(counts.get(timeout=60 + NEVER_WAIT_S) for _ in loops)
    for loop in loops:
        loop.join()
    return steps / NEVER_WAIT_S


def _step_only(seed: int, begin: Barrier, counts: multiprocessing.Queue[int]) -> None:
    env = Lognormal()
    env.reset(seed=seed)
    steps = 0
    begin.wait(60)
    end_s = time.monotonic() + NEVER_WAIT_S
    while time.monotonic() < end_s:
        over = env.step(0)[2]
        steps += 1
        if over:
            env.reset()
    counts.put(steps)


def rate_of_loop(seed: int, *, by_recv: bool) -> float:
    """Env steps/s of a loop over a vector environment that acts at random; each copy has a worker of its own.

    With SameStep every row of a step is an env step, whether it also resets or not.
    """
    env_id = f"{Lognormal.__module__}:Lognormal-v0"
    actions = np.random.default_rng(seed)
    with millrace.make_vec(env_id, COPIES, workers=COPIES, lanes=COPIES, autoreset_mode="SameStep") as env:
        env.reset(seed=COPIES * seed)
        ids, steps = np.arange(COPIES), 0
        if by_recv:
            env.send(actions.integers(0, 2, COPIES))
        began_s = time.monotonic() + LOOPS_WARM_UP_S
        while (now := time.monotonic()) < began_s + NEVER_WAIT_S:
            if by_recv:
                ids = env.recv()[4]["env_id"]
                env.send(actions.integers(0, 2, len(ids)), ids)
            else:
                env.step(actions.integers(0, 2, COPIES))
            steps += len(ids) * (now >= began_s)
        return steps / (time.monotonic() - began_s)


def timelines(name: str, contender: Contender, seed: int) -> list[np.ndarray[Any, Any]]:
    """For each env copy, its calls [calls, 3]: start, end, whether it was a reset."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ[TIMELINE] = folder
        try:
            rate(name, contender, seed)
        finally:
            del os.environ[TIMELINE]
        found = [np.fromfile(path).reshape(-1, 3) for path in Path(folder).iterdir() if path.stat().st_size]
    return sorted(found, key=len)[-COPIES:]  # an evaluation has copies of its own, with fewer calls


def draw(found: dict[str, list[np.ndarray[Any, Any]]], out: Path, seconds: float = 1.5) -> None:
    """A row for each env copy: steps and resets; white is waiting."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    figure = Figure(figsize=(10.0, 1.9 * len(found)), layout=ConstrainedLayoutEngine())
    panels = figure.subplots(len(found), 1, sharex=True, squeeze=False)[:, 0]
    for panel, (title, copies) in zip(panels, found.items(), strict=True):
        last_s = min(calls[-1, 1] for calls in copies)
        began_s = last_s - seconds - 0.5
        busy = 0.0
        for row, calls in enumerate(copies):
            shown = calls[(calls[:, 1] > began_s) & (calls[:, 0] < began_s + seconds)]
            spans = np.clip(shown[:, :2], began_s, began_s + seconds) - began_s
            busy += float((spans[:, 1] - spans[:, 0]).sum())
            for is_reset, color in ((0, COLORS[0]), (1, "#e0a030")):
                chosen = spans[shown[:, 2] == is_reset]
                panel.broken_barh(
                    [(start, end - start) for start, end in chosen], (row + 0.1, 0.8), color=color, linewidth=0
                )
        share = busy / (seconds * len(copies))
        panel.set_title(f"{title}: {share:.0%} of the time in the environment", fontsize=9, fontweight="bold", loc="left")
        panel.set_xlim(0, seconds)
        panel.set_ylim(0, len(copies))
        panel.set_yticks([])
        panel.set_ylabel(f"{len(copies)} copies", fontsize=8, color=GREY)
        panel.tick_params(labelsize=8, colors=GREY, length=2)
        for side in ("top", "right", "left"):
            panel.spines[side].set_visible(False)
    panels[-1].set_xlabel("seconds; blue: a step, orange: a reset, white: the copy waits", fontsize=8, color=GREY)
    figure.savefig(out, dpi=DPI)


def main() -> None:
    parser = argparse.ArgumentParser(description="compare training on a slow environment with Stable-Baselines3")
    parser.add_argument("--rounds", type=int, default=3, help="number of turns, each with another seed")
    parser.add_argument("--peers", action="store_true", help="compare with all installed systems that run 16 processes")
    parser.add_argument("--picture", type=Path, help="draw who waits for whom into this PNG, and measure nothing else")
    parser.add_argument("--only-loops", action="store_true", help="measure the two loops and the ideal only")
    arguments = parser.parse_args()
    here = contenders(arguments.peers)
    others = {name: CONTENDERS[name] for name in (SUBPROC, *(PEERS if arguments.peers else ())) if name in here}
    if arguments.picture is not None:
        chosen = {name: each for name, each in (others | OURS).items() if name in (SUBPROC, *list(OURS)[:2])}
        draw({name: timelines(name, each, 1) for name, each in chosen.items()}, arguments.picture)
        print(arguments.picture)
        return
    trained = {} if arguments.only_loops else others | OURS
    found: dict[str, list[float]] = {name: [] for name in (*trained, BY_STEP, BY_RECV, NEVER_WAIT)}
    for turn in range(arguments.rounds):
        found[NEVER_WAIT].append(rate_without_waiting(turn + 1))
        for name in (BY_STEP, BY_RECV):
            found[name].append(rate_of_loop(turn + 1, by_recv=name == BY_RECV))
        for name, each in trained.items():
            try:
                found[name].append(rate(name, each, turn + 1))
            except RuntimeError as error:
                print(f"left out: {error}", file=sys.stderr)
    medians = {name: statistics.median(rates) for name, rates in found.items() if rates}
    slowest, never_waiting = medians.get(SUBPROC), medians[NEVER_WAIT]
    table = Table(title=f"slow environment, {COPIES} copies, medians of {arguments.rounds} (least to most)")
    for column in ("", "env steps/s", "of copies that never wait", f"× {SUBPROC}"):
        table.add_column(column, justify="left" if not column else "right")
    for name, median in medians.items():
        measured = f"{median:,.0f} ({min(found[name]):,.0f} to {max(found[name]):,.0f})"
        table.add_row(name, measured, f"{median / never_waiting:.2f}", "–" if slowest is None else f"{median / slowest:.1f}")
    Console(width=110).print(table)
    print(f"copies that never wait, if the machine woke them in time: {IDEAL:,.0f} env steps/s")
    title = "env steps/s, 16 copies; a step takes 5 ms, a reset 200 ms"
    write("slow", {"ideal": IDEAL, "median": medians, "of": found}, [(title, medians)])


if __name__ == "__main__":
    main()
