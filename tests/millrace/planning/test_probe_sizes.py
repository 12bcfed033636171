"""The sizes of a probe's sessions: they fit into the time and the memory, even if all that copies do computes."""

from __future__ import annotations

import pytest

from millrace.planning.measurements import Machine
from millrace.planning.probe_sizes import (
    COPIES_OF_SHORT,
    OF_MEMORY,
    SPARE,
    Needed,
    SessionSize,
    most_each,
    numbers_of_workers,
)
from tests.millrace.planning.made_up import measured

GB = 1 << 30
IDLE_WORKER = 50 << 20


@pytest.mark.parametrize(
    ("before", "after", "times"),
    [
        (SessionSize(1, 1), SessionSize(1, 8), 8),  # the copies of a worker take turns
        (SessionSize(1, 1), SessionSize(2, 1), 1),  # each worker has a core
        (SessionSize(2, 1), SessionSize(8, 1), 4),  # four workers for each core
        (SessionSize(8, 1), SessionSize(16, 1), 2),
        (SessionSize(1, 2), SessionSize(8, 4), 8),
    ],
)
def test_a_session_fits_if_there_is_time_for_its_copies_one_after_another_and_its_workers_on_the_cores(
    before: SessionSize, after: SessionSize, times: int
) -> None:
    needed = Needed(before, 3.0)
    least_s = SPARE * times * 3.0
    assert needed.fits(after, cores=2, left_s=1.001 * least_s)
    assert not needed.fits(after, cores=2, left_s=0.999 * least_s)


@pytest.mark.parametrize("left_s", [0.5, 4.0, 9.0, 40.0])
def test_the_most_copies_in_a_worker_are_as_many_as_fit_into_the_time(left_s: float) -> None:
    needed = Needed(SessionSize(), 2.0)
    most = needed.most_each(left_s)
    assert not needed.fits(SessionSize(1, most + 1), 2, left_s)
    assert most == 0 or needed.fits(SessionSize(1, most), 2, left_s)


@pytest.mark.parametrize("cores", [1, 2, 8, 64])
@pytest.mark.parametrize("free_gb", [1, 4, 16, 256])
@pytest.mark.parametrize("worker_bytes", [60 << 20, 300 << 20, GB, 4 * GB])
@pytest.mark.parametrize(("wait_s", "cpu_s"), [(0.0, 1e-4), (9e-4, 1e-5)])
def test_no_session_uses_more_than_its_share_of_the_free_memory(
    cores: int, free_gb: int, worker_bytes: int, wait_s: float, cpu_s: float
) -> None:
    machine = Machine(cores=cores, free_bytes=free_gb * GB)
    found = measured(wait_s=wait_s, cpu_s=cpu_s, worker_bytes=worker_bytes)
    each = most_each(found, machine)
    for workers in [*numbers_of_workers(found, machine, each), *[1] * (each > 1)]:
        assert workers * (IDLE_WORKER + each * (worker_bytes - IDLE_WORKER)) <= OF_MEMORY * free_gb * GB


def test_small_copies_are_stepped_several_in_a_worker_on_each_core() -> None:
    machine = Machine(cores=8, free_bytes=16 * GB)
    found = measured(cpu_s=1e-4, worker_bytes=60 << 20)
    assert most_each(found, machine) == COPIES_OF_SHORT
    assert [*numbers_of_workers(found, machine, COPIES_OF_SHORT)] == [8]
    assert most_each(found, Machine(cores=8, most_copies=24)) == 3
