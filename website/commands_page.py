"""Makes reference/commands.md: the help of every command, from the commands themselves."""

from __future__ import annotations

import contextlib
import io
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

from millrace.cli.commands import COMMANDS, GROUPS
from millrace.cli.keys import SUBCOMMANDS
from millrace.cli.main import main
from millrace.extras.launchers.command import LAUNCHERS
from millrace.learner.config.hyperparameters import HYPERPARAMETERS

HEAD = """# Commands

What `millrace COMMAND --help` prints, for every command.
[Commands](../how-to/commands.md) shows how they are used. [Settings](settings.md) has a table of the settings of a run.

"""
ROOT = Path(__file__).parent.parent
COLUMNS = "100"
ESCAPE = re.compile(r"\x1b\[[0-9;]*m")
SHORT = "`millrace learner` has the flags of [`millrace train`](#millrace-train)."


def page() -> str:
    """The page as Markdown."""
    parts = [HEAD, _block("")]
    for title, commands in GROUPS.items():
        parts.append(f"\n## {title}\n")
        for name in commands:
            parts.append(f"\n### millrace {name}\n\n{_sentence(COMMANDS[name].about)}\n\n")
            parts += [SHORT + "\n"] if name == "learner" else [_block(line) for line in lines_of(name)]
    return "".join(parts)


def lines_of(name: str) -> list[str]:
    """The command lines whose help the page shows for a command: one for each subcommand, if there are any."""
    match name:
        case "launch":
            return [name, *(f"launch {launcher}" for launcher in LAUNCHERS)]
        case "keys":
            return [name, *(f"keys {each}" for each in SUBCOMMANDS)]
        case "train":
            return [name, *(f"train --algo {algo}" for algo in HYPERPARAMETERS if algo != "ppo")]
        case _:
            return [name]


@cache
def help_of(line: str) -> str:
    """The output of `millrace LINE --help` in a terminal with 100 columns, without colors."""
    if line == "bench":  # it starts a process of its own, whose output can't be redirected here
        command = [sys.executable, "-m", "millrace", "bench", "--help"]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True).stdout.rstrip()
    printed = io.StringIO()
    width = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = COLUMNS
    try:
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            main([*line.split(), "--help"])
    finally:
        os.environ.pop("COLUMNS") if width is None else os.environ.update(COLUMNS=width)
    return "\n".join(row.rstrip() for row in ESCAPE.sub("", printed.getvalue()).splitlines())


def _block(line: str) -> str:
    text = help_of(line)
    if line.startswith("train --algo"):
        algo = line.split()[-1]
        found = re.search(rf"^{algo}:\n.*?(?=\n\n)", text, re.DOTALL | re.MULTILINE)
        if found is None:
            raise ValueError(f"commands page: millrace {line} --help: expected a section of its flags, got none")
        text = f"…\n\n{found[0]}\n\n…"
    return f"```text\n$ millrace {line} --help\n{text}\n```\n\n".replace("  --help", " --help")


def _sentence(about: str) -> str:
    return f"{about[0].upper()}{about[1:]}."
