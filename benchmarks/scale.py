"""One learner with 10, 100 and 1,000 simulated workers: `python -m benchmarks.scale`.

The learner's side is real (link, coordinator, hub, stacking into a batch), except that its update does nothing. The workers
are those of `simulated.py`: real sockets over loopback TCP, real messages, and rollouts of 9 KB, which they send at once.
There is one lane for each worker, and an update takes one rollout of every lane. CPU time is that of the learner's whole
process, including ZeroMQ's thread.

Rule: no rollout may be lost, and the CPU time per rollout must not grow with the number of workers.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import multiprocessing
import statistics
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path

import msgspec
import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from benchmarks.simulated import POLICY, VERSIONS, run_spec, simulate, table
from benchmarks.writing import write
from millrace.learner.rollouts.hub import Hub, HubSettings
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.protocol.policy.layout import acting_size, buffer_size
from millrace.protocol.rollout import stack_rollouts
from millrace.protocol.wire.learner_link import LearnerLink

WORKERS = (10, 100, 1000)
PROCESSES = 2
WARM_UP = 5  # number of updates that aren't counted
FLAT = 1.2  # target for the CPU time per rollout with the most workers, as a multiple of that with the fewest


class Measured(msgspec.Struct, frozen=True, kw_only=True):
    """The measurements of one learner."""

    workers: int
    join_s: float
    """seconds from the start of the first worker until the last one has joined"""
    updates: int
    rollouts_per_s: float
    mb_per_s: float
    """megabytes received per second"""
    cpu_us: float
    """CPU time of the learner's process for each rollout, including weights and heartbeats"""
    python_us: float
    """the part of this CPU time in the thread that runs Python"""
    spread_ms: float
    """median time from publishing weights until the last worker acts with them"""
    start_mb: float
    """resident memory before the first worker has joined"""
    worker_kb: float
    """resident memory that each worker adds, measured after all have joined and sent some rollouts"""
    growth_mb: float
    """growth of the resident memory during the measurement"""
    lost: int
    """number of rollouts and tickets that should have been used but weren't"""


def learn(workers: int, seconds: float, transport: str, folder: Path, told: Connection) -> None:
    """The learner's process: sends its address through the pipe, measures, and sends the measurements."""
    me = psutil.Process()
    run = run_spec(workers)
    link = LearnerLink(f"ipc://{folder}/learner" if transport == "ipc" else "tcp://127.0.0.1:*")
    coordinator = TicketCoordinator(run, RolloutDealer(run.lanes, Rounds(0)), worker_timeout_s=10, first_session=1)
    hub = Hub(link, coordinator, HubSettings(no_workers_timeout_s=60, stall_timeout_s=30, max_env_failures=0))
    parameters = np.zeros(acting_size(POLICY), np.float32)
    buffers = np.zeros(buffer_size(POLICY), np.float32)
    published_s: list[float] = []

    def publish() -> None:
        published_s.append(time.monotonic())
        hub.publish(len(published_s) - 1, parameters.copy(), buffers)

    start_mb = _resident_mb(me)
    told.send(link.address)
    began_s = time.monotonic()
    hub.wait_for(workers)
    join_s = time.monotonic() - began_s
    publish()
    for _ in range(WARM_UP):
        stack_rollouts([arrived.rollout for arrived in hub.gather()])
        publish()
    warm_mb = _resident_mb(me)
    first = len(published_s)
    bytes_before = link.received.bytes
    used_before = coordinator.rollouts.ledger.used
    cpu_s = time.process_time()
    python_s = time.thread_time()
    began_s = time.monotonic()
    while time.monotonic() - began_s < seconds and len(published_s) < VERSIONS:
        stack_rollouts([arrived.rollout for arrived in hub.gather()])
        publish()
    took_s = time.monotonic() - began_s
    cpu_s = time.process_time() - cpu_s
    python_s = time.thread_time() - python_s
    used = coordinator.rollouts.ledger.used - used_before
    received_bytes = link.received.bytes - bytes_before
    growth_mb = _resident_mb(me) - warm_mb
    counts = coordinator.rollouts.ledger.counts()
    lost = counts["lost"] + sum(counts[f"transitions_{why}"] for why in ("duplicate", "late", "invalid"))
    lost += counts["messages_bad"] + abs(counts["issued"] - counts["used"] - counts["outstanding"])
    for _ in range(2):  # so that the last weights of the measurement arrive
        hub.gather()
        publish()
    hub.drain("measured", 10)
    link.close(0)
    arrived_s = np.array(table(folder, workers)[first : len(published_s) - 2])
    spread_s = (arrived_s.max(1) - published_s[first : len(published_s) - 2])[(arrived_s > 0).all(1)]
    told.send(
        Measured(
            workers=workers,
            join_s=join_s,
            updates=used // workers,
            rollouts_per_s=used / took_s,
            mb_per_s=received_bytes / took_s / 1e6,
            cpu_us=cpu_s / used * 1e6,
            python_us=python_s / used * 1e6,
            spread_ms=float(np.median(spread_s)) * 1e3 if len(spread_s) else float("nan"),
            start_mb=start_mb,
            worker_kb=(warm_mb - start_mb) / workers * 1e3,
            growth_mb=growth_mb,
            lost=lost,
        )
    )


