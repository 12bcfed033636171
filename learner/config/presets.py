"""Presets: settings that are known to work, by algorithm and environment, and whole runs by name (presets.toml)."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, NamedTuple

PRESETS = Path(__file__).with_name("presets.toml")
NAMED = "named"  # the table of presets.toml that holds whole runs


class Preset(NamedTuple):
    """A whole run by name: environment, algorithm and settings."""

    about: str
    """one line for `millrace presets`"""
    settings: dict[str, Any]


def named_presets() -> dict[str, Preset]:
    """The whole runs that `--preset NAME` takes, by name."""
    tables: dict[str, dict[str, Any]] = _tables().get(NAMED, {})
    return {name: Preset(table.pop("about"), table) for name, table in tables.items()}


def environment_presets(algo: str) -> dict[str, dict[str, Any]]:
    """The settings of each environment for which this algorithm has a preset."""
    presets: dict[str, dict[str, Any]] = _tables().get(algo, {})
    return presets


def algorithms_and_environments() -> list[tuple[str, str]]:
    """Algorithm and environment of every preset that applies without --preset."""
    return [(algo, env) for algo, envs in _tables().items() if algo != NAMED for env in envs]


def _tables() -> dict[str, Any]:
    return tomllib.loads(PRESETS.read_text())
