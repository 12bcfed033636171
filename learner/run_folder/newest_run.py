"""Finds the run that `--resume auto` continues, so that one command can both start a run and continue it."""

from __future__ import annotations

import logging
import os
import re
from pathlib import Path

from millrace.learner.run_folder.checkpoint import has_any
from millrace.learner.run_folder.run_folder import RunSettings, as_folder_name
from millrace.learner.run_folder.run_format import CONFIG_FILE, read_config
from millrace.protocol.bounds import one_line
from millrace.protocol.errors import UsageError
from millrace.protocol.logs.notices import log_notice

log = logging.getLogger("millrace.learner")

AUTO = Path("auto")


def newest_run(config: RunSettings) -> Path | None:
    """The newest run folder in `run_dir` that has a checkpoint and this environment, algorithm and seed, or None.

    The name of a run folder ends with the start time, and with a number if several runs began in that second.
    """
    name = re.escape(f"{as_folder_name(config.env)}-{as_folder_name(config.algo)}-s{config.seed}-")
    pattern = re.compile(name + r"(\d{8}-\d{6})(?:-(\d{1,9}))?")
    root = Path(config.run_dir)
    matching: list[tuple[str, int, Path]] = []
    for path in root.iterdir() if root.is_dir() else ():
        named = pattern.fullmatch(path.name)
        if named is not None and _can_be_resumed(path, config):
            number = int(named[2] or 1)  # the first run that began in a second has no number, and the next has number 2
            matching.append((named[1], number, path))
    if not matching:
        log_notice(log, f"no run to resume in {config.run_dir}: a new one begins")
        return None
    return max(matching)[2]


def _can_be_resumed(path: Path, config: RunSettings) -> bool:
    """Whether this is a run of this environment and algorithm that has a checkpoint."""
    if not os.path.lexists(path / CONFIG_FILE):
        return False
    try:
        table = read_config(path)
    except UsageError as error:
        log.warning("run %s is passed over: %s", path, one_line(str(error)))
        return False
    same = (table["env"], table["algo"]) == (config.env, config.algo)
    return same and has_any(path)
