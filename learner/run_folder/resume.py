"""Which run `--resume auto` goes on with: so that the same command starts a run, and goes on with it however it ended."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from learner.run_folder.checkpoint import FOLDER, SUFFIX
from learner.run_folder.run_folder import RunSettings, sanitised

AUTO = Path("auto")


def newest_run(config: RunSettings) -> Path | None:
    """The newest run folder in `run_dir` of this environment, algorithm and seed that holds a checkpoint, if there is one.

    A folder's name ends in the time when its run began, so the newest is the last by name.
    """
    kin = re.compile(re.escape(f"{sanitised(config.env)}-{config.algo}-s{config.seed}-") + r"\d{8}-\d{6}")
    root = Path(config.run_dir)
    found = [path for path in root.iterdir() if kin.fullmatch(path.name)] if root.is_dir() else []
    return max((path for path in found if _is_of(path, config)), key=lambda path: path.name, default=None)


def _is_of(path: Path, config: RunSettings) -> bool:
    """A learner that was killed before its first checkpoint left nothing to go on with; nor does half a folder."""
    try:
        table = tomllib.loads((path / "config.toml").read_text())
    except (OSError, ValueError):
        return False
    return table.get("env") == config.env and any((path / FOLDER).glob(f"*{SUFFIX}"))
