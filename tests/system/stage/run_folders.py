"""Reads what a test needs of a run folder: its summary, its policy, and its newest checkpoint."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from millrace.learner.rollouts.past_rollouts import PastRollouts, unpacked
from millrace.learner.run_folder import checkpoint


def folder_of(runs: Path) -> Path:
    """The one run folder in this folder."""
    (folder,) = runs.iterdir()
    return folder


def summary(folder: Path) -> dict[str, Any]:
    """Its summary.json."""
    found: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return found


def policy_of(folder: Path) -> bytes:
    """Its final policy."""
    return (folder / "policy.safetensors").read_bytes()


def saved_rollouts(folder: Path) -> PastRollouts:
    """The rollouts so far, as its newest checkpoint has them."""
    return unpacked(PastRollouts, checkpoint.newest(folder)[0].state["rollouts"].numpy())


def saved(folder: Path) -> int:
    """The number of updates in its newest checkpoint."""
    found: int = checkpoint.newest(folder)[0].state["past"]["state"]["version"]
    return found
