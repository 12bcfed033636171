"""Compares training on a slow environment: `python -m benchmarks.slow`, or `millrace bench slow`.

All run PPO with 64 steps, minibatches of 256 and 10 epochs, on 16 env copies in 16 processes. The environment sleeps
(`benchmarks/slow_env.py`), so that the number of cores doesn't matter and only waiting is measured. The ideal is 16 copies
that never wait: 16 processes that step and do nothing else. These processes are slower than the durations of steps and
resets suggest, because a machine wakes a process a little late. Each run is a process tree of its own; all take turns. Two
more rows are loops over `millrace.make_vec` that act at random and learn nothing: one with `step`, one with `send` and
`recv`. `--only-loops` measures these and the ideal. `--peers` adds the installed systems that can run 16 processes.
`--picture FILE` draws who waits for whom.
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
from xml.sax.saxutils import escape

import numpy as np
from rich.console import Console
from rich.table import Table

import millrace
from benchmarks import programs
from benchmarks.peers import install
from benchmarks.programs import CONTENDERS, Contender, contenders
from benchmarks.slow_env import STEPS_PER_S, TIMELINE, Lognormal
from benchmarks.writing import write

COPIES = 16
IDEAL = COPIES * STEPS_PER_S  # env steps/s if the machine woke every process in time
NEVER_WAIT = "copies that never wait"
NEVER_WAIT_S = 12.0
WARM_UP = 3  # number of updates that aren't counted
WIDTH = 640  # width of the picture; its letters are then large enough on a phone
ROW = 7  # height of an env copy's row in the picture
STYLE = (
    "text{fill:#2b3a42}.name{font-weight:600}.rows{fill:#8f9ba3;opacity:.16}.step{fill:#0072b2}.reset{fill:#e69f00}"
    "@media(prefers-color-scheme:dark){text{fill:#dde5ea}.step{fill:#4aa8e0}.reset{fill:#f0b440}}"
)
LOOPS_WARM_UP_S = 2.0
BY_STEP = "make_vec, step"
BY_RECV = "make_vec, send and recv"
SETTINGS: dict[str, Any] = {
    "env": "benchmarks.slow_env:Lognormal-v0", "algo": "ppo", "envs": COPIES, "rollout_steps": 64, "batch_size": 256,
    "n_epochs": 10, "gamma": 0.99, "gae_lambda": 0.95, "ent_coef": 0.0, "vf_coef": 0.5, "max_grad_norm": 0.5,
    "learning_rate": 3e-4, "learning_rate_schedule": "constant", "clip_range": 0.2, "clip_range_schedule": "constant",
    "eval_every": 0, "eval_episodes": 1, "processes": COPIES, "normalize_observations": False, "normalize_rewards": False,
}  # fmt: skip
UPDATES = 24
UPDATES_OF_PEERS = 8
SUBPROC = "SB3, SubprocVecEnv"
OURS = {
    f"millrace, --max-lag {lag}": Contender(
        "millrace", flags=(*f"--workers {COPIES} --lanes {COPIES} --max-lag {lag}".split(),)
    )
    for lag in (0, 1, 2)
}
OURS |= {
    f"{name}, ResetAhead": each._replace(flags=(*each.flags, "--wrappers", "millrace:ResetAhead"))
    for name, each in list(OURS.items())[:2]
}
PEERS = {
    "TorchRL, MultiSyncCollector": Contender("benchmarks.peers.torchrl_ppo", "sync", "torchrl"),
    "TorchRL, MultiAsyncCollector": Contender("benchmarks.peers.torchrl_ppo", "async", "torchrl"),
    "RLlib, 16 env runners": Contender("benchmarks.peers.rllib_ppo", "", "rllib"),
    "Sample Factory, async": Contender("benchmarks.peers.sample_factory_ppo", "async", "sample_factory"),
    "Tianshou, SubprocVectorEnv": Contender("benchmarks.peers.tianshou_ppo", "subproc", "tianshou"),
    "PufferLib, Multiprocessing": Contender("benchmarks.peers.pufferlib_ppo", "processes", "pufferlib"),
}
"""Systems that can run 16 processes, each in the way that its own documentation recommends for slow environments"""


def rate(name: str, contender: Contender, seed: int) -> float:
    """Env steps/s after the warm-up. Raises `RuntimeError` if the run fails."""
    updates = UPDATES if contender.ours else UPDATES_OF_PEERS
    settings = SETTINGS | {"steps": updates * COPIES * SETTINGS["rollout_steps"], "seed": seed}
    if contender.ours:
        del settings["processes"]
    return programs.run(name, settings, contender=contender).steps_per_s(after_updates=WARM_UP)


def rate_without_waiting(seed: int) -> float:
    """Env steps/s of env copies in processes that only step and reset."""
    context = multiprocessing.get_context("spawn")
    begin = context.Barrier(COPIES)
    counts = context.Queue()
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
    """Env steps/s of a loop over a vector environment with random actions, in which each copy has a worker of its own.

    The autoreset mode is SameStep, so that every row of a step is an env step, even if the copy is also reset.
    """
    env_id = f"{Lognormal.__module__}:Lognormal-v0"
    actions = np.random.default_rng(seed)
    with millrace.make_vec(env_id, COPIES, workers=COPIES, lanes=COPIES, autoreset_mode="SameStep") as env:
        env.reset(seed=COPIES * seed)
        ids = np.arange(COPIES)
        steps = 0
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
    """For each env copy, an array of its calls [calls, 3]: start, end, and whether the call was a reset."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ[TIMELINE] = folder
        try:
            rate(name, contender, seed)
        finally:
            del os.environ[TIMELINE]
        found = [np.fromfile(path).reshape(-1, 3) for path in Path(folder).iterdir() if path.stat().st_size]
    return sorted(found, key=len)[-COPIES:]  # without those of evaluations, which have fewer calls


