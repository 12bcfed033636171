"""For a vector environment whose workers are played by the test: this program has started none."""

from __future__ import annotations

from millrace.workers.supervise.supervisor import Running, Supervisor


def _never(name: str) -> Running:
    raise AssertionError(f"worker {name} was started")


NO_LOCAL_WORKERS = Supervisor(_never, 0)
