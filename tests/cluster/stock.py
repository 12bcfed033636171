"""What the images are built from without a registry: a small Debian with Python as the base image, and a folder of wheels.

Rule: both are made once, by debootstrap and by pip with its configuration, and kept in `.cluster` beside the sources, or
in the folder that MILLRACE_CLUSTER names.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import tomllib
from pathlib import Path

from tests.cluster.engine import run
from tests.system.stage.processes import ROOT

STOCK = Path(os.environ.get("MILLRACE_CLUSTER", ROOT / ".cluster"))
SUITE, PYTHON = "bookworm", "3.11"
NOT_NEEDED = ("var/cache/apt", "var/lib/apt/lists", "usr/share/doc", "usr/share/man", "usr/share/locale", "dev")
"""folders that a slim image does not have either"""
MAKE_WITHIN_S = 900.0


def base() -> Path:
    """The base image, as a tar file for `docker import`."""
    made = STOCK / f"{SUITE}.tar"
    if not made.exists():
        STOCK.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=STOCK) as folder:
            run(["debootstrap", "--variant=minbase", "--include=python3-venv", SUITE, folder], within_s=MAKE_WITHIN_S)
            half = made.with_suffix(".half")
            run(["tar", "-C", folder, "-cf", half, *(f"--exclude=./{path}" for path in NOT_NEEDED), "."])
            half.rename(made)
    return made


def wheels() -> list[Path]:
    """The wheels that both images install: 0.3 GB if pip finds PyTorch's CPU build, else several GB."""
    folder = STOCK / "wheels"
    if not folder.exists():
        STOCK.mkdir(parents=True, exist_ok=True)
        wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())
        extras = wanted["project"]["optional-dependencies"]
        of_learner = [*wanted["project"]["dependencies"], *extras["prometheus"], *extras["tensorboard"]]
        needs = [*of_learner, *wanted["build-system"]["requires"]]
        half = folder.with_suffix(".half")
        shutil.rmtree(half, ignore_errors=True)
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--only-binary=:all:", f"--python-version={PYTHON}"]
        run([*pip, "--constraint", ROOT / "constraints.txt", "--dest", half, *needs], within_s=MAKE_WITHIN_S)
        half.rename(folder)
    return sorted(folder.glob("*.whl"))
