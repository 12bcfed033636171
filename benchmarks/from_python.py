"""Compares training from a script and from a notebook with training from the command line: `millrace bench python`.

The three ways differ in which program imports numpy and PyTorch first. They must be equally fast, even while two other
processes are busy. All take turns, and ratios are computed within a turn. The notebook is left out if nbclient and ipykernel
aren't installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import multiprocessing
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.table import Table

import millrace
from benchmarks.writing import write

SETTINGS = {"algo": "sac", "seed": 1, "eval_episodes": 1}
COMMAND_LINE = "command line"
CODE = """import numpy, torch, millrace
millrace.train("Pendulum-v1", steps={steps}, run_dir={run_dir!r}, progress=False, **{settings})
"""


def command_line(steps: int, run_dir: str) -> None:
    flags = [
        f"--{name.replace('_', '-')}={value}" for name, value in {**SETTINGS, "steps": steps, "run_dir": run_dir}.items()
    ]
    command = [sys.executable, "-m", "millrace", "train", "Pendulum-v1", *flags]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def script(steps: int, run_dir: str) -> None:
    code = CODE.format(steps=steps, run_dir=run_dir, settings=SETTINGS)
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def notebook(steps: int, run_dir: str) -> None:
    import nbclient
    import nbformat

    code = CODE.format(steps=steps, run_dir=run_dir, settings=SETTINGS)
    nbclient.NotebookClient(nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)]), timeout=600).execute()


WAYS: dict[str, Callable[[int, str], None]] = {COMMAND_LINE: command_line, "script": script, "notebook": notebook}


def spin() -> None:
    while True:
        pass


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    processes = [multiprocessing.Process(target=spin, daemon=True) for _ in range(count)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.join()


def rate(train: Callable[[int, str], None], steps: int) -> float:
    """Env steps/s of the run."""
    with tempfile.TemporaryDirectory() as folder:
        train(steps, folder)
        (run,) = Path(folder).iterdir()
        summary = millrace.Run(run).summary
        assert summary is not None
        return summary.env_steps / summary.wall_s


def main() -> None:
    parser = argparse.ArgumentParser(
        description="compare training from Python with the command line, alone and beside others"
    )
    parser.add_argument("--rounds", type=int, default=5, help="number of turns")
    parser.add_argument("--steps", type=int, default=1000, help="env steps of a run")
    arguments = parser.parse_args()
    has_kernel = all(importlib.util.find_spec(name) for name in ("nbclient", "nbformat", "ipykernel"))
    ways = {name: way for name, way in WAYS.items() if name != "notebook" or has_kernel}
    found: dict[tuple[int, str], list[float]] = {}
    for turn in range(arguments.rounds):
        for busy in (0, 2):
            with busy_processes(busy):
                for name in list(ways)[:: 1 if turn % 2 else -1]:
                    found.setdefault((busy, name), []).append(rate(ways[name], arguments.steps))
    table = Table("busy processes beside", "from", "env steps/s, median", "ratio to the command line, median (all turns)")
    rows = []
    for (busy, name), rates in sorted(found.items()):
        ratios = [one / other for one, other in zip(rates, found[busy, COMMAND_LINE], strict=True)]
        rows.append({"busy": busy, "from": name, "rates": rates, "ratio": statistics.median(ratios)})
        shown = f"{statistics.median(ratios):.2f} ({', '.join(f'{ratio:.2f}' for ratio in ratios)})"
        table.add_row(str(busy), name, f"{statistics.median(rates):,.0f}", shown)
    Console(width=120).print(table)
    write("from_python", {"settings": SETTINGS, "rows": rows})


if __name__ == "__main__":
    main()
