"""One learner with many workers over real sockets: nothing is lost."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from benchmarks.scale import Measured

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize("transport", ["ipc", "tcp"])
def test_nothing_is_lost_with_many_workers(transport: str) -> None:
    program = f"""
import msgspec
from benchmarks.scale import measure
print(msgspec.json.encode(measure(60, 0.5, "{transport}")).decode())
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    found = msgspec.json.decode(done.stdout, type=Measured)
    assert found.updates >= 1
    assert found.lost == 0
    assert found.rollouts_per_s > 60
    assert found.spread_ms > 0
