"""`millrace train` and `millrace learner`: run a learner, with worker processes on this machine or elsewhere."""

from __future__ import annotations

from typing import Literal

from millrace.cli.train_output import ShownRun
from millrace.learner.config.command_line import read_config


def train(argv: list[str]) -> int:
    """Train with worker processes on this machine. Returns the exit code."""
    return _train(argv, "train")


def learner(argv: list[str]) -> int:
    """Train with workers that join from elsewhere. Returns the exit code."""
    return _train(argv, "learner")


def _train(argv: list[str], command: Literal["train", "learner"]) -> int:
    config, resume = read_config(command, argv)
    from millrace.launch import training  # takes 0.2 s, so imported only once the flags are valid

    shown = ShownRun(argv, new=None if resume else config, command=command)
    with shown.progress() as watch:
        run = training.train(config, resume, watch, elsewhere=command == "learner")
    return shown.end(run) if training.leads(config) else 0
