"""The name of the program as the user's shell finds it, in the lines that say what to type."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from millrace.cli.train_output import next_commands
from millrace.flags.program_name import typed_name


def program(path: Path) -> Path:
    path.parent.mkdir(parents=True)
    path.write_text("#!/bin/sh\n")
    path.chmod(0o755)
    return path


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The installed program, below the folder in which the user is."""
    monkeypatch.chdir(tmp_path)
    return program(tmp_path / ".venv" / "bin" / "millrace")


def test_it_is_the_plain_name_where_the_shell_finds_it(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(script.parent))
    monkeypatch.setattr(sys, "argv", [str(script), "train"])
    assert typed_name() == "millrace"


def test_it_is_what_was_typed_where_the_environment_is_not_active(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setattr(sys, "argv", [".venv/bin/millrace", "train"])
    assert typed_name() == ".venv/bin/millrace"
    assert next_commands(Path("runs/a"), None, "train")[1] == "  .venv/bin/millrace dashboard runs/a"
    monkeypatch.setattr(sys, "argv", ["/my envs/bin/millrace"])
    assert typed_name() == "'/my envs/bin/millrace'"


def test_another_program_of_that_name_is_not_taken_for_it(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = program(script.parent.parent / "other" / "millrace")
    monkeypatch.setenv("PATH", str(other.parent))
    monkeypatch.setattr(sys, "argv", [".venv/bin/millrace", "train"])
    assert typed_name() == ".venv/bin/millrace"


def test_a_module_is_run_by_the_same_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    python = program(tmp_path / "bin" / "python")
    monkeypatch.setattr(sys, "argv", ["/clone/millrace/__main__.py", "train"])
    monkeypatch.setattr(sys, "executable", str(python))
    monkeypatch.setenv("PATH", "/nowhere")
    assert typed_name() == f"{python} -m millrace"
    monkeypatch.setenv("PATH", str(python.parent))
    assert typed_name() == "python -m millrace"


def test_in_a_program_of_the_user_it_is_the_plain_name(monkeypatch: pytest.MonkeyPatch) -> None:
    for argv in (["my_experiment.py"], [""], []):
        monkeypatch.setattr(sys, "argv", argv)
        assert typed_name() == "millrace"
