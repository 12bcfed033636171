"""The `millrace` commands that a page shows, and the parsers of these commands without what the commands do.

Rule: each command is parsed by the parser that the program itself uses. Nothing is started, read or written.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from typing import Any, NamedTuple

from benchmarks.program import BENCHMARKS
from millrace import play_flags
from millrace.cli import keys, plan, presets, status
from millrace.cli.commands import COMMANDS
from millrace.cli.list import ListFlags
from millrace.extras.conformance.command import ConformFlags
from millrace.extras.launchers.command import LAUNCHERS
from millrace.extras.monitoring.dashboard.command import DashboardFlags
from millrace.extras.monitoring.report.command import PlotFlags, ReportFlags
from millrace.flags.fields import fields_of
from millrace.flags.parse import cut_at_dashes, first_words, given_values, parse_flags, typed_flags
from millrace.learner.config.command_line import RunFlags
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.protocol.errors import UsageError
from millrace.workers.flags import WorkerFlags
from tests.docs.pages import Block
from website.commands_page import help_of, lines_of

SHELL = {"", "bash", "sh", "console", "shell"}
OPERATORS = re.compile(r"^[();<>|&]+$")
PLACEHOLDER = re.compile(r"^(…|\.\.\.|[A-Z_]+)$")
NO_ARGUMENT = re.compile(r"^(…|\.\.\.|\[.*|[A-Za-z.…]+\])$")
LISTED = re.compile(r"^\s*millrace/? {2,}")
"""The folder `millrace` in a list of folders"""
BEFORE = {"nohup", "exec", "time", "nice", "env", "srun"}
"""Words that may stand before a command"""
RECORDS: dict[str, type[Any]] = {
    "evaluate": play_flags.EvaluateFlags,
    "record": play_flags.RecordFlags,
    "list": ListFlags,
    "dashboard": DashboardFlags,
    "plot": PlotFlags,
    "report": ReportFlags,
    "status": status.StatusFlags,
    "conform": ConformFlags,
    "plan": plan.PlanFlags,
    "presets": presets.PresetsFlags,
    "worker": WorkerFlags,
}


class Shown(NamedTuple):
    """A command that a page shows."""

    line: int
    words: tuple[str, ...]
    """after `millrace`"""


def shown_in(block: Block) -> Iterator[Shown]:
    """The commands of a block. A line that ends with a backslash goes on in the next one."""
    if block.language not in SHELL:
        return
    text = re.sub(r"\\\n", "  ", block.text)
    number = block.line
    for line in text.split("\n"):
        if block.language or not LISTED.match(line):
            for words in _commands(line.strip().removeprefix("$ ")):
                yield Shown(number, words)
        number += 1


def _commands(line: str) -> Iterator[tuple[str, ...]]:
    """What stands after `millrace` in each command of a line of shell."""
    line = re.sub(r"(?<=\w)(\|\w+)+", "", line)  # one of several words, as in new|show
    line = re.sub(r"(?<=\s)\d>", ">", re.sub(r"\$\{?\w+\}?", "1", line))  # variables; redirections of a numbered stream
    lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
    lexer.commenters = "#"
    lexer.whitespace_split = True
    try:
        words = list(lexer)
    except ValueError:  # a quotation mark alone: text, not shell
        return
    command: list[str] | None = None
    may_begin = True
    for word in [*words, ";"]:
        if OPERATORS.match(word):
            if command:
                yield tuple(command)
            command, may_begin = None, True
        elif command is not None:
            command.append(word)
        elif may_begin and (word == "millrace" or word.endswith("bin/millrace")):
            command = []
        else:
            may_begin = may_begin and (word in BEFORE or "=" in word)


def mistake(words: tuple[str, ...]) -> str:
    """What is wrong with a command, in one line; empty if nothing is."""
    name, *rest = words
    if name.startswith("-") or PLACEHOLDER.match(name):
        return "" if name in ("--help", "-h", "--version") or not name.startswith("-") else f"no such flag: {name}"
    if name not in COMMANDS:
        return f"no such command: {name}"
    if "--help" in rest or "-h" in rest:
        rest = [word for word in rest if word not in ("--help", "-h")]
        return "" if not rest or rest[0] == "--algo" else mistake((name, *rest)) if name not in ("keys", "launch") else ""
    try:
        _parse(name, [word for word in rest if not NO_ARGUMENT.match(word)])
    except UsageError as error:
        return str(error)
    return ""


def _parse(name: str, argv: list[str]) -> None:
    match name:
        case "train" | "learner":
            _parse_run(name, argv)
        case "keys":
            subcommand, *rest = argv or [""]
            if subcommand not in keys.SUBCOMMANDS:
                raise UsageError(f"keys {subcommand}: no such command")
            parse_flags(keys.SUBCOMMANDS[subcommand], rest, f"keys {subcommand}")
        case "launch":
            launcher, *rest = argv or [""]
            if launcher not in LAUNCHERS:
                raise UsageError(f"launch {launcher}: no such launcher")
            own, learner = cut_at_dashes(rest)
            chosen: Any = parse_flags(LAUNCHERS[launcher], own, f"launch {launcher}")
            _parse_run("learner", [chosen.env, *learner])
        case "bench":
            if argv and argv[0] not in BENCHMARKS:
                raise UsageError(f"bench {argv[0]}: no such benchmark")
        case _:
            parse_flags(RECORDS[name], cut_at_dashes(argv)[0], name)


def _parse_run(command: str, argv: list[str]) -> None:
    """Flags of a run. An algorithm of the user's own has flags that nobody knows here."""
    typed = typed_flags(argv)
    algo = first_words(typed, "algo").get("algo", "ppo")
    if algo in HYPERPARAMETERS:
        given_values(fields_of(RunFlags) | fields_of(HYPERPARAMETERS[algo]), typed, command)
    elif ":" not in algo and not PLACEHOLDER.match(algo):
        raise UsageError(f"{command}: no such algorithm: {algo}")


def all_flags() -> set[str]:
    """Every flag of every command, from the help texts."""
    found = {"--version"}
    for name in COMMANDS:
        for line in lines_of(name):
            found |= set(re.findall(r"(?<![\w-])--[a-z][\w-]*", help_of(line)))
    return found
