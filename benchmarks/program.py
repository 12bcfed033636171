"""`millrace bench [NAME [flags]]`, or `python -m benchmarks.program`: runs one benchmark, or all of them in turn.

Rule: each benchmark is a module with a `main`, and runs in a process of its own, so that it doesn't inherit threads, imports
or memory of another benchmark. It prints its results and writes them to `benchmarks/results`. An interrupt ends all its
processes.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

from millrace.learner.interrupts import stopped_by_signals
from millrace.protocol.errors import UsageError

ROOT = Path(__file__).parents[1]


class Benchmark(NamedTuple):
    """One benchmark."""

    module: str
    about: str
    peers: bool = False
    """whether it needs Stable-Baselines3"""
    brief: tuple[str, ...] = ()
    """its flags when all benchmarks are run, which make it shorter"""


BENCHMARKS = {
    "collect": Benchmark(
        "collect",
        "collecting with two worker processes, compared with a plain loop",
        brief=("--rounds", "3", "--seconds", "0.5"),
    ),
    "vector": Benchmark(
        "vector_env",
        "vector environments, compared with gymnasium's and Stable-Baselines3's",
        True,
        ("--rounds", "3", "--seconds", "0.5"),
    ),
    "update": Benchmark("update", "updates, compared with autograd and Stable-Baselines3", brief=("--rounds", "40")),
    "train": Benchmark(
        "train",
        "PPO on CartPole-v1, compared with Stable-Baselines3; --peers: with six more systems",
        brief=("--rounds", "2"),
    ),
    "slow": Benchmark(
        "slow", "PPO on an environment whose steps sleep 5 ms, compared with Stable-Baselines3", brief=("--rounds", "1")
    ),
    "plan": Benchmark(
        "plan",
        "what millrace plan recommends and expects, compared with runs",
        brief=("--envs", "waits for 5 ms", "--seconds", "2"),
    ),
    "python": Benchmark(
        "from_python",
        "training from a script and a notebook, compared with the command line, alone and beside busy processes",
        brief=("--rounds", "1"),
    ),
    "service": Benchmark(
        "rollout_service",
        "the rollout service, compared with the built-in trainer's collecting rate",
        brief=("--rounds", "2", "--seconds", "2"),
    ),
    "wire": Benchmark("wire", "sending rollouts, compared with raw ZeroMQ"),
    "scale": Benchmark("scale", "one learner with 10, 100 and 1,000 simulated workers"),
    "memory": Benchmark(
        "memory", "memory of all processes of a run, compared with Stable-Baselines3", brief=("--rounds", "1")
    ),
    "gpu": Benchmark(
        "gpu", "PPO from frames by its parts, for a machine with a GPU", brief=("--seconds", "1", "--updates", "4")
    ),
    "worker": Benchmark("worker", "cost of a worker process: seconds to its first rollout, memory"),
}


def overview() -> str:
    """The text that lists all benchmarks."""
    lines = [f"  millrace bench {name:8}  {each.about}" for name, each in BENCHMARKS.items()]
    usage = ["usage: millrace bench [NAME [flags]]", "", "Run one benchmark, or all of them (ten minutes).", ""]
    return "\n".join([*usage, *lines, "", "millrace bench NAME --help lists the flags of each."])


def main(argv: list[str]) -> int:
    """Run the benchmark that `argv` names, or all. Returns the exit code. Raises `UsageError` for wrong arguments."""
    if argv and argv[0] in ("-h", "--help"):
        print(overview())
        return 0
    name, *flags = argv or [""]
    if name and name not in BENCHMARKS:
        raise UsageError(f"bench {name}: expected one of {', '.join(BENCHMARKS)}, or nothing, which is all of them")
    failed = []
    all_began_s = time.monotonic()
    for each in [name] if name else BENCHMARKS:
        if not name and BENCHMARKS[each].peers and importlib.util.find_spec("stable_baselines3") is None:
            print(f"{each}: left out, Stable-Baselines3 is not installed (pip install stable-baselines3)", flush=True)
            continue
        began_s = time.monotonic()
        command = [
            sys.executable,
            "-m",
            f"benchmarks.{BENCHMARKS[each].module}",
            *(flags if name else BENCHMARKS[each].brief),
        ]
        path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        if _run(command, os.environ | {"PYTHONPATH": path}):
            failed.append(each)
        elif not name:
            print(f"{each}: {time.monotonic() - began_s:.0f} s\n", flush=True)
    if not name:
        print(f"all: {(time.monotonic() - all_began_s) / 60:.0f} minutes")
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    elif "--help" not in flags and "-h" not in flags:
        print(f"JSON and pictures: {ROOT / 'benchmarks' / 'results'}")
    return 1 if failed else 0


def _run(command: list[str], env: dict[str, str]) -> int:
    """Run the benchmark in a process group of its own. An interrupt kills the group, because its processes have nothing to
    clean up. Returns the exit code.
    """
    with subprocess.Popen(command, env=env, start_new_session=True) as process:
        try:
            return process.wait()
        except KeyboardInterrupt:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            raise


if __name__ == "__main__":
    try:
        with stopped_by_signals():
            sys.exit(main(sys.argv[1:]))
    except UsageError as error:
        print(f"millrace: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:  # `millrace bench` prints the message
        sys.exit(130)
