"""How progress is shown: not too often, the last one always, and without breaking the run."""

import io
import logging
import os
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, cast

import pytest
from msgspec.structs import replace
from rich.console import Console

from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_folder.sentences import per_second
from millrace.learner.standard_streams import never_fails
from millrace.protocol.logs.notices import log_notice
from millrace.sparkline import ASCII, BLOCKS, COLUMNS, MOST_POINTS, Sparkline
from millrace.terminal import (
    LINE_EVERY_S,
    REDRAW_EVERY_S,
    LiveBlock,
    PlainLines,
    ProgressView,
    RateLimitedView,
    block_rows,
    count_line,
    how_far,
    in_notebook,
    progress_view,
    render_block,
)

PROGRESS = Progress(
    run="runs/CartPole-v1-ppo-s1", env_steps=62_208, total_steps=100_000, updates=243, wall_s=14.8, steps_per_s=4210.3,
    return_mean=231.44, length_mean=231.0, lag_mean=0.5, lag_max=1, workers_alive=1, workers_expected=2,
    ledger={"issued": 976, "used": 970, "lost": 2, "outstanding": 4, "transitions_used": 62_208,
            "messages_bad": 1},
    stages={"learner_wait": 1.0, "learner_update": 3.0, "worker_step": 5.0, "worker_wait": 5.0},
)  # fmt: skip


class RecordingView(ProgressView):
    def __init__(self) -> None:
        self.shown: list[int] = []
        self.lines: list[str] = []

    def show(self, progress: Progress) -> None:
        self.shown.append(progress.env_steps)

    def print_line(self, line: str) -> None:
        self.lines.append(line)

    def close(self) -> None:
        pass


def test_the_first_progress_is_shown_at_once_then_a_few_and_the_last_always() -> None:
    now = [0.0]
    view = RecordingView()
    limited = RateLimitedView(view, 5.0, lambda: now[0])
    for steps in range(1, 13):
        limited(Progress(env_steps=steps))
        now[0] += 1.0
    assert view.shown == [1, 6, 11]
    limited.close()
    assert view.shown == [1, 6, 11, 12]
    limited.close()
    assert view.shown == [1, 6, 11, 12]


def test_a_note_is_printed_once_and_at_once() -> None:
    view = RecordingView()
    limited = RateLimitedView(view, 5.0, lambda: 0.0)
    for note in ("", "greedy return 9.0", "greedy return 9.0", "", "greedy return 9.0"):
        limited(Progress(note=note))
    assert view.lines == ["greedy return 9.0", "greedy return 9.0"]


def test_a_plain_line_has_the_main_figures(capsys: pytest.CaptureFixture[str]) -> None:
    PlainLines().show(PROGRESS)
    assert capsys.readouterr().out == (
        "62,208 of 100,000 env steps | 4,210 steps/s | return 231.4 | lag 0.5, largest 1 | workers 1 of 2 | update 243\n"
    )


def test_before_the_first_update_it_counts_what_workers_have_made(capsys: pytest.CaptureFixture[str]) -> None:
    """One env step takes a second, and the first update is minutes away."""
    first = "waiting 23 s for lanes 0, 2 (worker w0 on vm: 1.0 steps/s) and 2 more; first rollouts: 45 of 512 env steps"
    progress = Progress(
        total_steps=5_000, collected=50, wall_s=25.0, steps_per_s=2.0, workers_alive=2, workers_expected=2, waiting=first
    )
    PlainLines().show(progress)
    shown = "50 of 5,000 env steps | 2 steps/s | return none yet | workers 2 of 2 | update 0 | The learner has been "
    assert capsys.readouterr().out == f"{shown}{first}.\n"
    assert how_far(progress) == (0.01, "1%  0:25, 41:15 left")
    assert block_rows(progress, Sparkline())["env steps"] == "50 of 5,000   2 a second   update 0"


@pytest.mark.parametrize(
    ("steps", "text"), [(0.0, "0"), (0.05, "0.05"), (1.94, "1.9"), (9.94, "9.9"), (9.96, "10"), (4210.3, "4,210")]
)
def test_a_slow_simulator_does_not_look_dead(steps: float, text: str) -> None:
    assert per_second(steps) == text


