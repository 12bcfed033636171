"""When more workers are suggested because env steps wait, and how many."""

from __future__ import annotations

import pytest

from millrace.launch.waiting_steps import LOOK_EVERY_S, LOOKS, MOST_LOOKS, SeenWorker, WaitingSteps
from millrace.protocol.call_timeouts import Doing
from millrace.protocol.machine.core_times import CoreTimes
from millrace.workers.supervise.process_group import SessionUse

MIB = 1 << 20
WAITS = SessionUse(computes=False, resident=50 * MIB)
COMPUTES = SessionUse(computes=True, resident=60 * MIB)


class Machine:
    """Its clock, and the times of its cores."""

    def __init__(self) -> None:
        self.now = 0.0
        self.cores = CoreTimes()

    def passes(self, idle: float) -> None:
        """Time passes until the next look. The cores are idle for this share of it."""
        self.now += LOOK_EVERY_S
        self.cores = CoreTimes(self.cores.idle + round(100 * idle), self.cores.total + 100)


def lines(
    waiting: WaitingSteps,
    *looks: list[SeenWorker],
    free_bytes: int | None = None,
    times: int = 1,
    idle: float = 1.0,
    machine: Machine | None = None,
) -> list[str]:
    """What `times` rounds of these looks return, one after another."""
    machine = machine or Machine()
    results: list[str] = []
    for _ in range(times):
        for look in looks:
            machine.passes(idle)
            assert waiting.is_due(machine.now)
            results.append(waiting.look(look, machine.cores, free_bytes, machine.now, machine.now))
    return results


def seen(use: SessionUse, doing: Doing = "stepping") -> list[SeenWorker]:
    return [SeenWorker(doing, use)] * 2


def test_if_steps_wait_a_worker_for_each_lane_is_suggested_once() -> None:
    waiting = WaitingSteps(2, 8, 8)
    *before, line = lines(waiting, seen(WAITS), times=LOOKS)
    assert not any(before)
    says = "env steps wait for 100% of their time: --workers 8, one for each lane, would be faster, with the same results"
    assert line == says
    assert not waiting.is_due(1e9)


def test_nothing_is_suggested_if_workers_compute_for_more_than_half_of_the_time() -> None:
    looks = [seen(WAITS), seen(COMPUTES), seen(COMPUTES)]
    assert not any(lines(WaitingSteps(2, 8, 8), *looks, times=MOST_LOOKS // 3))


def test_half_of_the_time_is_enough() -> None:
    assert lines(WaitingSteps(2, 4, 4), seen(WAITS), seen(COMPUTES), times=LOOKS // 2)[-1]


@pytest.mark.parametrize(("idle", "suggested"), [(0.49, False), (0.5, True)])
def test_nothing_is_suggested_if_the_cores_are_busy_while_the_workers_wait(idle: float, suggested: bool) -> None:
    """Their simulators may compute as servers, in containers or in sessions of their own."""
    assert bool(lines(WaitingSteps(2, 8, 8), seen(WAITS), times=LOOKS, idle=idle)[-1]) == suggested


@pytest.mark.parametrize("doing", ["making", "stepping"])
def test_what_the_cores_did_before_does_not_count(doing: Doing) -> None:
    """A start or the first steps may compute, such as if they compile the simulator."""
    waiting = WaitingSteps(2, 8, 8)
    machine = Machine()
    assert not any(lines(waiting, seen(WAITS, doing), times=2 * LOOKS, idle=0.0, machine=machine))
    assert lines(waiting, seen(WAITS), times=LOOKS, machine=machine)[-1]


@pytest.mark.parametrize(("idle_collecting", "suggested"), [(0.3, False), (0.7, True)])
def test_what_the_cores_do_while_workers_wait_for_weights_does_not_count(idle_collecting: float, suggested: bool) -> None:
    """An update may keep all cores busy, or none, if it runs on a GPU."""
    waiting = WaitingSteps(2, 8, 8)
    machine = Machine()
    line = ""
    for _ in range(LOOKS // 5):
        lines(waiting, seen(WAITS, "waiting"), times=20, idle=1.0 - idle_collecting, machine=machine)
        machine.passes(1.0 - idle_collecting)  # the workers get weights between two looks
        *_, line = lines(waiting, seen(WAITS), times=5, idle=idle_collecting, machine=machine)
    assert bool(line) == suggested


@pytest.mark.parametrize("doing", ["starting", "waiting", "describing", "making", "preparing", "evaluating", "closing"])
def test_only_workers_that_collect_count(doing: Doing) -> None:
    """A worker that waits for a ticket says nothing about its steps."""
    assert not any(lines(WaitingSteps(2, 8, 8), seen(WAITS, doing), times=2 * LOOKS))
    mixed = [SeenWorker(doing, WAITS), SeenWorker("stepping", COMPUTES)]
    assert not any(lines(WaitingSteps(2, 8, 8), mixed, times=LOOKS))


def test_steps_that_begin_to_wait_later_are_noticed() -> None:
    """The first steps of a simulator may compile it."""
    looks = [*[seen(COMPUTES)] * LOOKS, *[seen(WAITS)] * LOOKS]
    assert lines(WaitingSteps(2, 8, 8), *looks)[-1]


def test_a_run_is_not_watched_for_ever() -> None:
    waiting = WaitingSteps(2, 8, 8)
    lines(waiting, seen(COMPUTES), times=MOST_LOOKS)
    assert not waiting.is_due(1e9)


def test_nor_is_a_run_whose_workers_mostly_wait_for_weights() -> None:
    waiting = WaitingSteps(2, 8, 8)
    lines(waiting, seen(COMPUTES), *[seen(WAITS, "waiting")] * 9, times=MOST_LOOKS // 10)
    assert not waiting.is_due(1e9)


def test_a_start_may_take_any_time() -> None:
    looks = [*[seen(WAITS, "making")] * (2 * MOST_LOOKS), *[seen(WAITS)] * LOOKS]
    assert lines(WaitingSteps(2, 8, 8), *looks)[-1]


@pytest.mark.parametrize(("workers", "lanes"), [(8, 8), (0, 0), (2, 0)])
def test_nobody_looks_if_no_lane_could_get_a_worker(workers: int, lanes: int) -> None:
    assert not WaitingSteps(workers, lanes, lanes).is_due(1e9)


def test_looking_takes_a_twentieth_of_the_time_at_most() -> None:
    waiting = WaitingSteps(2, 8, 8)
    waiting.look(seen(WAITS), CoreTimes(), None, 10.0, 10.1)
    assert not waiting.is_due(12.0)
    assert waiting.is_due(12.11)


@pytest.mark.parametrize(
    ("free_mib", "says"),
    [
        (10_000, ": --workers 8, one for each lane, would be faster, with the same results"),
        # There is room for three more, but with five workers some step two lanes, as with four.
        (240, ": --workers 4, all that fit into the memory, would be faster, with the same results"),
        (60, ": more workers would be faster, but their memory isn't free"),
    ],
)
def test_suggested_workers_fit_into_the_memory(free_mib: int, says: str) -> None:
    assert lines(WaitingSteps(2, 8, 8), seen(WAITS), free_bytes=free_mib * MIB, times=LOOKS)[-1].endswith(says)


def test_more_lanes_are_suggested_if_there_are_more_env_copies() -> None:
    line = lines(WaitingSteps(2, 4, 8), seen(WAITS), times=LOOKS)[-1]
    assert line.endswith("same results; --lanes 8 would let each env copy have a worker")
