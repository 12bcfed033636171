"""A plan as text: its command can be pasted, and no line has spaces at its end."""

from __future__ import annotations

import io
import shlex

import pytest
from rich.console import Console

from millrace.cli import plan as plan_command
from millrace.planning.recommendation import ChosenSetting
from millrace.planning.run_plan import ExpectedSpeed, RunPlan, show, train_command
from tests.millrace.planning.made_up import MACHINE, OVERHEADS, measured

ENV = "my_module:MyEnv-v0"
SETTINGS: dict[str, int | str] = {
    "algo": "xqc", "workers": 8, "envs": 8, "lanes": 8, "max_lag": 1, "replay_size": 500_000,
}  # fmt: skip
CHOSEN = tuple(
    ChosenSetting(name, value, "a reason that takes more than one line if a terminal has only eighty columns, as most have")
    for name, value in SETTINGS.items()
)
PLAN = RunPlan(
    env=ENV,
    chosen=CHOSEN,
    expected=(ExpectedSpeed(machines=1, workers=8, envs=8, steps_per_s=100.0, learner_share=0.5, needed_s=1000.0),),
    needed_steps=100_000,
    advice=("one copy, after 21 calls: it raised",),
    command=train_command(ENV, {"port": "{5000 + slot}"}, (), CHOSEN),
    measured=measured(wait_s=0.04),
    overheads=OVERHEADS,
    machine=MACHINE,
)


@pytest.mark.parametrize("columns", [20, 80, 200])
def test_the_command_is_one_line_that_can_be_pasted_however_narrow_the_terminal_is(columns: int) -> None:
    assert len(PLAN.command) > 80
    shown = io.StringIO()
    show(PLAN, Console(file=shown, width=columns, force_terminal=True, color_system=None))
    last = shown.getvalue().splitlines()[-1]
    assert last == f"  {PLAN.command}"
    assert shlex.split(last) == shlex.split(PLAN.command)


def test_in_a_pipe_the_command_is_one_line_and_no_line_has_spaces_at_its_end(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan_command, "plan_of", lambda *arguments, **others: PLAN)
    monkeypatch.setenv("COLUMNS", "80")
    assert plan_command.run([ENV]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == f"  {PLAN.command}"
    assert [line for line in lines if line != line.rstrip()] == []
    assert lines == str(PLAN).splitlines()
