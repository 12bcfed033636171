"""`millrace worker`: starts workers that join a learner."""

from __future__ import annotations

from millrace.workers.__main__ import main


def run(argv: list[str]) -> int:
    """Run the workers until the learner or the user ends them. Returns the exit code."""
    return main(argv)
