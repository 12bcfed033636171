"""docs/results.md is what `benchmarks/results.py` writes: its text is that of the program, and its commands parse."""

from __future__ import annotations

import re
import shlex

import pytest

from benchmarks.results import HEAD, OUT, TAIL
from millrace.cli.main import main

TEXT = OUT.read_text()
COMMANDS = re.findall(r"`millrace (train .+?)` \|$", TEXT, re.MULTILINE)


def test_the_page_has_the_text_of_the_program() -> None:
    before, after = TAIL.split("{versions}")
    assert TEXT.startswith(HEAD)
    assert before in TEXT
    assert TEXT.endswith(after)


def test_each_row_names_its_command() -> None:
    table = TEXT.removeprefix(HEAD).partition("\n\n")[0].splitlines()
    assert len(table) == len(COMMANDS) > 0


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_parses(command: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main([*shlex.split(command.replace("--seed S", "--seed 1")), "--steps", "none_of_this"]) == 2
    assert "steps" in capfd.readouterr().err  # nothing else is wrong with it
