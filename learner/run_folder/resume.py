"""`--resume auto`: the run to continue. The same command thus starts a run and continues it, however it ended."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from learner.run_folder.checkpoint import FOLDER, SUFFIX
from learner.run_folder.run_folder import RunSettings, as_folder_name

AUTO = Path("auto")


def newest_run(config: RunSettings) -> Path | None:
    """The newest run folder with a checkpoint in `run_dir`, for this environment, algorithm and seed; or None.

    The name of a run folder ends with the start time, so the newest is the last by name.
    """
    pattern = re.compile(re.escape(f"{as_folder_name(config.env)}-{config.algo}-s{config.seed}-") + r"\d{8}-\d{6}")
    root = Path(config.run_dir)
    matching = [path for path in root.iterdir() if pattern.fullmatch(path.name)] if root.is_dir() else []
    return max((path for path in matching if _can_be_resumed(path, config)), key=lambda path: path.name, default=None)


def _can_be_resumed(path: Path, config: RunSettings) -> bool:
    """Whether this is a folder of the same environment that can be resumed: it has a config.toml and a checkpoint."""
    try:
        table = tomllib.loads((path / "config.toml").read_text())
    except (OSError, ValueError):
        return False
    return table.get("env") == config.env and any((path / FOLDER).glob(f"*{SUFFIX}"))
