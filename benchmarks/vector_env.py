"""Vector environments under random actions, env steps/s, and their memory: `python -m benchmarks.vector_env`.

gymnasium's Sync and Async (shared memory), Stable-Baselines3's Dummy and Subproc, tianshou and TorchRL where they are
installed, ours (through shared memory, and by messages over ipc and tcp), and the limit: two processes that each step half
of the copies in a bare loop and answer nobody. On CartPole-v1 with two workers; on an environment that sleeps, with as many
workers as the peers have processes; on frames. All take turns, and the order changes from round to round; medians of
rounds, ratios within each round.
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
    (Task("sleeps 1 ms a step", "workers.envs.toy:Slow-v0", 8, 8, {"seconds": 0.001, "k": 100}), FEW),
    (Task("84 × 84 × 4 uint8", "workers.envs.toy:Frames-v0", 8, 2), FEW),
    (Task("84 × 84 × 4 uint8", "workers.envs.toy:Frames-v0", 8, 8), FEW),
)
Rows = list[dict[str, object]]


def stepping(task: Task, names: tuple[str, ...], rounds: int, seconds: float) -> Rows:
    """A row for each contender: its rate and, by rounds, its share of gymnasium's Async and of the limit."""
    contenders: dict[str, Contender] = {}
    absent = []
    for name in names:
        try:
            contenders[name] = make(name, task)
        except ImportError:
            absent.append(name)
    for contender in contenders.values():
        contender.rate(0.2)  # warm up
    turns = []
    for number in range(rounds):
        first = number % len(contenders)
        order = [*contenders.items()]
        turns.append({name: contender.rate(seconds) for name, contender in order[first:] + order[:first]})
    for contender in contenders.values():
        contender.close()
    about = {"task": task.title, "copies": task.copies, "workers": task.workers}
    rows: Rows = [about | {"contender": name, "env_steps_per_s": None} for name in absent]
    for name in contenders:
        rows.append(
            about
            | {
                "contender": name,
                "env_steps_per_s": round(statistics.median(turn[name] for turn in turns)),
                "of_async": statistics.median(turn[name] / turn[ASYNC] for turn in turns),
                "of_limit": statistics.median(turn[name] / turn[LIMIT] for turn in turns) if LIMIT in names else None,
            }
        )
    return rows


def memory() -> Rows:
    """What 64 copies of CartPole-v1 take, beside this process."""
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
    parser.add_argument("--seconds", type=float, default=1.0, help="of each turn")
    arguments = parser.parse_args()
    taken = memory()
    rows: Rows = []
    charts = []
    for task, names in TASKS:
        found = stepping(task, names, arguments.rounds, arguments.seconds)
        rows += found
        title = f"{task.title}, env steps/s, {task.copies} copies, {task.workers} workers"
        charts.append((title, bars([row for row in found if row["env_steps_per_s"]], "contender", "env_steps_per_s")))
    charts.append(("64 copies: MB, PSS", bars(taken, "contender", "pss_mb")))
    Console(width=120).print(show(rows, arguments.rounds))
    Console().print(show_memory(taken))
    write("vector_env", {"vector_env": rows, "memory": taken}, charts)


if __name__ == "__main__":
    main()
