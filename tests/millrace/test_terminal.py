"""What a run looks like: never too often, the last state always, and nothing that breaks the run."""

import io
import logging
import os
from pathlib import Path

import pytest
from rich.console import Console

from learner.run_folder.progress import Progress
from millrace.terminal import Block, Lines, Pace, block, details, watching

PROGRESS = Progress(
    run="runs/CartPole-v1-ppo-s1", env_steps=62_208, total_steps=100_000, updates=243, wall_s=14.8, steps_per_s=4210.3,
    return_mean=231.44, length_mean=231.0, lag_mean=0.5, lag_max=1, workers_alive=1, workers_expected=2,
    ledger={"issued": 976, "used": 970, "stale": 2, "lost": 0, "outstanding": 4, "transitions_used": 62_208,
            "messages_bad": 1},
    stages={"learner_wait": 1.0, "learner_update": 3.0, "worker_step": 5.0},
)  # fmt: skip


class Seen:
    def __init__(self) -> None:
        self.shown: list[int] = []
        self.said: list[str] = []

    def show(self, progress: Progress) -> None:
        self.shown.append(progress.env_steps)

    def say(self, line: str) -> None:
        self.said.append(line)

    def close(self) -> None:
        pass


def test_the_first_at_once_then_now_and_then_and_the_last_always() -> None:
    now = [0.0]
    seen = Seen()
    pace = Pace(seen, 5.0, lambda: now[0])
    for steps in range(1, 13):
        pace(Progress(env_steps=steps))
        now[0] += 1.0
    assert seen.shown == [1, 6, 11]
    pace.close()
    assert seen.shown == [1, 6, 11, 12]
    pace.close()
    assert seen.shown == [1, 6, 11, 12]


def test_a_note_is_said_once_and_at_once() -> None:
    seen = Seen()
    pace = Pace(seen, 5.0, lambda: 0.0)
    for note in ("", "greedy return 9.0", "greedy return 9.0", "", "greedy return 9.0"):
        pace(Progress(note=note))
    assert seen.said == ["greedy return 9.0", "greedy return 9.0"]


def test_a_plain_line_says_what_matters(capsys: pytest.CaptureFixture[str]) -> None:
    Lines().show(PROGRESS)
    assert capsys.readouterr().out == (
        "62,208 of 100,000 env steps | 4,210 steps/s | return 231.4 | lag 0.5 (max 1) | workers 1 of 2 | update 243\n"
    )


def test_the_block_has_everything() -> None:
    console = Console(file=io.StringIO(), width=100, force_terminal=True, color_system=None)
    console.print(block(PROGRESS))
    assert isinstance(console.file, io.StringIO)
    lines = [line.rstrip() for line in console.file.getvalue().splitlines()]
    assert lines[0].endswith("62% 62,208 of 100,000 env steps 0:15, 0:09 left")
    assert lines[1:] == [
        "4,210 steps/s   return 231.4   lag 0.5 (max 1)   workers 1 of 2   update 243",
        "learner time  wait 25% · update 75%",
        "worker time   step 100%",
        "tickets       issued 976 · used 970 · stale 2 · outstanding 4",
        "transitions   used 62,208",
        "messages      bad 1",
        "run           runs/CartPole-v1-ppo-s1",
    ]


def test_an_empty_progress_is_shown_too() -> None:
    assert details(Progress()) == {"run": ""}
    Console(file=io.StringIO()).print(block(Progress()))


def test_the_live_block_redraws_and_lets_go_of_the_terminal() -> None:
    console = Console(file=io.StringIO(), width=100, force_terminal=True)
    screen = Block(console)
    screen.show(Progress(env_steps=1, total_steps=10))
    screen.say("a [line] that stays")
    screen.show(Progress(env_steps=7, total_steps=10))
    screen.close()
    assert isinstance(console.file, io.StringIO)
    drawn = console.file.getvalue()
    assert "a [line] that stays" in drawn
    assert drawn.rindex("7 of 10 env steps") > drawn.rindex("1 of 10 env steps")
    assert drawn.count("\x1b[?25l") == drawn.count("\x1b[?25h") == 1  # the cursor comes back


def test_the_log_is_shown_while_a_run_is_watched(capsys: pytest.CaptureFixture[str]) -> None:
    logger = logging.getLogger("millrace.learner")
    with watching() as watch:
        watch(Progress(total_steps=5))
        logger.warning("worker w1 is gone")
        logger.info("not so important")
    out = capsys.readouterr().out
    assert "0 of 5 env steps" in out
    assert "warning: worker w1 is gone" in out
    assert "not so important" not in out
    assert logger.parent is not None
    assert not logger.parent.handlers


def test_a_reader_that_goes_away_does_not_end_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as pipe:
        monkeypatch.setattr("sys.stdout", pipe)
        for _ in range(3):
            Lines().show(PROGRESS)
        monkeypatch.undo()
