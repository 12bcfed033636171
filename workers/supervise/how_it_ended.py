"""How a worker ended. Plain data. How long a worker may take to leave: supervisor.py."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Ending:
    """How a worker ended."""

    code: int
    """Exit code; below 0 if a signal ended it."""
    reason: str
    """One line."""
    on_purpose: bool = False
    """The worker announced that it would leave with this code."""
    failed: bool = False
    """The environment, the policy, or the worker is to blame: the worker ended neither on purpose nor before it ran their
    code.
    """
    of_policy: bool = False
    """It failed in a call of the policy."""
    hung: bool = False
    """It was ended because a call of its environment, or of the policy, took too long."""
    worked: bool = False
    """Calls of its environment have returned."""
    last_lines: str | None = None
    """The last lines of its output, if it failed before it had joined a run."""