def _resident_mb(process: psutil.Process) -> float:
    return float(process.memory_info().rss / 1e6)


def measure(workers: int, seconds: float, transport: str) -> Measured:
    """Run a new learner with this number of workers, which share a few processes."""
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        table(folder, workers, "w+")
        here, there = context.Pipe()
        learner = context.Process(target=learn, args=(workers, seconds, transport, folder, there))
        learner.start()
        there.close()
        address = here.recv()
        share = -(-workers // PROCESSES)
        shares = [range(first, min(first + share, workers)) for first in range(0, workers, share)]
        crowd = [context.Process(target=simulate, args=(address, numbers, workers, folder)) for numbers in shares]
        for process in crowd:
            process.start()
        try:
            found: Measured = here.recv()
        finally:
            for process in (learner, *crowd):
                process.join(20)
                process.kill()
    return found


def show(rows: list[Measured], rounds: int) -> Table:
    shown = Table(title=f"One learner, simulated workers, medians of {rounds}")
    for column in ("workers", "joined in s", "rollouts/s", "MB/s", "CPU µs a rollout", "in Python", "publish to last, ms",
                   "MB at start", "KB a worker", "MB grown", "lost"):  # fmt: skip
        shown.add_column(column, justify="right")
    for row in rows:
        shown.add_row(
            *(str(row.workers), f"{row.join_s:.1f}", f"{row.rollouts_per_s:,.0f}", f"{row.mb_per_s:.0f}"),
            *(f"{row.cpu_us:.0f}", f"{row.python_us:.0f}", f"{row.spread_ms:.0f}", f"{row.start_mb:.0f}"),
            *(f"{row.worker_kb:.0f}", f"{row.growth_mb:.1f}", str(row.lost)),
        )
    return shown


def medians(turns: list[Measured]) -> Measured:
    """The median of each figure, except `lost`, which is summed over all turns."""
    fields = {name: statistics.median(getattr(turn, name) for turn in turns) for name in Measured.__struct_fields__}
    fields |= {name: int(fields[name]) for name in ("workers", "updates")}
    return Measured(**fields | {"lost": sum(turn.lost for turn in turns)})


def main() -> None:
    parser = argparse.ArgumentParser(description="one learner before many simulated workers")
    parser.add_argument("--workers", type=int, nargs="+", default=WORKERS)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=4.0, help="of each turn")
    parser.add_argument("--transport", choices=("tcp", "ipc"), default="tcp")
    arguments = parser.parse_args()
    turns = [
        [measure(workers, arguments.seconds, arguments.transport) for workers in arguments.workers]
        for _ in range(arguments.rounds)
    ]
    rows = [medians(list(column)) for column in zip(*turns, strict=True)]
    console = Console(width=140)
    console.print(show(rows, arguments.rounds))
    growth = statistics.median(turn[-1].cpu_us / turn[0].cpu_us for turn in turns)
    console.print(f"CPU a rollout, {rows[-1].workers} workers against {rows[0].workers}: {growth:.2f} (target ≤ {FLAT})")
    found = msgspec.to_builtins(rows)
    charts = [
        (title, {f"{row['workers']:,} workers": float(row[name]) for row in found})
        for title, name in (
            ("CPU µs a rollout", "cpu_us"),
            ("rollouts/s", "rollouts_per_s"),
            ("publish to last, ms", "spread_ms"),
        )
    ]
    write("scale", {"scale": found, "transport": arguments.transport, "cpu_growth": growth}, charts)


if __name__ == "__main__":
    main()
