"""`millrace launch`: start a learner and workers on a cluster."""

from __future__ import annotations

from datetime import UTC, datetime

from millrace.cli.commands import HELP_FLAGS, usage
from millrace.cli.flags import KubernetesFlags, RayFlags, SlurmFlags
from millrace.cli.shown_run import show_run
from millrace.launch.kubernetes import manifest
from millrace.launch.launcher_flags import SET_BY_LAUNCHER, read_flags
from millrace.launch.slurm import script
from protocol.errors import UsageError

LAUNCHERS = {
    "kubernetes": "print a manifest: a Job for the learner, a Deployment for the workers",
    "slurm": "print the script of one Slurm job",
    "ray": "train; the learner runs here, and each worker is an actor of a Ray cluster",
}


def run(argv: list[str]) -> int:
    """Print what starts it, or with Ray, train. Returns the exit code."""
    if argv and argv[0] in HELP_FLAGS:
        launchers = [f"  millrace launch {name:10}  {about}" for name, about in LAUNCHERS.items()]
        more = "Put flags of `millrace learner` after `--`. millrace launch NAME --help lists the flags of each."
        print(usage("launch", "", *launchers, "", more))
        return 0
    launcher, *rest = argv or [""]
    match launcher:
        case "kubernetes":
            flags, learner = read_flags(KubernetesFlags, rest, launcher, (*SET_BY_LAUNCHER, "metrics-bind"))
            print(manifest(flags, learner, datetime.now(UTC).replace(microsecond=0)), end="")
        case "slurm":
            print(script(*read_flags(SlurmFlags, rest, launcher)), end="")
        case "ray":
            return _ray(rest)
        case _:
            expected = "expected kubernetes, slurm or ray; for containers here see docs/how-to/docker.md"
            raise UsageError(f"launch {launcher}: {expected}")
    return 0


def _ray(argv: list[str]) -> int:
    flags, learner = read_flags(RayFlags, argv, "ray", ("bind", "advertise", "insecure", "launched-workers"))
    try:
        from millrace.launch.ray import launch  # only here: Ray is an extra
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise UsageError("launch ray: Ray is not installed; pip install 'millrace-rl[ray]'") from None
    return show_run(argv, lambda watch: launch(flags, learner, watch))