def draw(found: dict[str, list[np.ndarray[Any, Any]]], seconds: float = 1.2) -> str:
    """An SVG for light and dark pages, with a row for each env copy: its steps and resets, and nothing while it waits."""
    panels = [_panel(title, copies, seconds) for title, copies in found.items()]
    height = 34 + ROW * COPIES + 16
    about = f"{', '.join(found)}: what {COPIES} env copies do in {seconds:g} seconds"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height * len(panels) + 24}" '
        f'font-family="system-ui, sans-serif" font-size="18"><title>{escape(about)}</title><style>{STYLE}</style>'
        + "".join(f'<g transform="translate(0 {height * n})">{panel}</g>' for n, panel in enumerate(panels))
        + f'<text y="{height * len(panels) + 14}"><tspan class="step">\u25a0</tspan> a step'
        ' <tspan class="reset" dx="12">\u25a0</tspan> a reset <tspan dx="12">empty: the copy waits</tspan>'
        f'<tspan x="{WIDTH}" text-anchor="end">{seconds:g} seconds</tspan></text></svg>\n'
    )


def _panel(title: str, copies: list[np.ndarray[Any, Any]], seconds: float) -> str:
    began_s = min(calls[-1, 1] for calls in copies) - seconds - 0.5
    paths = {False: "", True: ""}  # for steps and for resets
    busy_s = 0.0
    for row, calls in enumerate(copies):
        for start_s, end_s, is_reset in calls[(calls[:, 1] > began_s) & (calls[:, 0] < began_s + seconds)]:
            start, end = np.clip(np.array([start_s, end_s]) - began_s, 0.0, seconds)
            busy_s += end - start
            width = max((end - start) * WIDTH / seconds - 0.3, 0.3)  # leave a gap between two steps
            paths[bool(is_reset)] += f"M{start * WIDTH / seconds:.1f} {ROW * row + 34}h{width:.1f}v{ROW - 2}h{-width:.1f}z"
    return (
        f'<text y="20"><tspan class="name">{escape(title)}</tspan>: {busy_s / seconds / len(copies):.0%} of the time in '
        f'the environment</text><rect class="rows" y="32" width="{WIDTH}" height="{ROW * len(copies) + 2}"/>'
        f'<path class="step" d="{paths[False]}"/><path class="reset" d="{paths[True]}"/>'
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="compare training on a slow environment with Stable-Baselines3")
    parser.add_argument("--rounds", type=int, default=3, help="number of turns, each with another seed")
    parser.add_argument("--peers", action="store_true", help="compare with all installed systems that run 16 processes")
    parser.add_argument("--picture", type=Path, help="draw who waits for whom into this SVG, and measure nothing else")
    parser.add_argument("--only-loops", action="store_true", help="measure the two loops and the ideal only")
    arguments = parser.parse_args()
    here = contenders()
    others = {SUBPROC: CONTENDERS[SUBPROC]} if SUBPROC in here else {}
    others |= {name: each for name, each in PEERS.items() if arguments.peers and each.peer in install.installed()}
    if arguments.picture is not None:
        titles = {
            "Stable-Baselines3": SUBPROC,
            "millrace": "millrace, --max-lag 0",
            "millrace --max-lag 1": "millrace, --max-lag 1",
        }
        chosen = {title: timelines(name, (others | OURS)[name], 1) for title, name in titles.items()}
        arguments.picture.write_text(draw(chosen), encoding="utf-8")
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
    slowest = medians.get(SUBPROC)
    never_waiting = medians[NEVER_WAIT]
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
