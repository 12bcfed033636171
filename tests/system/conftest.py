"""Fixtures for tests with real processes: a stage and a network, which are removed when the test is over."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.stage.network import Network, why_not
from tests.system.stage.processes import Stage


@pytest.fixture
def network() -> Iterator[Network]:
    if why := why_not():
        pytest.skip(why)
    with Network() as made:
        yield made


@pytest.fixture
def stage(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Stage]:
    if "network" in request.fixturenames:
        request.getfixturevalue("network")  # first, because the network must outlive the processes on its hosts
    made = Stage(tmp_path)
    try:
        yield made
    finally:
        made.close()
