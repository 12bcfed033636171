"""`millrace worker`: workers that join a learner."""

from __future__ import annotations

from millrace.workers.__main__ import main


def run(argv: list[str]) -> int:
    """Work until the learner or the user ends it. Returns the exit code."""
    return main(argv)
