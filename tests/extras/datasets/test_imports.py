"""What must start quickly imports nothing that is slow to import, and no package of a pip extra."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.test_architecture import OPTIONAL, ROOT, SLOW_TO_IMPORT

PLACE = "millrace.extras.datasets"


@pytest.mark.parametrize("name", ["command", "record", "training_recorder", "prior_dataset", "video"])
def test_packages_are_imported_when_an_episode_is_written_or_read(name: str) -> None:
    asks = f"import sys, {PLACE}.{name}; slow = sys.modules.keys() & {SLOW_TO_IMPORT | OPTIONAL}; assert not slow, slow"
    done = subprocess.run([sys.executable, "-c", asks], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
