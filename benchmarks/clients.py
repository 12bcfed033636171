"""Compares the C++ client with the Python worker: `python -m benchmarks.clients`. It needs a C++ compiler and CMake.

`steps`: env steps/s of CartPole-v1 in one worker on loopback that only steps, with random actions (`millrace.make_vec`).
Both kinds of worker take turns. `loop`: the time per action in a program that owns its loop at 50 Hz and acts itself, while
a learner updates continuously. `many`: a hundred C++ clients of one learner. All figures depend on what else runs on the
machine.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import re
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import millrace
from benchmarks.writing import write

SOURCE = Path(__file__).parents[1] / "clients/cpp"
COPIES = (1, 8, 64)
CLIENTS = 100
LONGEST_S = 300.0


def build(folder: Path) -> None:
    """Build the C++ examples in this folder. Raises `CalledProcessError` if that fails."""
    flags = ["cmake", "-S", str(SOURCE), "-B", str(folder), "-DCMAKE_BUILD_TYPE=Release"]
    for command in (flags, ["cmake", "--build", str(folder), "--target", "cartpole", "control_50hz"]):
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def free_address() -> str:
    """A free address on loopback."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{taken.getsockname()[1]}"


def started(stack: ExitStack, command: Sequence[str], **streams: Any) -> subprocess.Popen[str]:
    """Start a process, which `stack` ends."""
    process = subprocess.Popen(list(command), text=True, **{"stderr": subprocess.DEVNULL, **streams})

    def end() -> None:
        if process.poll() is None:
            process.terminate()
        process.wait(30)

    stack.callback(end)
    return process


def step_rate(command: Sequence[str], copies: int, seconds: float) -> float:
    """Env steps/s of one worker with this number of env copies in one lane."""
    address = free_address()
    with ExitStack() as stack:
        started(stack, [*command, address], stdout=subprocess.DEVNULL)
        env = stack.enter_context(millrace.make_vec("CartPole-v1", copies, lanes=1, bind=address))
        env.reset(seed=1)
        actions = np.random.default_rng(1).integers(0, 2, (1000, copies))
        steps = 0
        began_s = 0.0
        while steps == 0 or time.perf_counter() - began_s < seconds:
            for action in actions[:100]:
                env.step(action)
            if began_s:
                steps += 100 * copies
            else:
                began_s = time.perf_counter()  # the first hundred steps are warm-up
        return steps / (time.perf_counter() - began_s)


def loop_at_50_hz(folder: Path, ticks: int) -> dict[str, float]:
    """Run a program that owns its loop, while a learner updates continuously. Returns shares, and times in µs."""
    address = free_address()
    flags = (
        f"CartPole-v1 --preset none --bind {address} --envs 1 --lanes 1 --rollout-steps 50 --batch-size 25 --n-epochs 200"
    )
    flags += f" --steps {ticks} --eval-episodes 1 --eval-max-steps 50 --run-dir {folder / 'runs'}"
    with ExitStack() as stack:
        learner = started(stack, _learner(f"{flags} --max-lag 1"), stdout=subprocess.DEVNULL)
        client = started(stack, [str(folder / "control_50hz"), address], stdout=subprocess.PIPE)
        said, _ = client.communicate(timeout=LONGEST_S + ticks / 50)
        learner.wait(60)
    found = re.search(r"(\d+) steps.*; (\d+) late, (\d+) without.* took (\d+) µs.*, (\d+) µs.*, (\d+) µs", said)
    if found is None:
        raise RuntimeError(f"the client said: {said}")
    steps, late, without, median, p99, most = map(float, found.groups())
    return {"ticks": steps, "late": late / steps, "without": without / steps, "median": median, "p99": p99, "most": most}


def many_clients(folder: Path, steps: int) -> dict[str, float]:
    """Train with a hundred clients of one learner, which join, collect rollouts and leave."""
    address = free_address()
    flags = f"CartPole-v1 --bind {address} --envs {CLIENTS} --lanes {CLIENTS} --rollout-steps 32 --min-workers {CLIENTS}"
    flags += f" --steps {steps} --eval-episodes {CLIENTS} --run-dir {folder / 'many'}"
    with ExitStack() as stack:
        began_s = time.perf_counter()
        learner = started(stack, _learner(flags), stdout=subprocess.PIPE)
        clients = [
            started(stack, [str(folder / "cartpole"), address, "--name", f"c{n}"], stdout=subprocess.DEVNULL)
            for n in range(CLIENTS)
        ]
        said, _ = learner.communicate(timeout=LONGEST_S)
        ended_s = time.perf_counter() - began_s
        left = sum(client.wait(60) == 0 for client in clients)
    found = re.search(r"([\d,]+) env steps in ([\d.]+) s", said)
    if found is None:
        raise RuntimeError(f"the learner said: {said}")
    trained = float(found[1].replace(",", ""))
    training_s = float(found[2])
    return {"left with code 0": left, "seconds": ended_s, "env steps/s": trained / training_s}


def _learner(flags: str) -> list[str]:
    return [sys.executable, "-m", "millrace", "learner", *flags.split()]


def main() -> None:
    parser = argparse.ArgumentParser(description="measure the C++ client beside the Python worker")
    parser.add_argument("--only", nargs="+", default=["steps", "loop", "many"], choices=["steps", "loop", "many"])
    parser.add_argument("--rounds", type=int, default=3, help="number of turns of `steps`")
    parser.add_argument("--seconds", type=float, default=2.0, help="length of a turn of `steps`")
    parser.add_argument("--ticks", type=int, default=3000, help="length of `loop`")
    arguments = parser.parse_args()
    if shutil.which("cmake") is None or shutil.which("c++") is None:
        sys.exit("benchmarks.clients: expected cmake and c++, got none; apt-get install g++ cmake libzmq3-dev libsodium-dev")
    console = Console(width=110)
    record = dict[str, Any]()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        build(folder)
        if "steps" in arguments.only:
            workers = {
                "C++ client": [str(folder / "cartpole")],
                "Python worker": [sys.executable, "-m", "millrace", "worker"],
            }
            found: dict[tuple[int, str], list[float]] = {}
            for turn in range(arguments.rounds):
                for copies in COPIES:
                    for worker in list(workers)[:: 1 if turn % 2 else -1]:
                        rate = step_rate(workers[worker], copies, arguments.seconds)
                        found.setdefault((copies, worker), []).append(rate)
            table = Table("copies", *workers, "ratio", title="env steps/s of one worker that only steps, medians")
            for copies in COPIES:
                client, python = (statistics.median(found[copies, worker]) for worker in workers)
                table.add_row(str(copies), f"{client:,.0f}", f"{python:,.0f}", f"{client / python:.2f}")
            console.print(table)
            record["steps"] = {f"{copies}, {worker}": turns for (copies, worker), turns in found.items()}
        if "loop" in arguments.only:
            table = Table("ticks", "median µs", "99 % µs", "most µs", "later than 2 ms", title="a loop at 50 Hz")
            one = record["loop"] = loop_at_50_hz(folder, arguments.ticks)
            table.add_row(*(f"{one[key]:,.0f}" for key in ("ticks", "median", "p99", "most")), f"{one['late']:.1%}")
            console.print(table)
        if "many" in arguments.only:
            record["many"] = many_clients(folder, 64_000)
            console.print(f"{CLIENTS} clients: {', '.join(f'{key} {value:,.1f}' for key, value in record['many'].items())}")
    write("clients", record)


if __name__ == "__main__":
    main()
