"""The command line: finds the command, runs it, and turns an error into one line and an exit code.

Rule: bad usage is one line on stderr and exit code 2. A run that failed is one line (and the worker's traceback below it,
if there is one) and exit code 1. Ctrl-C is exit code 130. A traceback of millrace itself is shown with --debug only. A run
goes on if standard error or standard output cannot be written; that text is dropped. Each command imports what it needs
when it runs, so that `--help` answers at once.
"""

from __future__ import annotations

import errno
import logging
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from learner.run_folder.last_line import last_line
from learner.run_folder.run_format import is_run_folder
from learner.standard_streams import prepare_streams, unfailing
from protocol.bounds import escaped, indented
from protocol.errors import UsageError, UserFacingError, did_you_mean, usage_error
from protocol.logs.notices import log_notice

if TYPE_CHECKING:
    from learner.callbacks.callbacks import Watch
    from learner.config.config import Config
    from learner.run_folder.progress import Progress

log = logging.getLogger("millrace.learner")

ABOUT = "Worker processes step copies of a gymnasium environment; one learner trains a policy in PyTorch."
HELP_FLAGS = ("-h", "--help")
NOT_IN_WORKERS = {
    "matplotlib",
    "prometheus_client",
    "rich",
    "safetensors",
    "tensorboard",
    "threadpoolctl",
    "tomli_w",
    "torch",
    "tyro",
}
"""Packages that the learner needs and a worker does not. An installation only for workers lacks them."""


class Command(NamedTuple):
    """A command of `millrace`."""

    run: Callable[[list[str]], int]
    arguments: str
    about: str


