"""`millrace launch`: start a learner and workers on a cluster."""

from __future__ import annotations

from datetime import UTC, datetime

from millrace.cli.subcommands import chosen_subcommand
from millrace.cli.train_output import ShownRun
from millrace.extras.launchers.command_line import SET_BY_LAUNCHER, read_flags
from millrace.extras.launchers.flags import KubernetesFlags, LaunchFlags, RayFlags, SlurmFlags
from millrace.extras.launchers.kubernetes import manifest
from millrace.extras.launchers.slurm import script
from millrace.protocol.errors import UsageError

LAUNCHERS: dict[str, type[LaunchFlags]] = {"kubernetes": KubernetesFlags, "slurm": SlurmFlags, "ray": RayFlags}
ABOUT = "Start a learner and workers on a cluster. Put flags of `millrace learner` after `--`."


def run(argv: list[str]) -> int:
    """Print the manifest or script, or with Ray, train. Returns the exit code."""
    launcher, rest = chosen_subcommand("launch", ABOUT, LAUNCHERS, argv)
    match launcher:
        case "kubernetes":
            flags, learner = read_flags(KubernetesFlags, rest, launcher, (*SET_BY_LAUNCHER, "metrics-bind"))
            print(manifest(flags, learner, datetime.now(UTC).replace(microsecond=0)), end="")
        case "slurm":
            print(script(*read_flags(SlurmFlags, rest, launcher)), end="")
        case _:
            return _ray(rest)
    return 0


def _ray(argv: list[str]) -> int:
    flags, learner = read_flags(RayFlags, argv, "ray", ("bind", "advertise", "insecure", "launched-workers"))
    try:
        from millrace.extras.launchers.ray import launch  # imported here, because only this launcher needs Ray
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise UsageError("launch ray: Ray is not installed; pip install ray") from None
    shown = ShownRun(argv)
    with shown.progress() as watch:
        run = launch(flags, learner, watch)
    return shown.end(run)
