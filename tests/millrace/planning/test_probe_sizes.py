"""The sizes of a probe's sessions: they fit into the memory, and use all cores."""

from __future__ import annotations

import pytest

from millrace.planning.measurements import Machine
from millrace.planning.probe_sizes import (
    COPIES_OF_SHORT,
    OF_MEMORY,
    between,
    enough_s,
    most_each,
    numbers_of_workers,
    two_fit,
)
from tests.millrace.planning.made_up import measured

GB = 1 << 30
IDLE_WORKER = 50 << 20


@pytest.mark.parametrize("cores", [1, 2, 8, 64])
@pytest.mark.parametrize("free_gb", [1, 4, 16, 256])
@pytest.mark.parametrize("worker_bytes", [60 << 20, 300 << 20, GB, 2 * GB, 4 * GB])
@pytest.mark.parametrize(("wait_s", "cpu_s"), [(0.0, 1e-4), (9e-4, 1e-5)])
def test_no_session_uses_more_than_its_share_of_the_free_memory(
    cores: int, free_gb: int, worker_bytes: int, wait_s: float, cpu_s: float
) -> None:
    machine = Machine(cores=cores, free_bytes=free_gb * GB)
    found = measured(wait_s=wait_s, cpu_s=cpu_s, worker_bytes=worker_bytes)
    each = most_each(found, machine)
    sizes = [(workers, each) for workers in numbers_of_workers(found, machine, each)]
    sizes += [(1, each)] * (each > 1) + [(1, 2)] * two_fit(found, machine)
    for workers, copies in sizes:
        assert workers * (IDLE_WORKER + copies * (worker_bytes - IDLE_WORKER)) <= OF_MEMORY * free_gb * GB


def test_small_copies_are_stepped_several_in_a_worker_on_each_core() -> None:
    machine = Machine(cores=8, free_bytes=16 * GB)
    found = measured(cpu_s=1e-4, worker_bytes=60 << 20)
    assert most_each(found, machine) == COPIES_OF_SHORT
    assert two_fit(found, machine)
    assert [*numbers_of_workers(found, machine, COPIES_OF_SHORT)] == [8]
    assert most_each(found, Machine(cores=8, most_copies=24)) == 3


@pytest.mark.parametrize("works", [1, 2, 3, 7, 8, 20, 31])
def test_the_numbers_between_what_worked_and_what_failed_lead_to_the_largest_that_works(works: int) -> None:
    worked, failed, tried = 1, 32, 0
    while number := between(worked, failed):
        tried += 1
        worked, failed = (number, failed) if number <= works else (worked, number)
    assert (worked, failed) == (works, works + 1)
    assert tried <= 8


def test_after_2_and_8_come_4_and_3() -> None:
    assert (between(2, 8), between(2, 4), between(2, 3)) == (4, 3, 0)


def test_enough_time_is_that_of_all_sessions_one_after_another() -> None:
    """One copy, 8, 32 and 64 workers, and two copies that take turns in a worker; 64 workers start on 8 cores."""
    found = measured(wait_s=20.0, start_s=3.0, reset_s=60.0)
    assert [*numbers_of_workers(found, Machine(cores=8), 1)] == [8, 32, 64]
    assert enough_s(found, Machine(cores=8), 1, steps=9) == pytest.approx(
        6 * (60 + 9 * 20) + 3 * (1 + 1 + 4 + 8 + 1), rel=1e-4
    )
