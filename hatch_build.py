"""Refuses to build millrace where its symbolic links are lost: a wheel would lack three of its packages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PARTS = ("learner", "workers", "protocol")


class Links(BuildHookInterface[Any]):
    """Runs before a wheel, an editable install or an sdist is made."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Check that `millrace/learner` and its like are folders. In a zip of the tree they are small text files."""
        lost = [f"millrace/{part}" for part in PARTS if not (Path(self.root) / "millrace" / part).is_dir()]
        if lost:
            raise SystemExit(
                f"millrace: {', '.join(lost)}: expected a link to the folder beside millrace/, got none: this copy of the "
                "repository has lost its links, as a zip or a checkout on Windows does; install from a git clone, an sdist "
                "or a wheel"
            )
