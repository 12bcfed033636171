"""What an example of the documentation finds when it runs, in a page or in a docstring, and when it may be left out.

Rule: an example writes only into its own folder, opens no window and no connection. One that needs an extra that is not
installed is skipped.
"""

from __future__ import annotations

import re
from pathlib import Path

EXTRAS = {
    "wandb", "mlflow", "optuna", "jax", "ray", "envpool", "ale_py", "minari", "moviepy", "stable_baselines3", "mujoco",
    "Box2D", "zstandard", "onnx", "onnxscript",
}  # fmt: skip
MISSING = re.compile(
    r"^\s*ModuleNotFoundError: No module named '(\w+)|^\s*(?:\w+\.)*UsageError: .*pip install (\S+)", re.MULTILINE
)


def variables(folder: Path) -> dict[str, str]:
    """The environment variables of an example that runs in this folder."""
    return {
        "HOME": str(folder),
        "MINARI_DATASETS_PATH": str(folder / "datasets"),
        "MPLBACKEND": "agg",
        "WANDB_MODE": "offline",
    }


def missing_extra(errors: str) -> str:
    """The extra without which an example ended with this traceback; empty if that was not the reason."""
    found = MISSING.search(errors)
    if found is None or not (found[2] or found[1] in EXTRAS):
        return ""
    return found[1] or found[2]
