"""PPO on CartPole-v1 as programs of their own, alike in settings: ours, as the command line makes it, and a peer's.

The law: whoever is compared gets the same hyperparameters, one torch thread, and its own process tree from a cold start.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from learner.metrics import read_rows

ROOT = Path(__file__).parents[1]
OURS, DUMMY, SUBPROC = "millrace, 2 workers", "SB3, one process", "SB3, SubprocVecEnv"
COMMON: dict[str, Any] = {
    "env": "CartPole-v1",
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
    "eval_every": 5000,
    "eval_episodes": 20,
}
# RL Zoo's for CartPole-v1, and a large batch. Names are those of our flags.
ZOO = COMMON | {
    "envs": 8, "rollout_steps": 32, "batch_size": 256, "n_epochs": 20, "gamma": 0.98, "gae_lambda": 0.8, "ent_coef": 0.0,
    "learning_rate": 1e-3, "learning_rate_schedule": "linear", "clip_range": 0.2, "clip_range_schedule": "linear",
}  # fmt: skip
LARGE = COMMON | {
    "envs": 64, "rollout_steps": 128, "batch_size": 2048, "n_epochs": 4, "gamma": 0.99, "gae_lambda": 0.95, "ent_coef": 0.0,
    "learning_rate": 3e-4, "learning_rate_schedule": "constant", "clip_range": 0.2, "clip_range_schedule": "constant",
}  # fmt: skip
SETTINGS = {"8 × 32, batch 256, 20 epochs": ZOO, "64 × 128, 4 minibatches, 4 epochs": LARGE}
LEAST_S = 0.05  # between two looks at a program that runs
LONGEST_S = 300.0


class Ran(NamedTuple):
    """What a program did."""

    wall_s: float
    """from the command to its end"""
    updates: list[tuple[int, float]]
    """env steps, and seconds by some clock, at the end of each update"""


def contenders() -> list[str]:
    """Those that can be run here."""
    return [OURS, DUMMY, SUBPROC] if importlib.util.find_spec("stable_baselines3") else [OURS]


def run(
    contender: str,
    settings: dict[str, Any],
    target: float | None = None,
    look: Callable[[int], None] = lambda pid: None,
) -> Ran:
    """Run it to its end; `look` is called now and then with its pid. With a target it ends as soon as that is reached."""
    with tempfile.TemporaryDirectory() as folder:
        ours = contender == OURS
        command = _ours(settings, target, folder) if ours else _theirs(contender, settings, target)
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        out = Path(folder) / "out"
        with out.open("w") as file:
            began_s = time.monotonic()
            process = subprocess.Popen(
                [sys.executable, "-m", *command],
                stdout=file,
                stderr=subprocess.STDOUT,
                env=os.environ | threads | {"PYTHONPATH": path},
                cwd=folder,
            )
            try:
                while process.poll() is None and time.monotonic() - began_s < LONGEST_S:
                    look(process.pid)
                    try:
                        process.wait(LEAST_S)
                    except subprocess.TimeoutExpired:
                        continue
                wall_s = time.monotonic() - began_s
            finally:
                process.kill()
                process.wait()
        if process.returncode:
            raise RuntimeError(f"{contender} ended with {process.returncode}: {out.read_text()[-500:]}")
        if ours:
            (table,) = Path(folder).rglob("metrics.jsonl")
            return Ran(wall_s, [(row["time/total_timesteps"], row["time/time_elapsed"]) for row in read_rows(table)])
        lines = [json.loads(line) for line in out.read_text().splitlines() if line.startswith('{"env_steps"')]
        return Ran(wall_s, [(line["env_steps"], line["at_s"]) for line in lines])


def _ours(settings: dict[str, Any], target: float | None, folder: str) -> list[str]:
    named = {name: value for name, value in settings.items() if name != "env"}
    if target is None:
        named |= {"eval_every": 0, "eval_episodes": 1}
    flags = [word for name, value in named.items() for word in (f"--{name.replace('_', '-')}", str(value))]
    until = [] if target is None else ["--target-return", str(target)]
    return ["millrace", "train", settings["env"], "--preset", "none", "--run-dir", folder, *flags, *until]


def _theirs(contender: str, settings: dict[str, Any], target: float | None) -> list[str]:
    until = [] if target is None else ["--target", str(target)]
    subproc = ["--subproc"] if contender == SUBPROC else []
    return ["benchmarks.ppo_stable_baselines3", json.dumps(settings), *subproc, *until]
