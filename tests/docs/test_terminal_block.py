"""The table that the tutorial shows is the one that `millrace train` draws on a terminal."""

from __future__ import annotations

import io

from rich.console import Console

from learner.run_folder.progress import Progress
from millrace.terminal import render_block
from tests.docs.pages import blocks, written

PAGE = "docs/tutorial/train.md"
SHOWN = Progress(
    run="runs/CartPole-v1-ppo-s1-20261122-220424", env_steps=29_999, total_steps=30_000, updates=118, wall_s=10.0,
    steps_per_s=2992.0, return_mean=223.5, workers_alive=2, workers_expected=2,
    ledger={"issued": 472, "used": 472, "transitions_received": 29_999, "transitions_used": 29_999},
    stages={"learner_wait": 24.0, "learner_update": 59.0, "learner_other": 7.0, "learner_evaluate": 10.0, "worker_open": 0.0,
            "worker_act": 4.6, "worker_step": 10.6, "worker_wait": 78.8, "worker_evaluate": 6.0},
)  # fmt: skip


def test_the_table_of_the_tutorial_is_the_one_that_is_drawn() -> None:
    console = Console(file=io.StringIO(), width=110)
    console.print(render_block(SHOWN))
    assert isinstance(console.file, io.StringIO)
    drawn = [line.rstrip() for line in console.file.getvalue().splitlines()]
    (shown,) = [block.text.splitlines() for block in blocks(written()[PAGE]) if "worker time" in block.text]
    assert shown[1:] == drawn[1:]
    assert shown[0].split(" 100% ")[1] == drawn[0].split(" 100% ")[1]