SLOWEST = "Updates are the slowest part: the learner updates for 75% of the time, and workers wait for 50%."
LOST = "2 rollouts were lost and dealt again, 1 message could not be read"
WAITING = (
    "waiting 12 s for lane 3 (worker cpu2-w1 on cpu2: in reset for 11 s); so far 71% waiting for rollouts, 29% learning"
)


def test_a_plain_line_says_who_waits_and_the_last_one_the_slowest_part(capsys: pytest.CaptureFixture[str]) -> None:
    PlainLines().show(replace(PROGRESS, waiting=WAITING))
    assert capsys.readouterr().out.endswith(f" | update 243 | The learner has been {WAITING}.\n")
    PlainLines().show(replace(PROGRESS, waiting=WAITING, stop_reason="all steps done"))  # nobody waits any more
    assert capsys.readouterr().out.endswith(f" | update 243 | {SLOWEST} | {LOST}\n")


def drawn(progress: Progress, width: int = 120, returns: Sparkline | None = None) -> list[str]:
    console = Console(file=io.StringIO(), width=width, force_terminal=True, color_system=None)
    console.print(render_block(progress, returns or Sparkline()))
    assert isinstance(console.file, io.StringIO)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


def test_the_block_has_everything() -> None:
    returns = Sparkline()
    for steps, mean in enumerate((9.0, 20.0, 20.0, 80.0)):
        returns.add(steps, mean)
    lines = drawn(replace(PROGRESS, best=(240.0, 50_000)), 120, returns)
    assert lines[0].endswith(" 62%  0:15, 0:09 left")
    assert lines[1:] == [
        "env steps  62,208 of 100,000   4,210 a second   update 243",
        "return     231.4   ▁▂▂▇   best evaluation 240.0 at 50,000 env steps",
        "workers    1 of 2   lag 0.5, largest 1",
        f"time       {SLOWEST}",
        f"lost       {LOST}",
        "run        runs/CartPole-v1-ppo-s1",
    ]


@pytest.mark.parametrize(
    ("ended", "head"),
    [
        ({"stop_reason": "all steps done"}, " 100%  done in 0:15"),
        ({"stop_reason": "target return 475 reached"}, "Finished after 0:15: target return 475 reached"),
        ({"stop_reason": "interrupted", "cut_short": True}, "Interrupted after 0:15"),
    ],
)
def test_a_run_that_ended_is_done_or_says_why_and_no_percentage(ended: dict[str, Any], head: str) -> None:
    lines = drawn(replace(PROGRESS, env_steps=99_999, waiting=WAITING, **ended))
    assert lines[0].endswith(head)
    assert lines[0] == head or head.startswith(" 100%")
    assert lines[4] == f"time       {SLOWEST}", "nobody waits any more"


def test_who_waits_for_whom_is_a_row_whose_first_line_has_the_main_thing() -> None:
    said = f"The learner has been {WAITING}."
    for width, first in ((160, said), (80, said.partition(" in reset")[0]), (40, "The learner has been waiting")):
        lines = drawn(replace(PROGRESS, waiting=WAITING), width)
        (row,) = [line for line in lines if line.startswith("time ")]
        assert row.removeprefix("time ").strip() == first
        assert said in " ".join(" ".join(lines).split()), "nothing is cut off"


def test_lines_without_an_update_come_ever_less_often() -> None:
    now = [0.0]
    view = RecordingView()
    limited = RateLimitedView(view, LINE_EVERY_S, lambda: now[0])
    while now[0] < 200.0:
        limited(Progress(env_steps=int(now[0]), updates=int(now[0] >= 150.0)))
        now[0] += 1.0
    assert view.shown == [0, 5, 10, 20, 40, 80, 150, 155, 160, 170, 190]


def test_a_block_that_is_redrawn_is_not_slowed_by_a_long_wait() -> None:
    now = [1_000.0]
    view = RecordingView()
    limited = RateLimitedView(view, REDRAW_EVERY_S, lambda: now[0])
    for steps in range(5):
        limited(Progress(env_steps=steps))
        now[0] += 1.0
    assert view.shown == [0, 1, 2, 3, 4]


