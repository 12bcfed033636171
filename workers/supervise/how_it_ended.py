"""How a worker ended, as plain data. For how long a worker may take to leave, see supervisor.py."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Ending:
    """How a worker ended."""

    code: int
    """Exit code; below 0 if a signal ended it."""
    reason: str
    """How the worker ended, in one line."""
    on_purpose: bool = False
    """Whether the worker announced that it would leave with this code."""
    failed: bool = False
    """Whether this counts as a failure of the environment, the policy or the worker: the worker did not end on purpose, and
    had begun to run user code.
    """
    of_policy: bool = False
    """Whether the worker failed in a call to the policy."""
    hung: bool = False
    """Whether the worker was ended because a call to the environment, or to the policy, took too long."""
    worked: bool = False
    """Whether any calls to the environment have returned."""
    last_lines: str | None = None
    """The last lines of the worker's output, if it failed before it had joined a run; else None."""
