"""How cores are counted and shared out between a learner and its workers."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from learner.config.layers import resolve
from learner.torch_setup import threads
from millrace.launch.local_worker_options import worker_cores
from protocol import cpu_cores as counting
from protocol.cpu_cores import usable_cores
from protocol.errors import UsageError
from protocol.specs import ActionSpec, Leaf, PolicySpec

CORES = {2, 3}


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: CORES, raising=False)
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, mask: None, raising=False)


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
    assert worker_cores(config) == (sorted(CORES) if kept else [])


def test_where_the_system_cannot_only_who_asked_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_setaffinity")
    assert worker_cores(resolve("CartPole-v1", workers=2)) == []
    with pytest.raises(UsageError, match="pin_workers"):
        worker_cores(resolve("CartPole-v1", workers=2, pin_workers=True))


@pytest.mark.parametrize(
    ("told", "count"),
    [
        ("max 100000\n", 8),
        ("400000 100000\n", 4),
        ("150000 100000\n", 1),
        ("5000 100000\n", 1),
        ("9900000 100000\n", 8),
        ("", 8),
    ],
)
def test_a_container_has_its_share_of_the_cores(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, told: str, count: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)))
    monkeypatch.setattr(counting, "CPU_MAX", tmp_path / "cpu.max")
    assert usable_cores() == 8  # no container
    (tmp_path / "cpu.max").write_text(told)
    assert usable_cores() == count


ACTION = ActionSpec("discrete", (), "int64", (2,), (0,))
SMALL = PolicySpec((Leaf("", "box", (4,), "float32"),), ACTION)
LARGE = PolicySpec((Leaf("", "box", (4,), "float32"),), ACTION, net=(512, 512))
IMAGES = PolicySpec((Leaf("", "box", (84, 84, 4), "uint8"),), ACTION)


@pytest.mark.parametrize(
    ("policy", "settings", "workers", "count"),
    [
        (SMALL, {}, 2, 1),
        (LARGE, {}, 2, 8),  # workers wait while it learns
        (IMAGES, {}, 2, 8),
        (IMAGES, {"max_lag": 1}, 2, 6),
        (IMAGES, {"max_lag": 1}, 0, 8),  # they are elsewhere
        (IMAGES, {"max_lag": 1}, 20, 1),
        (IMAGES, {"torch_threads": 3}, 2, 3),
        (SMALL, {"torch_threads": 3}, 2, 3),
    ],
)
def test_the_learner_takes_the_cores_that_workers_leave(
    monkeypatch: pytest.MonkeyPatch, policy: PolicySpec, settings: dict[str, Any], workers: int, count: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)))
    monkeypatch.setattr(counting, "CPU_MAX", Path("nowhere"))
    assert threads(resolve("CartPole-v1", **settings), policy, workers) == count
