"""Compares workers on another host, over a link with a delay of 5 ms, with workers on loopback.

`python -m benchmarks.two_hosts`. The learner runs on one host and `millrace worker --processes 4` on the other. The hosts
are network namespaces of this machine (this needs root, iproute2 and nftables). A TCP proxy delays the link by 5 ms in each
direction. All processes share the cores of this machine, so the numbers show only the effect of the link. Each run trains
PPO with keys and the same settings; env steps/s are measured from the fifth update on. There are two environments:
CartPole-v1, where the link matters most, and one whose step sleeps for a millisecond.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.writing import write
from tests.system.stage.network import Network, why_not
from tests.system.stage.processes import START_S, TOY, Stage, free_port

PROCESSES = 4
DELAY_S = 0.005  # delay of the link in one direction
ENVS: dict[str, dict[str, object]] = {
    "CartPole-v1": {"env-kwargs": "", "rollout-steps": 128, "envs": 32, "batch-size": 1024, "n-epochs": 1},
    TOY: {"env-kwargs": "seconds 0.001", "rollout-steps": 128, "envs": 8, "batch-size": 256, "n-epochs": 1},
}
WAYS = ("loopback", "two hosts", "two hosts, 5 ms")


def rate(env: str, way: str, max_lag: int, seconds: float) -> float:
    """Measure the env steps/s of one run."""
    with tempfile.TemporaryDirectory() as folder, Network() as network:
        stage = Stage(Path(folder))
        try:
            return _rate(stage, network, env, way, max_lag, seconds)
        finally:
            stage.close()


def _rate(stage: Stage, network: Network, env: str, way: str, max_lag: int, seconds: float) -> float:
    there = network.host(1)
    here = network.host(2)
    keys, token = stage.keys()
    port = free_port()
    host, before = ("127.0.0.1", ()) if way == "loopback" else (there.address, there.before)
    settings = ENVS[env] | {"keys": keys, "min-workers": PROCESSES, "max-lag": max_lag, "worker-timeout-s": 10}
    learner = stage.learner(f"tcp://{host}:{port}", settings, env=env, before=before)
    learner.is_open()
    to = port
    if way.endswith("ms"):
        to = free_port()
        proxy = [sys.executable, "-m", "tests.system.stage.proxy", str(port), host, str(to)]
        stage.start([*before, *proxy], "proxy", told=True).tell(f"delay {DELAY_S}")
    command = [sys.executable, "-m", "millrace", "worker", f"tcp://{host}:{to}", "--token", str(token)]
    stage.start([*(here.before if before else ()), *command, "--processes", str(PROCESSES)], "workers")
    learner.trains(5)  # warm-up
    first = learner.rows()[-1]
    learner.until(lambda row: row["time/time_elapsed"] >= first["time/time_elapsed"] + seconds, START_S + seconds)
    last = learner.rows()[-1]
    steps = last["time/total_timesteps"] - first["time/total_timesteps"]
    return float(steps / (last["time/time_elapsed"] - first["time/time_elapsed"]))


def main() -> None:
    parser = argparse.ArgumentParser(description="compare two hosts with a 5 ms link with loopback")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=8.0, help="seconds to measure in each run")
    parser.add_argument("--max-lag", type=int, nargs="+", default=[0, 1])
    arguments = parser.parse_args()
    if why := why_not():
        sys.exit(why)
    cases = [(env, lag) for env in ENVS for lag in arguments.max_lag]
    turns = [
        {(env, lag, way): rate(env, way, lag, arguments.seconds) for env, lag in cases for way in WAYS}
        for _ in range(arguments.rounds)
    ]
    table = Table("", "max lag", *WAYS, title=f"env steps/s of {PROCESSES} workers, medians of {arguments.rounds}")
    rows = []
    for env, lag in cases:
        found = {way: statistics.median(turn[env, lag, way] for turn in turns) for way in WAYS}
        shares = {way: statistics.median(turn[env, lag, way] / turn[env, lag, WAYS[0]] for turn in turns) for way in WAYS}
        table.add_row(env, str(lag), *(f"{found[way]:,.0f} ({shares[way]:.2f})" for way in WAYS))
        rows += [
            {"env": env, "max_lag": lag, "way": way, "env_steps_per_s": round(found[way]), "share_of_loopback": shares[way]}
            for way in WAYS
        ]
    Console().print(table)
    write("two_hosts", {"two_hosts": rows})


if __name__ == "__main__":
    main()