def test_an_empty_progress_is_shown_too() -> None:
    assert block_rows(Progress(), Sparkline()) == {
        "env steps": "0   0 a second   update 0", "return": "none yet", "workers": "0",
    }  # fmt: skip
    assert drawn(Progress())[0].endswith(" 0%  0:00")


def test_the_live_block_redraws_and_restores_the_terminal() -> None:
    console = Console(file=io.StringIO(), width=100, force_terminal=True)
    view = LiveBlock(console)
    view.show(Progress(env_steps=1, total_steps=10))
    view.print_line("a [line] that stays")
    view.show(Progress(env_steps=7, total_steps=10))
    view.close()
    assert isinstance(console.file, io.StringIO)
    shown = console.file.getvalue()
    assert "a [line] that stays" in shown
    assert shown.rindex("7 of 10 ") > shown.rindex("1 of 10 ")
    assert shown.count("\x1b[?25l") == shown.count("\x1b[?25h") == 1  # the cursor comes back


def test_the_terminal_can_write_ctrl_c_behind_every_line_of_the_block() -> None:
    """It wrote it on the next line, and the last redraw left a line with a percentage."""
    console = Console(file=io.StringIO(), width=60, force_terminal=True, color_system=None)
    view = LiveBlock(console)
    view.show(replace(PROGRESS, waiting=WAITING, run="r" * 200))
    view.close()
    assert isinstance(console.file, io.StringIO)
    lines = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", console.file.getvalue()).splitlines()
    assert max(map(len, lines)) == 58


def test_warnings_of_the_log_are_shown_meanwhile(capsys: pytest.CaptureFixture[str]) -> None:
    logger = logging.getLogger("millrace.learner")
    with progress_view() as watch:
        watch(Progress(total_steps=5))
        logger.warning("worker w1 is gone")
        log_notice(logger, "waiting for workers")
        logger.info("not so important")
    out = capsys.readouterr().out
    assert "waiting for workers" in out.splitlines(), "a notice is shown, and is no warning"
    assert "0 of 5 env steps" in out
    assert "warning: worker w1 is gone" in out
    assert "not so important" not in out
    assert logger.parent is not None
    assert not logger.parent.handlers


def test_a_reader_that_has_gone_does_not_end_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as pipe:
        monkeypatch.setattr("sys.stdout", never_fails(pipe))
        for _ in range(3):
            PlainLines().show(PROGRESS)
        monkeypatch.undo()


HOSTILE = Progress(run="runs/[/red]\x1b[7777m", waiting="learning [bold]\x1b[7777m", note="[/x]\x1b[7777m")


def test_no_text_is_read_as_markup_or_controls_the_terminal() -> None:
    """Text with [/red] ended the learner: rich raised MarkupError."""
    file = io.StringIO()
    view = LiveBlock(Console(file=file, force_terminal=True, width=100))
    view.show(HOSTILE)
    view.print_line("warning: [/red] \x1b[7777m\ud800")
    view.close()
    shown = file.getvalue()
    assert "The learner has been learning [bold]\\x1b[7777m." in shown
    assert "warning: [/red] \\x1b[7777m\\ud800" in shown
    assert "\x1b[7777m" not in shown


def test_a_plain_line_holds_no_control_characters(capsys: pytest.CaptureFixture[str]) -> None:
    PlainLines().print_line("\x1b[7777m\ud800")
    assert capsys.readouterr().out == "\\x1b[7777m\\ud800\n"


class Handle:
    """A display of a notebook that remembers what it showed."""

    def __init__(self, shown: list[tuple[str, dict[str, str]]]) -> None:
        self._shown = shown

    def update(self, content: dict[str, str], *, raw: bool) -> None:
        self._shown.append(("update", content))


