"""Measures how much an open page of the dashboard slows the run that it shows, compared with a run without a dashboard.

`python -m benchmarks.watched`. On the machine that trains, separate processes serve and read the page, as with `--dashboard`
and a local browser. The page is requested once a second. The rate is env steps/s between two updates after the same numbers
of env steps in all runs, because CartPole's episodes grow longer while it learns. Contenders take turns, and each goes first
equally often.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from typing import Any

import millrace
from benchmarks.writing import write
from millrace.extras.monitoring.dashboard import Dashboard

READER = """
import sys, time, urllib.request
while True:
    urllib.request.urlopen(sys.argv[1] + "?part=main", timeout=10).read()
    time.sleep(1.0)
"""
STEPS = {"CartPole": (20_000, 80_000), "slow": (1_500, 6_500)}
"""The numbers of env steps between which the rate is measured"""
SETTINGS: dict[str, dict[str, Any]] = {
    "CartPole": {"env": "CartPole-v1", "workers": 2},
    "slow": {
        "env": "benchmarks.slow_env:Lognormal-v0", "preset": "none", "workers": 4, "lanes": 4, "envs": 8,
        "rollout_steps": 64, "worker_timeout_s": 30.0,
    },
}  # fmt: skip


def rate(name: str, seed: int, *, page: bool) -> float:
    """Env steps/s of a run. `page`: with an open page of the dashboard."""
    first, last = STEPS[name]
    moments: list[tuple[int, float]] = []
    to_open = page
    with ExitStack() as stack:

        def watch(progress: millrace.Progress) -> None:
            nonlocal to_open
            if to_open:
                to_open = False
                address = stack.enter_context(Dashboard(progress.run)).address
                reader = subprocess.Popen([sys.executable, "-c", READER, address], stderr=subprocess.DEVNULL)
                stack.callback(reader.wait)
                stack.callback(reader.kill)
            if progress.env_steps >= first and (not moments or progress.env_steps > moments[-1][0]):
                moments.append((progress.env_steps, time.monotonic()))

        folder = stack.enter_context(tempfile.TemporaryDirectory())
        settings = {"eval_every": 0, "eval_episodes": 1, "progress": False, **SETTINGS[name], "steps": last}
        millrace.train(**settings, seed=seed, run_dir=folder, callbacks=[watch])
    (first, began_s), (last, ended_s) = moments[0], moments[-1]
    return (last - first) / (ended_s - began_s)


def main() -> int:
    """Measure, print a table, and write it to benchmarks/results."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=4)
    flags = parser.parse_args()
    found: dict[str, dict[str, list[float]]] = {}
    for name in SETTINGS:
        of_env: dict[bool, list[float]] = {False: [], True: []}
        for seed in range(flags.rounds):
            for page in (False, True) if seed % 2 else (True, False):
                of_env[page].append(rate(name, seed, page=page))
        without, with_page = (statistics.median(of_env[page]) for page in (False, True))
        sys.stdout.write(
            f"{name:10} without {without:8,.0f}, page open {with_page:8,.0f} env steps/s, {with_page / without:.3f}\n"
        )
        sys.stdout.flush()
        found[name] = {"without": of_env[False], "page open": of_env[True]}
    write("watched", found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
