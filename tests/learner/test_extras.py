"""The table of what settings start of the extras."""

from __future__ import annotations

import pytest

from millrace.learner.extras import STARTED_BY, started_by


@pytest.mark.parametrize("setting", STARTED_BY)
def test_what_a_setting_starts_is_there(setting: str) -> None:
    assert callable(started_by(setting))
