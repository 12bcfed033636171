"""The flags of the commands that look at runs."""

from __future__ import annotations

from pathlib import Path

import msgspec
from tyro.conf import Positional


class EvaluateFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Greedy episodes of a run's newest policy: mean and standard deviation of the return."""

    run: Positional[Path]
    """the run folder"""
    episodes: int = 100
    """how many"""
    seed: int = 1_000_000
    """of the episodes; another seed, other episodes"""
    debug: bool = False
    """show the traceback of an error"""


class PlotFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Learning curves as a PNG: a panel for each environment, a colour for each algorithm, seeds as a band."""

    runs: Positional[tuple[Path, ...]]
    """run folders"""
    out: Path | None = None
    """the PNG; curves.png in the first run folder if not given"""
    debug: bool = False
    """show the traceback of an error"""
