"""Installs a package of one module, with entry points, for a test: a folder of its files on the path."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest


def install_package(
    folder: Path, monkeypatch: pytest.MonkeyPatch, *, module: str, source: str, group: str, entry_points: str
) -> None:
    """Install a package whose module has this source, and whose entry points of this group are these lines."""
    (folder / f"{module}.py").write_text(source)
    info = folder / f"{module}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module.replace('_', '-')}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{entry_points}\n")
    sys.modules.pop(module, None)
    monkeypatch.syspath_prepend(str(folder))
