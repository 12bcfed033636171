"""Runs whose workers are on this machine: trained by this process, or by a `millrace train` of their own."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil

from millrace.launch.training import train
from millrace.learner.config.layers import resolve
from tests.system.stage import preloaded

TOY = "tests.support.envs.toy:"
SMALL: dict[str, Any] = {"n_epochs": 2, "eval_episodes": 2}  # for a run that need not learn much


def run(
    tmp_path: Path, env: str = "", watch: Any = lambda progress: None, resume: Path | None = None, **settings: Any
) -> Path:
    """Train in this process, in a new run folder or in one that is resumed. Returns the run folder."""
    run_dir: dict[str, Any] = {} if resume else {"run_dir": str(tmp_path / f"runs{time.monotonic_ns()}")}
    return train(resolve(env, resume=resume, **run_dir, **settings), resume, watch)


def worker_processes() -> list[psutil.Process]:
    """The worker processes of this process."""
    children = psutil.Process().children(recursive=True)
    return [child for child in children if "millrace.workers" in preloaded.command_line(child)]


def start(tmp_path: Path, *flags: str) -> subprocess.Popen[bytes] | preloaded.ForkedProcess:
    """A process that trains on CartPole, with its run folder in tmp_path/runs."""
    command = [sys.executable, "-m", "millrace", "train", "CartPole-v1", "--run-dir", str(tmp_path / "runs"), *flags]
    return preloaded.start(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
