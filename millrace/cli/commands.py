"""All commands of `millrace` and of its extras, in groups, with the function that runs each command.

Rule: a command's module is imported only when the command runs. This makes `--help` fast, and a machine with only a worker's
packages can run the commands that need no other packages. Other packages install commands as entry points of the group
`millrace.commands`. These are read only for `--help`, or if the user types a name that isn't built in.
"""
# ruff: noqa: E501

from __future__ import annotations

from pkgutil import resolve_name
from typing import NamedTuple

from millrace.protocol.errors import MillraceError
from millrace.protocol.own_module import own_callable, own_code_failed

GROUP = "millrace.commands"


class Command(NamedTuple):
    """A command of `millrace`."""

    runs: str
    """`module:function`; the function takes the arguments and returns the exit code"""
    arguments: str
    about: str


# fmt: off
GROUPS = {  # one line for each command
    "Train": {
        "train": Command("millrace.cli.train:train", "ENV [flags]", "train on this machine: a learner and its worker processes"),
        "plan": Command("millrace.cli.plan:run", "ENV [flags]", "step an environment here, and say what to choose and what to expect"),
        "presets": Command("millrace.cli.presets:run", "", "list settings that are known to work"),
    },
    "Train with workers on other machines": {
        "learner": Command("millrace.cli.train:learner", "ENV --bind ADDRESS [flags]", "start a learner alone; workers join it from elsewhere"),
        "worker": Command("millrace.cli.worker:run", "ADDRESS [--token FILE] [flags]", "start workers that join a learner"),
        "keys": Command("millrace.cli.keys:run", "new|show|allow|revoke [NAME]", "say who may join the learners of this machine"),
        "status": Command("millrace.cli.status:run", "ADDRESS|RUN [--watch]", "show a run's workers, their speed, and what was dropped"),
        "launch": Command("millrace.extras.launchers.command:run", "kubernetes|slurm|ray ENV [flags]", "start a learner and workers on a cluster"),
    },
    "Look at runs": {
        "list": Command("millrace.cli.list:list_runs", "[FOLDER]", "list runs: state, return and progress of each"),
        "dashboard": Command("millrace.extras.monitoring.dashboard.command:dashboard", "[RUNS ...]", "show runs in a browser, while they train and afterwards"),
        "evaluate": Command("millrace.cli.play:evaluate", "RUN [--video] [flags]", "play greedy episodes of a run's newest policy"),
        "record": Command("millrace.extras.datasets.command:run", "RUN --out DATASET [flags]", "write its episodes as a Minari dataset"),
        "plot": Command("millrace.extras.monitoring.report.command:plot", "RUN [RUN ...] [--out FILE]", "draw learning curves as SVG or PNG"),
        "report": Command("millrace.extras.monitoring.report.command:report", "RUN [RUN ...] [--out FILE]", "compare runs on one HTML page"),
    },
    "Write a client in another language": {
        "conform": Command("millrace.extras.conformance.command:run", "[flags] -- COMMAND …", "check a client against the wire document, rule by rule"),
    },
    "Measure millrace itself": {
        "bench": Command("millrace.cli.bench:run", "[NAME [flags]]", "run the benchmarks (in a clone of the repository)"),
    },
}
# fmt: on
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}


def installed_commands() -> dict[str, Command]:
    """The commands that other packages install, by name. Imports none of these packages."""
    from importlib import metadata

    return {
        point.name: Command(point.value, "…", f"from {point.dist.name if point.dist is not None else 'another package'}")
        for point in sorted(metadata.entry_points(group=GROUP))
        if point.name not in COMMANDS
    }


def run_command(name: str, argv: list[str]) -> int:
    """Run a built-in command with these arguments. Returns the exit code."""
    code: int = resolve_name(COMMANDS[name].runs)(argv)
    return code


def run_installed(name: str, command: Command, argv: list[str]) -> int:
    """Run a command of another package. Returns the exit code. Raises `UsageError` if anything in that package fails."""
    what = f"command {name} {command.about}"
    function = own_callable(command.runs, what, "mine:run")
    try:
        return int(function(argv) or 0)
    except (MillraceError, BrokenPipeError):
        raise
    except Exception as error:
        raise own_code_failed(what, error) from error
