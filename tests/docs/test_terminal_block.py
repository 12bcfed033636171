"""The table that the tutorial shows is the one that `millrace train` draws on a terminal."""

from __future__ import annotations

import io

from rich.console import Console

from millrace.learner.run_folder.progress import Progress
from millrace.sparkline import Sparkline
from millrace.terminal import render_block
from tests.docs.pages import blocks, written

PAGE = "docs/tutorial/train.md"
SHOWN = Progress(
    run="runs/CartPole-v1-ppo-s1-20261126-185403", env_steps=29_996, total_steps=30_000, updates=118, wall_s=15.9,
    steps_per_s=1888.0, return_mean=206.8, workers_alive=2, workers_expected=2, stop_reason="all steps done",
    ledger={"issued": 472, "used": 472, "transitions_received": 29_996, "transitions_used": 29_996}, best=(500.0, 29_996),
    stages={"learner_wait": 2.2, "learner_update": 12.1, "learner_other": 1.2, "learner_evaluate": 1.8, "worker_open": 0.0,
            "worker_act": 1.1, "worker_step": 2.2, "worker_wait": 24.8, "worker_evaluate": 2.6},
)  # fmt: skip
HEIGHTS = (0, 0, 1, 1, 1, 2, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4)  # of the curve of returns


def test_the_table_of_the_tutorial_is_the_one_that_is_drawn() -> None:
    console, returns = Console(file=io.StringIO(), width=110), Sparkline()
    for number, height in enumerate(HEIGHTS):
        returns.add(number, height)
    console.print(render_block(SHOWN, returns))
    assert isinstance(console.file, io.StringIO)
    drawn = [line.rstrip() for line in console.file.getvalue().splitlines()]
    (shown,) = [block.text.splitlines() for block in blocks(written()[PAGE]) if "run        runs/" in block.text]
    assert shown[1:] == drawn[1:]
    assert shown[0].split(" 100%  ")[1] == drawn[0].split(" 100%  ")[1]
