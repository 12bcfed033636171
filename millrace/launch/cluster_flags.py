"""What the launchers share: which flags are theirs, which are the learner's, and what both kinds must be like.

The law: a launcher writes text and starts nothing; what a cluster would refuse later is refused here.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from typing import TypeVar

from learner.config.command_line import read_config
from learner.config.flag_parser import parse_flags
from millrace.cli.flags import LaunchFlags
from protocol.errors import UsageError

Flags = TypeVar("Flags", bound=LaunchFlags)

METRICS_PORT = 9464
OURS = ("bind", "advertise", "run-dir", "resume", "keys", "insecure")  # flags that every launcher sets itself
DNS_LABEL = re.compile(r"[a-z]([-a-z0-9]{0,38}[a-z0-9])?")


def read(kind: type[Flags], argv: Sequence[str], command: str, ours: Sequence[str] = OURS) -> tuple[Flags, list[str]]:
    """The launcher's flags, and behind `--` the learner's, tried on its own command line. Raises `UsageError`.

    `ours`: those of the learner's that are not the user's to set here.
    """
    own = list(argv)
    rest: list[str] = []
    if "--" in own:
        at = own.index("--")
        own, rest = own[:at], own[at + 1 :]
    flags = parse_flags(kind, own, f"launch {command}")
    if flags.workers < 1:
        raise UsageError(f"workers expected int >= 1, got {flags.workers}")
    if not DNS_LABEL.fullmatch(flags.name):
        raise UsageError(f"name {flags.name!r}: expected small letters, digits and dashes, at most 40, as in my-run")
    for flag in rest:
        if flag.partition("=")[0].removeprefix("--").replace("_", "-") in ours:
            raise UsageError(f"launch {command}: {flag} is the launcher's to set; leave it out")
    read_config("learner", learner_flags(flags.env, rest, bind="tcp://0.0.0.0:5555", runs=os.devnull))
    return flags, rest


def learner_flags(env: str, rest: Sequence[str], bind: str, runs: str) -> list[str]:
    """Of a learner on a cluster: it goes on where its predecessor ended, and is patient while workers are placed."""
    return [env, "--bind", bind, "--run-dir", runs, "--resume", "auto", "--no-workers-timeout-s", "600", *rest]
