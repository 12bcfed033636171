"""Env steps/s and memory of vector environments under random actions: `python -m benchmarks.vector_env`.

The contenders are gymnasium's Sync and Async (shared memory), Stable-Baselines3's Dummy and Subproc, tianshou and TorchRL if
they are installed, and millrace (through shared memory, and with messages over ipc and tcp). The upper limit is two
processes that each step half of the copies in a bare loop and send nothing. The tasks are CartPole-v1 with two workers, an
environment that sleeps, with as many workers as the other libraries have processes, and image frames. In each round all
contenders run once, in an order that changes from round to round. Rates are medians over rounds; ratios are computed within
a round.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import statistics

from rich.console import Console
from rich.table import Table

from benchmarks.vector_contenders import ASYNC, LIMIT, OURS, Contender, Task, make, memory_mb
from benchmarks.writing import bars, write

PEERS = ("SB3 SubprocVecEnv", "tianshou Shmem", "TorchRL ParallelEnv")
ALL = ("gymnasium Sync", ASYNC, "SB3 DummyVecEnv", *PEERS, *OURS, LIMIT)
FEW = ("gymnasium Sync", ASYNC, *PEERS, "millrace")
TASKS: tuple[tuple[Task, tuple[str, ...]], ...] = (
    *((Task("CartPole-v1", "CartPole-v1", copies, 2), ALL) for copies in (8, 16, 64)),
    (Task("sleeps 1 ms a step", "benchmarks.slow_env:Constant-v0", 8, 8, {"seconds": 0.001}), FEW),
    (Task("84 × 84 × 4 uint8", "benchmarks.random_frames:RandomFrames-v0", 8, 2), FEW),
    (Task("84 × 84 × 4 uint8", "benchmarks.random_frames:RandomFrames-v0", 8, 8), FEW),
)
Rows = list[dict[str, object]]


def measure(task: Task, names: tuple[str, ...], rounds: int, seconds: float) -> Rows:
    """A row for each contender, with its rate and the medians of its ratios to gymnasium's Async and to the upper limit."""
    contenders: dict[str, Contender] = {}
    missing = []
    for name in names:
        try:
            contenders[name] = make(name, task)
        except ImportError:
            missing.append(name)
    for contender in contenders.values():
        contender.rate(0.2)  # warm up
    rates = []
    for number in range(rounds):
        first = number % len(contenders)
        order = [*contenders.items()]
        rates.append({name: contender.rate(seconds) for name, contender in order[first:] + order[:first]})
    for contender in contenders.values():
        contender.close()
    about = {"task": task.title, "copies": task.copies, "workers": task.workers}
    rows: Rows = [about | {"contender": name, "env_steps_per_s": None} for name in missing]
    for name in contenders:
        rows.append(
            about
            | {
                "contender": name,
                "env_steps_per_s": round(statistics.median(rate[name] for rate in rates)),
                "of_async": statistics.median(rate[name] / rate[ASYNC] for rate in rates),
                "of_limit": statistics.median(rate[name] / rate[LIMIT] for rate in rates) if LIMIT in names else None,
            }
        )
    return rows


def memory() -> Rows:
    """The memory of the processes that 64 copies of CartPole-v1 need, without this process."""
    task = Task("CartPole-v1", "CartPole-v1", 64, 2)
    rows: Rows = []
    for name in (ASYNC, "SB3 SubprocVecEnv", "millrace"):
        processes, megabytes = memory_mb(name, task)
        rows.append({"copies": task.copies, "contender": name, "processes": processes, "pss_mb": round(megabytes)})
    return rows


def show(rows: Rows, rounds: int) -> Table:
    table = Table(title=f"random actions, medians of {rounds}")
    for column in ("task", "copies", "our workers", "", "env steps/s", "× gymnasium Async", "of the limit"):
        table.add_column(column, justify="left" if column in ("", "task") else "right", no_wrap=column == "")
    for row in rows:
        about = str(row["task"]), str(row["copies"]), str(row["workers"]), str(row["contender"])
        if row["env_steps_per_s"] is None:
            table.add_row(*about, "not installed", "", "")
            continue
        limit = "" if row["of_limit"] is None else f"{row['of_limit']:.2f}"
        table.add_row(*about, f"{row['env_steps_per_s']:,}", f"{row['of_async']:.1f}", limit)
    return table


def show_memory(rows: Rows) -> Table:
    table = Table(title="CartPole-v1, 64 copies: memory of the processes started, PSS")
    for column in ("", "processes", "MB"):
        table.add_column(column, justify="left" if column == "" else "right")
    for row in rows:
        table.add_row(str(row["contender"]), str(row["processes"]), str(row["pss_mb"]))
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description="vector environments under random actions")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.0, help="of each measurement")
    arguments = parser.parse_args()
    memory_rows = memory()
    rows: Rows = []
    charts = []
    for task, names in TASKS:
        found = measure(task, names, arguments.rounds, arguments.seconds)
        rows += found
        title = f"{task.title}, env steps/s, {task.copies} copies, {task.workers} workers"
        charts.append((title, bars([row for row in found if row["env_steps_per_s"]], "contender", "env_steps_per_s")))
    charts.append(("64 copies: MB, PSS", bars(memory_rows, "contender", "pss_mb")))
    Console(width=120).print(show(rows, arguments.rounds))
    Console().print(show_memory(memory_rows))
    write("vector_env", {"vector_env": rows, "memory": memory_rows}, charts)


if __name__ == "__main__":
    main()