def main(argv: list[str] | None = None) -> int:
    """Run the command line. Returns the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    with suppress(OSError):  # the current folder may have been deleted
        here = Path.cwd()
        if any(map(is_run_folder, (here, *here.parents))):
            sys.path[:] = [entry for entry in sys.path if entry not in ("", str(here))]  # nothing is imported from there
        elif str(here) not in sys.path:
            sys.path.append(str(here))  # last, so that a user's module is found but hides no installed module
    prepare_streams()
    with unfailing("stderr"):
        return _exit_code(argv)


def _exit_code(argv: list[str]) -> int:
    """Run the command line and print its error, if there is one."""
    try:
        exit_code = _dispatch(argv)
        sys.stdout.flush()
        return exit_code
    except UserFacingError as error:
        _print_error(last_line("millrace", error, _resumes(argv)))
        if error.detail:
            _print_error(indented(error.detail))
        return _failed(argv, error.exit_code)
    except KeyboardInterrupt as interrupt:
        _print_error(last_line("millrace", interrupt, _resumes(argv)))
        return _failed(argv, 130)
    except BrokenPipeError:  # nobody reads our output any more (`| head`), so a message is useless
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        if (ours := usage_error(error)) is not None:
            _print_error(f"millrace: {ours}")
            return _failed(argv, ours.exit_code)
        if error.filename is not None or error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
            return _internal_error(argv, error)
        _print_error(f"millrace: standard output: {error.strerror}")  # an error of a file has the file's name
        return _failed(argv, 1)
    except ModuleNotFoundError as error:
        if error.name not in NOT_IN_WORKERS:
            return _internal_error(argv, error)
        _print_error(
            f"millrace: {argv[0]} needs {error.name}, which is not installed: worker, status and keys do without; "
            "pip install millrace-rl installs the rest"
        )
        return _failed(argv, 2)
    except Exception as error:
        return _internal_error(argv, error)


def _dispatch(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help"):
        print(_overview())
        return 0
    if argv[0] == "--version":
        import millrace

        print(f"millrace {millrace.__version__}")
        return 0
    name, *rest = argv
    if name not in COMMANDS:
        raise UsageError(f"unknown command {name}{did_you_mean(name, COMMANDS) or '; millrace --help lists them'}")
    return COMMANDS[name].run(rest)


def _overview() -> str:
    """The groups of commands, a line for each command."""
    width = max(len(f"{name} {command.arguments}") for name, command in COMMANDS.items())
    lines = ["usage: millrace COMMAND [arguments]", "", ABOUT]
    for title, commands in GROUPS.items():
        lines += ["", f"{title}:"]
        lines += [f"  millrace {f'{name} {one.arguments}':{width}}  {one.about}" for name, one in commands.items()]
    return "\n".join([*lines, "", "millrace COMMAND --help lists the flags; --debug shows tracebacks; --version."])


def _print_usage(name: str, *more: str) -> None:
    command = COMMANDS[name]
    about = f"{command.about[0].upper()}{command.about[1:]}."
    print(f"usage: millrace {name} {command.arguments}".rstrip(), "", about, *more, sep="\n")


# ---------------------------------------------------------------------------------------------------------- commands


def _train(argv: list[str], command: Literal["train", "learner"] = "train") -> int:
    from learner.config.command_line import read_config

    config, resume = read_config(command, argv)
    from millrace.launch import local_run

    elsewhere, new = command == "learner", None if resume else config
    return _run(argv, lambda watch: local_run.train(config, resume, watch, elsewhere=elsewhere), new)


def _learner(argv: list[str]) -> int:
    return _train(argv, "learner")


def _run(argv: list[str], train: Callable[[Watch], Path], new: Config | None = None) -> int:
    """Train, show the progress meanwhile, and print how the run ended. Output that cannot be written is dropped.

    `new`: the settings of a new run, whose origin is shown before its first progress.
    """
    from millrace.terminal import progress_view

    with unfailing("stdout"):
        with progress_view("--log-json" in argv) as watch:
            run = train(watch if new is None else _after_origin(new, watch))
        return _print_result(run)


def _after_origin(config: Config, watch: Callable[[Progress], None]) -> Callable[[Progress], None]:
    """The same function, which at first logs where the settings come from."""
    from learner.config.presets import origin

    lines = iter([origin(config)])

    def logged(progress: Progress) -> None:
        for line in lines:
            log_notice(log, line)
        watch(progress)

    return logged


def _print_result(run: Path) -> int:
    """Print how a run ended, and its folder."""
    from learner.run_folder.run_folder import RunFolder

    summary = RunFolder(run).summary()
    if summary is not None:
        print(f"{summary.stop_reason}: {summary.env_steps:,} env steps in {summary.wall_s:.1f} s")
        if summary.evaluation is not None:
            print(f"greedy {summary.evaluation}")
    print(f"run folder: {run}")
    return 0


def _worker(argv: list[str]) -> int:
    from workers.__main__ import main as work

    return work([flag for flag in argv if flag != "--debug"], "millrace worker")


def _evaluate(argv: list[str]) -> int:
    from learner.config.flag_parser import parse_flags
    from millrace.cli.flags import EvaluateFlags

    flags = parse_flags(EvaluateFlags, argv, "evaluate")
    from millrace.playing import play
    from millrace.terminal import count_line

    with count_line("evaluating") as watch:
        evaluation, videos = play(flags, watch)
    print("\n".join(map(str, [evaluation, *videos])))
    return 0


def _record(argv: list[str]) -> int:
    from learner.config.flag_parser import parse_flags
    from millrace.cli.flags import RecordFlags

    flags = parse_flags(RecordFlags, argv, "record")
    from millrace.playing import write_dataset
    from millrace.terminal import count_line

    with count_line("recording") as watch:
        dataset = write_dataset(flags, watch)
    print(dataset)
    if flags.npy is not None:
        print(f"rows of observation and action: {flags.npy}")
    return 0


def _report(argv: list[str]) -> int:
    from learner.config.flag_parser import parse_flags
    from learner.report.page import write_page
    from millrace.cli.flags import ReportFlags

    flags = parse_flags(ReportFlags, argv, "report")
    if not flags.runs:
        raise UsageError("report: which runs? expected run folders, as in: millrace report runs/*")
    print(write_page(flags.runs, flags.out or flags.runs[0] / "report.html"))
    return 0


def _plot(argv: list[str]) -> int:
    from learner.config.flag_parser import parse_flags
    from learner.report.learning_curves import plot
    from millrace.cli.flags import PlotFlags

    flags = parse_flags(PlotFlags, argv, "plot")
    if not flags.runs:
        raise UsageError("plot: which runs? expected run folders, as in: millrace plot runs/*")
    print(plot(flags.runs, flags.out or flags.runs[0] / "curves.png"))
    return 0


def _presets(argv: list[str]) -> int:
    argv = [flag for flag in argv if flag != "--debug"]
    if argv and argv[0] in HELP_FLAGS:
        _print_usage("presets")
        return 0
    if argv:
        raise UsageError(f"presets: unexpected argument {argv[0]}")
    from learner.config.presets import algorithms_and_environments, named_presets

    print("Used unless --preset says otherwise, by environment and algorithm:\n")
    for algo, env in algorithms_and_environments():
        print(f"  millrace train {env} --algo {algo}")
    print("\nComplete runs, by name:\n")
    for name, preset in named_presets().items():
        print(f"  millrace train --preset {name:24}  {preset.about}")
    return 0


def _status(argv: list[str]) -> int:
    from millrace.cli.status import status

    status(argv, sys.stdout)
    return 0


def _keys(argv: list[str]) -> int:
    from millrace.cli.keys import keys

    print(*keys(argv), sep="\n")
    return 0


def _conform(argv: list[str]) -> int:
    from millrace.cli.conform import run

    return run(argv, lambda line: print(line, flush=True))


def _launch(argv: list[str]) -> int:
    if argv and argv[0] in HELP_FLAGS:
        launchers = [f"  millrace launch {name:10}  {about}" for name, about in LAUNCHERS.items()]
        _print_usage(
            "launch",
            "",
            *launchers,
            "",
            "Put flags of `millrace learner` after `--`. millrace launch NAME --help lists the flags of each.",
        )
        return 0
    from millrace.launch.launcher_flags import SET_BY_LAUNCHER, read_flags

    launcher, *rest = argv or [""]
    match launcher:
        case "kubernetes":
            from datetime import UTC, datetime

            from millrace.cli.flags import KubernetesFlags
            from millrace.launch.kubernetes import manifest

            flags, learner = read_flags(KubernetesFlags, rest, launcher, (*SET_BY_LAUNCHER, "metrics-bind"))
            print(manifest(flags, learner, datetime.now(UTC).replace(microsecond=0)), end="")
        case "slurm":
            from millrace.cli.flags import SlurmFlags
            from millrace.launch.slurm import script

            print(script(*read_flags(SlurmFlags, rest, launcher)), end="")
        case "ray":
            return _launch_ray(rest)
        case _:
            expected = "expected kubernetes, slurm or ray; for containers here see docs/how-to/docker.md"
            raise UsageError(f"launch {launcher}: {expected}")
    return 0


def _launch_ray(argv: list[str]) -> int:
    from millrace.cli.flags import RayFlags
    from millrace.launch.launcher_flags import read_flags

    flags, learner = read_flags(RayFlags, argv, "ray", ("bind", "advertise", "insecure", "launched-workers"))
    try:
        from millrace.launch.ray import launch
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise UsageError("launch ray: Ray is not installed; pip install 'millrace-rl[ray]'") from None
    return _run(argv, lambda watch: launch(flags, learner, watch))


def _bench(argv: list[str]) -> int:
    """Start the benchmarks as a process of their own: they use this package and are not installed with it."""
    import subprocess

    from millrace.import_conflict import INSTALLED_IN

    clone = next((folder for folder in (INSTALLED_IN, Path.cwd()) if (folder / "benchmarks" / "program.py").is_file()), None)
    if clone is None and argv and argv[0] in HELP_FLAGS:
        _print_usage("bench")
        return 0
    if clone is None:
        raise UsageError("bench: not part of the installed package; run it in a clone of the repository (make bench)")
    path = os.pathsep.join(filter(None, [str(clone), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-P", "-m", "benchmarks.program", *(flag for flag in argv if flag != "--debug")]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path}) as process:
        try:
            return process.wait()
        except KeyboardInterrupt:
            process.terminate()  # it ends its benchmark
            process.wait()
            raise


GROUPS = {
    "Train": {
        "train": Command(_train, "ENV [flags]", "train on this machine: a learner and its worker processes"),
        "presets": Command(_presets, "", "list settings that are known to work"),
    },
    "Train with workers on other machines": {
        "learner": Command(_learner, "ENV --bind ADDRESS [flags]", "start a learner alone; workers join it from elsewhere"),
        "worker": Command(_worker, "ADDRESS [--token FILE] [flags]", "start workers that join a learner"),
        "keys": Command(_keys, "new|show|allow|revoke [NAME]", "say who may join the learners of this machine"),
        "status": Command(_status, "ADDRESS|RUN [--watch]", "show a run's workers, their speed, and what was dropped"),
        "launch": Command(_launch, "kubernetes|slurm|ray ENV [flags]", "start a learner and workers on a cluster"),
    },
    "Look at runs": {
        "evaluate": Command(_evaluate, "RUN [--video] [flags]", "play greedy episodes of a run's newest policy"),
        "record": Command(_record, "RUN --out DATASET [flags]", "write its episodes as a Minari dataset"),
        "plot": Command(_plot, "RUN [RUN ...] [--out FILE]", "draw learning curves as a PNG"),
        "report": Command(_report, "RUN [RUN ...] [--out FILE]", "compare runs on one HTML page"),
    },
    "Write a client in another language": {
        "conform": Command(_conform, "[flags] -- COMMAND …", "check a client against the wire document, rule by rule"),
    },
    "Measure millrace itself": {
        "bench": Command(_bench, "[NAME [flags]]", "run the benchmarks (in a clone of the repository)"),
    },
}
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}
LAUNCHERS = {
    "kubernetes": "print a manifest: a Job for the learner, a Deployment for the workers",
    "slurm": "print the script of one Slurm job",
    "ray": "train; the learner runs here, and each worker is an actor of a Ray cluster",
}


# ------------------------------------------------------------------------------------------------------------ errors


def _print_error(line: str) -> None:
    print(escaped(line), file=sys.stderr)  # it may quote what a worker said


def _resumes(argv: list[str]) -> str:
    """The command that resumes a run of this command line: a learner without workers stays one."""
    return "millrace learner" if argv[:1] == ["learner"] else "millrace train"


def _internal_error(argv: list[str], error: Exception) -> int:
    _print_error(last_line("millrace", error, _resumes(argv), [] if "--debug" in argv else ["--debug shows the traceback"]))
    return _failed(argv, 1)


def _failed(argv: list[str], exit_code: int) -> int:
    """Print the traceback if --debug was given. Returns the exit code."""
    if "--debug" in argv:
        import traceback

        traceback.print_exc()
    return exit_code
