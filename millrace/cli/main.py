"""The command line. Flags are the fields of the configuration, their help the texts under them; nothing is said twice.

The law: what a user did wrong is one line on stderr and exit code 2; what went wrong is one line (and the worker's own
traceback, if there is one) and exit code 1; 130 after Ctrl-C; a traceback of ours with --debug alone. Imports wait until a
command needs them, so that `--help` answers at once.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")  # before numpy; --torch-threads sets the learner's

from protocol.errors import OurError, UsageError, first_line

WHAT = "Worker processes step a gymnasium environment, one PyTorch learner learns."


class Command(NamedTuple):
    """A subcommand."""

    run: Callable[[list[str]], int]
    usage: str
    help: str


def main(argv: list[str] | None = None) -> int:
    """Run the command line; the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # last: a module of the user's own is found here, and hides none of those installed
    try:
        exit_code = _dispatch(argv)
        sys.stdout.flush()
        return exit_code
    except OurError as error:
        _say(f"millrace: {error}")
        if error.detail:
            _say(error.detail.rstrip())
        return _trace(argv, error.exit_code)
    except KeyboardInterrupt as interrupt:
        run = getattr(interrupt, "run", None)
        _say(f"millrace: interrupted{f'; go on with: millrace train --resume {run}' if run else ''}")
        return _trace(argv, 130)
    except BrokenPipeError:  # whoever read our output has gone: nobody is left to tell
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        hint = "" if "--debug" in argv else "; --debug shows the traceback"
        _say(f"millrace: internal error: {type(error).__name__}: {first_line(error)}{hint}")
        return _trace(argv, 1)


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
        from learner.config.did_you_mean import did_you_mean

        raise UsageError(f"unknown command {name}{did_you_mean(name, COMMANDS) or '; millrace --help lists them'}")
    return COMMANDS[name].run(rest)


def _overview() -> str:
    width = max(len(command.usage) for command in COMMANDS.values())
    lines = [f"  millrace {command.usage:{width}}  {command.help}" for command in COMMANDS.values()]
    return "\n".join([WHAT, "", *lines, "", "millrace COMMAND --help tells more; --debug shows tracebacks; --version."])


# ---------------------------------------------------------------------------------------------------------- commands


def _train(argv: list[str]) -> int:
    from learner.config.command_line import read_config

    config, resume = read_config("train", argv)
    from millrace.launch import local
    from millrace.terminal import watching

    with watching("--log-json" in argv) as watch:
        run = local.train(config, resume, watch)
    return _told(run)


def _learner(argv: list[str]) -> int:
    from learner.config.command_line import read_config

    config, resume = read_config("learner", argv)
    from learner.run import serve
    from millrace.launch import learner_inference as inference
    from millrace.terminal import watching

    with watching("--log-json" in argv) as watch:
        if config.inference == "learner":
            run = inference.train(config, resume, watch, elsewhere=True)
        else:
            run = serve(config, resume, watch)
    return _told(run)


def _told(run: Path) -> int:
    """How a run ended, and where it is."""
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

    return work([flag for flag in argv if flag != "--debug"])


def _evaluate(argv: list[str]) -> int:
    from learner.config.flag_parser import parse_flags
    from learner.evaluate import evaluate, load_policy
    from millrace.cli.flags import EvaluateFlags

    flags = parse_flags(EvaluateFlags, argv, "evaluate")
    episodes = flags.episodes if flags.episodes is not None else 3 if flags.video else 100
    _at_least("episodes", episodes, 1)
    _at_least("seed", flags.seed, 0)
    policy, spec, env = load_policy(flags.run, "best" if flags.best else "final")
    if not flags.video:
        print(evaluate(env, policy, spec, episodes, flags.seed))
        return 0
    from learner.recording.video import film

    found, films = film(flags.run, env, policy, spec, episodes, flags.seed)
    print("\n".join(map(str, [found, *films])))
    return 0


def _record(argv: list[str]) -> int:
    from learner.config.flag_parser import parse_flags
    from learner.recording.record import record
    from millrace.cli.flags import RecordFlags

    flags = parse_flags(RecordFlags, argv, "record")
    _at_least("steps", flags.steps, 1)
    _at_least("seed", flags.seed, 0)
    print(record(flags.run, flags.out, flags.steps, flags.seed, stochastic=flags.stochastic, npy=flags.npy, best=flags.best))
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
    if argv:
        raise UsageError(f"presets: unexpected argument {argv[0]}")
    from learner.config.presets import algorithms_and_environments, named_presets

    print("Taken by themselves, by environment and --algo:\n")
    for algo, env in algorithms_and_environments():
        print(f"  millrace train {env} --algo {algo}")
    print("\nWhole runs by name:\n")
    for name, preset in named_presets().items():
        print(f"  millrace train --preset {name:24}  {preset.about}")
    return 0


