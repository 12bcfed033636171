"""One minute of the soak test: many faults at once, and all requirements afterwards."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system.network import why_not
from tests.system.soak import soak


@pytest.mark.soak
def test_a_run_survives_a_minute_of_faults(tmp_path: Path) -> None:
    if why := why_not():
        pytest.skip(why)
    assert soak(1.0, seed=1, folder=tmp_path) == []