@pytest.fixture
def notebook(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, dict[str, str]]]:
    """What is displayed, as if this were the kernel of a notebook."""
    shown: list[tuple[str, dict[str, str]]] = []

    def display(content: dict[str, str], *, raw: bool, display_id: bool) -> Handle:
        shown.append(("display", content))
        return Handle(shown)

    ipython = SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=object()))
    monkeypatch.setitem(sys.modules, "IPython", cast(ModuleType, ipython))
    monkeypatch.setitem(sys.modules, "IPython.display", cast(ModuleType, SimpleNamespace(display=display)))
    return shown


def test_a_notebook_is_found_by_its_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not in_notebook()
    on_a_terminal = SimpleNamespace(get_ipython=lambda: SimpleNamespace())
    monkeypatch.setitem(sys.modules, "IPython", cast(ModuleType, on_a_terminal))
    assert not in_notebook()
    imported_only = SimpleNamespace(get_ipython=lambda: None)
    monkeypatch.setitem(sys.modules, "IPython", cast(ModuleType, imported_only))
    assert not in_notebook()


def test_a_notebook_gets_one_display_that_is_updated(notebook: Any, capsys: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    with progress_view(clock=lambda: now[0]) as show:
        for steps in range(100, 1_100, 100):
            show(Progress(env_steps=steps, total_steps=1_000, run="runs/<b>"))
            now[0] += 0.25
    assert [how for how, _ in notebook] == ["display"] + ["update"] * 5
    assert [content["text/plain"].partition(" ")[0] for _, content in notebook] == [
        "100",
        "300",
        "500",
        "700",
        "900",
        "1,000",
    ]
    html = notebook[-1][1]["text/html"]
    assert "<progress max='1000' value='1000'" in html
    assert "runs/&lt;b&gt;" in html
    assert capsys.readouterr().out == ""


def test_notes_and_warnings_are_printed_in_a_notebook(notebook: Any, capsys: pytest.CaptureFixture[str]) -> None:
    with progress_view() as show:
        show(Progress(note="greedy return 9.0"))
        logging.getLogger("millrace.learner").warning("a worker was lost")
    assert capsys.readouterr().out == "greedy return 9.0\nwarning: a worker was lost\n"


def test_a_count_in_a_notebook_is_updated_and_then_cleared(notebook: Any, capsys: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    with count_line("evaluating", clock=lambda: now[0]) as show:
        for played in range(3):
            now[0] += 1.0
            show(f"{played} of 3 episodes")
    texts = [content["text/plain"] for _, content in notebook]
    assert texts == ["evaluating: 0 of 3 episodes", "evaluating: 1 of 3 episodes", "evaluating: 2 of 3 episodes", ""]
    assert capsys.readouterr() == ("", "")


def test_an_output_that_takes_nothing_does_not_end_a_program_s_run(monkeypatch: pytest.MonkeyPatch) -> None:
    closed = io.StringIO()
    closed.close()
    monkeypatch.setattr(sys, "stdout", closed)
    with progress_view(may_fail=False) as show:
        show(PROGRESS)
        show(replace(PROGRESS, note="greedy return 9.0"))


def test_a_curve_is_a_line_of_blocks_over_the_run_so_far() -> None:
    line = Sparkline()
    line.add(0, None)
    line.add(1, 5.0)
    assert str(line) == ""
    line.add(2, 5.0)
    assert str(line) == "▁▁", "a constant"
    for x in range(3, 10 * MOST_POINTS):
        line.add(x, float(x))
    assert (len(str(line)), str(line)[0], str(line)[-1]) == (COLUMNS, "▁", "▇")
    assert sorted(str(line)) == sorted(str(line), key=BLOCKS.index) == [*str(line)]
    assert len(line._points) <= MOST_POINTS


def test_where_the_encoding_has_no_blocks_the_curve_is_ascii() -> None:
    file = io.TextIOWrapper(io.BytesIO(), "ascii", "backslashreplace")
    view = LiveBlock(Console(file=file, force_terminal=True, width=100, color_system=None))
    for steps in (1, 2):
        view.show(Progress(env_steps=steps, total_steps=3, return_mean=float(steps)))
    view.close()
    file.flush()
    assert isinstance(file.buffer, io.BytesIO)
    shown = file.buffer.getvalue().decode()
    assert f"2.0   {ASCII[0]}{ASCII[-1]}" in shown
    assert "\\u" not in shown
