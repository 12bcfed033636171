"""Local workers keep to cores where they take turns with the learner and share the cores out evenly, or are told to."""

from __future__ import annotations

import os

import pytest

from learner.config import resolve
from millrace.launch.here import cores_for
from protocol.errors import UsageError

CORES = {2, 3}


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: CORES, raising=False)
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, cores: None, raising=False)


@pytest.mark.parametrize(
    ("workers", "max_lag", "pin", "kept"),
    [
        (2, 0, None, True),
        (4, 0, None, True),
        (1, 0, None, False),  # another run's only worker would keep to the same core
        (3, 0, None, False),
        (2, 1, None, False),  # the learner runs beside them
        (2, 0, False, False),
        (3, 0, True, True),
        (2, 1, True, True),
    ],
)
def test_workers_keep_to_the_cores_that_this_process_may_use(
    workers: int, max_lag: int, pin: bool | None, kept: bool
) -> None:
    config = resolve("CartPole-v1", workers=workers, max_lag=max_lag, pin_workers=pin)
    assert cores_for(config) == (sorted(CORES) if kept else [])


def test_where_the_system_cannot_only_who_asked_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_setaffinity")
    assert cores_for(resolve("CartPole-v1", workers=2)) == []
    with pytest.raises(UsageError, match="pin_workers"):
        cores_for(resolve("CartPole-v1", workers=2, pin_workers=True))
