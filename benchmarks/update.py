"""Compares the learner's updates with code in the usual style and with Stable-Baselines3: `python -m benchmarks.update`.

It runs in one process with one thread. `contest.py` times the work, which `update_ppo.py` and `update_stable_baselines3.py`
define. If Stable-Baselines3 isn't installed (`pip install stable-baselines3`), the comparison with it is left out, and a
line says so.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import importlib.util

import torch
from rich.console import Console
from rich.table import Table

from benchmarks import update_ppo
from benchmarks.contest import Contest, measure
from benchmarks.writing import write

COLUMNS = ("update", "rows", "peer", "its ms", "graph ms", "ours ms", "products ms", "ratio", "target", "to graph")


def contests(console: Console) -> list[Contest]:
    """All contests that can be run here."""
    found = [update_ppo.contest(rows, target) for rows, target in ((64, 0.2), (256, 0.4), (2048, 0.65), (4096, None))]
    found += [update_ppo.contest(rows, None, width=256) for rows in (64, 512, 4096)]
    if importlib.util.find_spec("stable_baselines3") is None:
        console.print("Stable-Baselines3 is not installed: left out")
        return found
    from benchmarks import update_stable_baselines3 as peer

    found += [peer.dqn(64, 0.35), peer.dqn(256, 0.35), peer.a2c(5, 0.35), peer.a2c(16, 0.35)]
    found += [peer.continuous(name, width, None) for name in ("SAC", "TD3") for width in (64, 256)]
    found += [peer.continuous("TQC", 256, None), peer.continuous("CrossQ", 256, None), peer.continuous("CrossQ", 1024, None)]
    return [*found, *(peer.beside_sac(name, 256) for name in ("TQC", "CrossQ", "XQC"))]


def main() -> None:
    parser = argparse.ArgumentParser(description="Time updates against the usual style and Stable-Baselines3.")
    parser.add_argument("--rounds", type=int, default=100)
    rounds = parser.parse_args().rounds
    torch.set_num_threads(1)
    console = Console(width=110)
    load_before = os.getloadavg()[0]
    results = [measure(contest, rounds) for contest in contests(console)]
    load = f"load {load_before:.1f} before, {os.getloadavg()[0]:.1f} after"
    table = Table(*COLUMNS, title=f"CPU time of an update, medians of {rounds} turns; {load}")
    for r in results:
        numbers = (f"{r[key]:.3f}" for key in ("peer_ms", "graph_ms", "ours_ms", "products_ms", "ratio"))
        target = "" if r["target"] is None else f"≤ {r['target']}"
        table.add_row(str(r["update"]), str(r["rows"]), str(r["peer"]), *numbers, target, f"{r['ratio_to_graph']:.3f}")
    console.print(table)
    ratios = {f"{r['update']}, {r['rows']} rows, against {r['peer']}": float(str(r["ratio"])) for r in results}
    record = {"threads": 1, "rounds": rounds, "results": results}
    write("update", record, [("time of our update, as a share of the other's", ratios)])


if __name__ == "__main__":
    main()
