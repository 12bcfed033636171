"""Reads the command line of a launcher: its own flags, and after `--` the flags of the learner that it starts.

Rule: settings that the learner would refuse later, on the cluster, are refused here, before anything is written or started.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TypeVar

from millrace.extras.launchers.flags import LaunchFlags
from millrace.flags.parse import cut_at_dashes, parse_flags
from millrace.learner.config.command_line import read_config
from millrace.protocol.errors import UsageError

Flags = TypeVar("Flags", bound=LaunchFlags)

METRICS_PORT = 9464
SET_BY_LAUNCHER = ("bind", "advertise", "run-dir", "resume", "keys", "insecure", "launched-workers")
"""Learner flags that a launcher sets, so the user must not set them"""
NO_TEXT_IN_YAML = ("true", "false", "null", "on", "off", "yes", "no", "y", "n")
DNS_LABEL = re.compile(r"[a-z]([-a-z0-9]{0,38}[a-z0-9])?")


def read_flags(
    kind: type[Flags], argv: Sequence[str], launcher: str, set_by_launcher: Sequence[str] = SET_BY_LAUNCHER
) -> tuple[Flags, list[str]]:
    """The launcher's flags, and the user's flags for the learner. Raises `UsageError` if a flag is not valid."""
    own, rest = cut_at_dashes(argv)
    flags = parse_flags(kind, own, f"launch {launcher}")
    if not DNS_LABEL.fullmatch(flags.name) or flags.name in NO_TEXT_IN_YAML:
        raise UsageError(f"name {flags.name!r}: expected lowercase letters, digits and dashes, at most 40, as in my-run")
    for flag in rest:
        name, _, _ = flag.partition("=")
        if name.startswith("--") and name.removeprefix("--").replace("_", "-") in set_by_launcher:
            raise UsageError(f"launch {launcher}: {flag} is set by the launcher; leave it out")
    # This raises an error for wrong flags. It leaves out --resume, which the launcher sets.
    read_config("learner", [flags.env, "--bind", "tcp://0.0.0.0:5555", *rest])
    return flags, rest


def learner_flags(env: str, rest: Sequence[str], workers: int, *, bind: str, runs: str) -> list[str]:
    """The flags of a learner on a cluster, which starts `workers` worker processes for the learner.

    With these flags, the learner resumes the newest run, and waits ten minutes for workers. `bind`: the address where the
    workers join. `runs`: the folder of runs.
    """
    waits = ["--no-workers-timeout-s", "600", "--launched-workers", str(workers)]
    return [env, "--bind", bind, "--run-dir", runs, "--resume", "auto", *waits, *rest]
