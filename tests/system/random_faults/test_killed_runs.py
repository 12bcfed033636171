"""Four small runs, killed at random times and resumed until they are done."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system.random_faults.killed_runs import Account, killed_runs


@pytest.mark.soak
@pytest.mark.timeout(900)
def test_runs_that_are_killed_at_any_moment_end_well(tmp_path: Path) -> None:
    account = Account()
    killed_runs(4, seed=2, folder=tmp_path, account=account)
    assert account.short == []
    assert sum(account.runs.values()) == 4
    assert sum(account.kills.values()) >= 4
