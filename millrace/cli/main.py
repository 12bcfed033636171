"""The command line: finds the command, runs it, and turns an error into one line and an exit code.

Rule: wrong usage results in one line on stderr and exit code 2. A failed run results in one line, followed by the worker's
traceback if there is one, and exit code 1. Ctrl-C results in exit code 130. millrace's own traceback is shown only with
--debug. If standard error or standard output can't be written, the text is dropped and the run continues.
"""

from __future__ import annotations

import errno
import os
import sys
import traceback
from contextlib import suppress
from pathlib import Path

import millrace
from millrace.cli.commands import COMMANDS, GROUPS, installed_commands, run_command, run_installed
from millrace.learner.run_folder.last_line import last_line
from millrace.learner.run_folder.run_format import is_run_folder
from millrace.learner.standard_streams import prepare_streams, unfailing
from millrace.protocol.bounds import escaped, indented
from millrace.protocol.errors import UsageError, UserFacingError, did_you_mean, usage_error

ABOUT = "Worker processes step copies of a gymnasium environment; one learner trains a policy in PyTorch."
NO_COMMANDS = {"export": "; docs/how-to/policies.md shows how to export a policy, for example as ONNX"}
"""What to do instead of a command that users expect but that doesn't exist."""
INSTALLED_IN = Path(__file__).parents[2]
"""The folder that contains the package `millrace`"""
NOT_IN_WORKERS = {
    "rich",
    "safetensors",
    "threadpoolctl",
    "tomli_w",
    "torch",
}
"""Packages that a learner needs but a worker doesn't. An installation only for workers lacks them."""


def main(argv: list[str] | None = None) -> int:
    """Run the command line. Returns the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    if argv[:1] == ["--debug"]:  # move it behind the command, because every command accepts it
        end = argv.index("--") if "--" in argv else len(argv)
        argv = [*argv[1:end], "--debug", *argv[end:]]
    with suppress(OSError):  # the current folder may have been deleted
        here = Path.cwd()
        if any(map(is_run_folder, (here, *here.parents))):
            sys.path[:] = [entry for entry in sys.path if entry not in ("", str(here))]  # never import from a run folder
        elif str(here) not in sys.path:
            sys.path.insert(_end_of_installed(), str(here))  # so that a user's module is found but hides no installed one
    prepare_streams()
    with unfailing("stderr"):
        return _exit_code(argv)


def _end_of_installed() -> int:
    """The index in `sys.path` after the installed modules, but before the clone from which millrace is installed, if any.

    Besides `millrace`, a clone contains other folders, which must not hide the user's `learner.py` or `tests`.
    """
    if (INSTALLED_IN / "millrace" / "learner").is_symlink() and str(INSTALLED_IN) in sys.path:
        return len(sys.path) - 1 - sys.path[::-1].index(str(INSTALLED_IN))
    return len(sys.path)


def _exit_code(argv: list[str]) -> int:
    """Run the command line and print its error, if any. Returns the exit code."""
    try:
        exit_code = _dispatch(argv)
        sys.stdout.flush()
        return exit_code
    except UserFacingError as error:
        _print_error(last_line("millrace", error))
        if error.detail:
            _print_error(indented(error.detail))
        return _failed(argv, error.exit_code)
    except KeyboardInterrupt as interrupt:
        _print_error(last_line("millrace", interrupt))
        return _failed(argv, 130)
    except BrokenPipeError:  # whatever reads the output, such as `head`, has ended, so print no message
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        if (ours := usage_error(error)) is not None:
            _print_error(f"millrace: {ours}")
            return _failed(argv, ours.exit_code)
        if error.filename is not None or error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
            return _internal_error(argv, error)
        _print_error(f"millrace: standard output: {error.strerror}")  # not about a file: such an error would have a filename
        return _failed(argv, 1)
    except ModuleNotFoundError as error:
        if error.name not in NOT_IN_WORKERS:
            return _internal_error(argv, error)
        _print_error(
            f"millrace: {argv[0]} needs {error.name}, which is not installed: worker, status and keys don't need it; "
            "`pip install -e .` in millrace's clone installs the rest"
        )
        return _failed(argv, 2)
    except Exception as error:
        return _internal_error(argv, error)


def _dispatch(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help"):
        print(_overview())
        return 0
    if argv[0] == "--version":
        print(f"millrace {millrace.__version__}")
        return 0
    name, *rest = argv
    if name in COMMANDS:
        return run_command(name, rest)
    installed = installed_commands()
    if name in installed:
        return run_installed(name, installed[name], rest)
    hint = NO_COMMANDS.get(name) or did_you_mean(name, [*COMMANDS, *installed]) or "; millrace --help lists them"
    raise UsageError(f"unknown command {name}{hint}")


def _overview() -> str:
    """The text of `millrace --help`: the groups of commands, with a line for each command."""
    groups = GROUPS | {"From other packages": installed} if (installed := installed_commands()) else GROUPS
    width = max(len(f"{name} {command.arguments}") for commands in groups.values() for name, command in commands.items())
    lines = ["usage: millrace COMMAND [arguments]", "", ABOUT]
    for title, commands in groups.items():
        lines += ["", f"{title}:"]
        lines += [f"  millrace {f'{name} {one.arguments}':{width}}  {one.about}" for name, one in commands.items()]
    return "\n".join([*lines, "", "millrace COMMAND --help lists the flags; --debug shows tracebacks; --version."])


# ------------------------------------------------------------------------------------------------------------ errors


def _print_error(line: str) -> None:
    print(escaped(line), file=sys.stderr)  # escaped, because it may quote a worker


def _internal_error(argv: list[str], error: Exception) -> int:
    hints = [] if "--debug" in argv else ["--debug shows the traceback"]
    _print_error(last_line("millrace", error, hints))
    return _failed(argv, 1)


def _failed(argv: list[str], exit_code: int) -> int:
    """Print the traceback if --debug was given. Returns the exit code."""
    if "--debug" in argv:
        traceback.print_exc()
    return exit_code