def _status(argv: list[str]) -> int:
    from learner.config.flag_parser import parse_flags
    from millrace.cli.flags import StatusFlags

    flags = parse_flags(StatusFlags, argv, "status")
    from millrace.cli.status import observe, observer_name
    from protocol.keys.key_folder import read_token
    from protocol.wire.link import WorkerLink
    from workers.code_trust import entry

    token = entry(flags.address, read_token(flags.token), insecure=flags.insecure)
    link = WorkerLink(flags.address, observer_name(), token=token)
    try:
        observe(link, flags)
    finally:
        link.close(linger_s=0)
    return 0


def _keys(argv: list[str]) -> int:
    from millrace.cli.keys import keys

    for line in keys(argv):
        print(line)
    return 0


def _launch(argv: list[str]) -> int:
    from millrace.launch.cluster_flags import OURS, read

    launcher, *rest = argv or [""]
    match launcher:
        case "kubernetes":
            from datetime import UTC, datetime

            from millrace.cli.flags import KubernetesFlags
            from millrace.launch.kubernetes import manifest

            flags, learner = read(KubernetesFlags, rest, launcher, (*OURS, "metrics-bind"))
            print(manifest(flags, learner, datetime.now(UTC).replace(microsecond=0)), end="")
        case "slurm":
            from millrace.cli.flags import SlurmFlags
            from millrace.launch.slurm import script

            print(script(*read(SlurmFlags, rest, launcher)), end="")
        case "ray":
            return _launch_ray(rest)
        case _:
            raise UsageError(f"launch {launcher}: expected kubernetes, slurm or ray; for containers here see docs/docker.md")
    return 0


def _launch_ray(argv: list[str]) -> int:
    from millrace.cli.flags import RayFlags
    from millrace.launch.cluster_flags import read

    flags, learner = read(RayFlags, argv, "ray", ("bind", "advertise", "insecure"))
    try:
        from millrace.launch.ray import launch
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise UsageError("launch ray: Ray is not installed; pip install 'millrace-rl[ray]'") from None
    from millrace.terminal import watching

    with watching("--log-json" in argv) as watch:
        run = launch(flags, learner, watch)
    return _told(run)


def _bench(argv: list[str]) -> int:
    import importlib.util

    if importlib.util.find_spec("benchmarks") is None or importlib.util.find_spec("benchmarks.program") is None:
        raise UsageError("bench: not part of the installed package; run it in a clone of the repository (make bench)")
    from benchmarks.program import main as run

    return run([flag for flag in argv if flag != "--debug"])


def _at_least(name: str, value: int, least: int) -> None:
    if value < least:
        raise UsageError(f"{name} expected int >= {least}, got {value}")


COMMANDS = {
    "train": Command(_train, "train ENV [flags]", "train on this machine: the learner here, worker processes beside it"),
    "learner": Command(
        _learner, "learner ENV --bind ADDRESS [flags]", "the learner alone; waits for workers from elsewhere"
    ),
    "worker": Command(_worker, "worker ADDRESS [--token FILE] [--processes N]", "workers here that join a learner"),
    "status": Command(_status, "status ADDRESS [--watch]", "how a run is: its workers, their speed, what was dropped"),
    "keys": Command(_keys, "keys new|show|allow|revoke [NAME]", "who may join learners of this machine from others"),
    "launch": Command(
        _launch, "launch kubernetes|slurm|ray ENV [-- flags]", "the same on a cluster, placed by an engine that you have"
    ),
    "evaluate": Command(_evaluate, "evaluate RUN [--video] [flags]", "greedy episodes of a run's newest policy"),
    "record": Command(_record, "record RUN --out DATASET [flags]", "episodes of a run's newest policy as a Minari dataset"),
    "plot": Command(_plot, "plot RUN [RUN ...] [--out FILE]", "learning curves as a PNG"),
    "presets": Command(_presets, "presets", "settings that are known to work, by environment and by name"),
    "bench": Command(_bench, "bench [NAME] [flags]", "benchmarks: tables, JSON and pictures (in a clone of the repository)"),
    "report": Command(_report, "report RUN [RUN ...] [--out FILE]", "runs side by side as one HTML page"),
}


# ---------------------------------------------------------------------------------------------------------- saying it


def _say(line: str) -> None:
    print(line, file=sys.stderr)


def _trace(argv: list[str], exit_code: int) -> int:
    if "--debug" in argv:
        import traceback

        traceback.print_exc()
    return exit_code
