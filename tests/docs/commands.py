"""The `millrace` commands that a page shows, and the parsers of these commands without what the commands do.

Rule: each command is parsed by the parser that the program itself uses. Nothing is started, read or written.
"""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator
from typing import Any, NamedTuple
from unittest import mock

from benchmarks.program import BENCHMARKS
from learner.config.command_line import RunFlags, _none_for_tyro
from learner.config.flag_parser import parse_flags
from learner.config.hyperparameters import HYPERPARAMETERS, AlgorithmConfig
from millrace.cli import conform, flags, keys, status
from millrace.cli.arguments import Arguments
from millrace.cli.commands import COMMANDS
from protocol.errors import UsageError
from tests.docs.pages import Block
from website.commands_page import help_of, lines_of
from workers.__main__ import _parser as worker_parser

SHELL = {"", "bash", "sh", "console", "shell"}
OPERATORS = re.compile(r"^[();<>|&]+$")
PLACEHOLDER = re.compile(r"^(…|\.\.\.|[A-Z_]+)$")
NO_ARGUMENT = re.compile(r"^(…|\.\.\.|\[.*|[A-Za-z.…]+\])$")
LISTED = re.compile(r"^\s*millrace/? {2,}")
"""The folder `millrace` in a list of folders"""
BEFORE = {"nohup", "exec", "time", "nice", "env", "srun"}
"""Words that may stand before a command"""
LAUNCHERS: dict[str, type[flags.LaunchFlags]] = {
    "kubernetes": flags.KubernetesFlags,
    "slurm": flags.SlurmFlags,
    "ray": flags.RayFlags,
}
RECORDS: dict[str, type[Any]] = {
    "evaluate": flags.EvaluateFlags,
    "record": flags.RecordFlags,
    "plot": flags.PlotFlags,
    "report": flags.ReportFlags,
}


class Shown(NamedTuple):
    """A command that a page shows."""

    line: int
    words: tuple[str, ...]
    """after `millrace`"""


class Parsed(Exception):
    """The arguments are right; the command would begin now."""


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
    except (UsageError, argparse.ArgumentError) as error:
        return str(error)
    except SystemExit as stop:
        return f"{name}: its parser ended with {stop.code}"
    except Parsed:
        return ""
    return ""


def _parse(name: str, argv: list[str]) -> None:
    match name:
        case "train" | "learner":
            _parse_run(name, argv)
        case "worker":
            parser = worker_parser("millrace worker")
            parser.exit_on_error = False
            with mock.patch.object(parser, "error", side_effect=lambda message: _refuse(f"worker: {message}")):
                parser.parse_args([word for word in argv if word != "--debug"])
        case "keys" | "status":
            with mock.patch.object(Arguments, "parse", _parse_only):
                (keys.keys if name == "keys" else _status)(argv)
        case "conform":
            with mock.patch.object(Arguments, "parse", _parse_only):
                conform.check(argv, lambda line: None)
        case "launch":
            launcher, *rest = argv or [""]
            if launcher not in LAUNCHERS:
                raise UsageError(f"launch {launcher}: no such launcher")
            separator = rest.index("--") if "--" in rest else len(rest)
            chosen: Any = parse_flags(LAUNCHERS[launcher], rest[:separator], f"launch {launcher}")
            _parse_run("learner", [chosen.env, *rest[separator + 1 :]])
        case "presets":
            if argv:
                raise UsageError(f"presets: unexpected argument {argv[0]}")
        case "bench":
            if argv and argv[0] not in BENCHMARKS:
                raise UsageError(f"bench {argv[0]}: no such benchmark")
        case _:
            parse_flags(RECORDS[name], argv, name)


def _parse_run(command: str, argv: list[str]) -> None:
    """Flags of a run. An algorithm of the user's own has flags that nobody knows here."""
    words = [word for flag in argv for word in flag.split("=", 1)] if any("=" in flag for flag in argv) else argv
    algo = words[words.index("--algo") + 1] if "--algo" in words[:-1] else ""
    algorithm: AlgorithmConfig = HYPERPARAMETERS.get(algo or "ppo", AlgorithmConfig)()
    if algo and algo not in HYPERPARAMETERS and ":" not in algo and not PLACEHOLDER.match(algo):
        raise UsageError(f"{command}: no such algorithm: {algo}")
    default = RunFlags(algo=algo or "ppo", algorithm=algorithm)
    own = ":" in algo or bool(PLACEHOLDER.match(algo or "x"))
    parse_flags(RunFlags, _none_for_tyro(argv, algorithm), command, default, ignore_unknown=own)


def _parse_only(self: Arguments, argv: list[str]) -> argparse.Namespace:
    """In place of `Arguments.parse`: the same checks, and then nothing."""
    values, unknown = self.parse_known_args(argv)
    if unknown:
        _refuse(f"{self.prog}: unexpected {unknown[0]}")
    raise Parsed(values)


def _status(argv: list[str]) -> None:
    import sys

    status.status(argv, sys.stdout)


def _refuse(message: str) -> None:
    raise UsageError(message)


def all_flags() -> set[str]:
    """Every flag of every command, from the help texts."""
    found = {"--version"}
    for name in COMMANDS:
        for line in lines_of(name):
            found |= set(re.findall(r"(?<![\w-])--[a-z][\w-]*", help_of(line)))
    return found
