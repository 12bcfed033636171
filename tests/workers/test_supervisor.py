"""Which workers the host starts again, and when. Time and processes are faked."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from workers.supervisor import (
    BACKOFF_FIRST_S,
    BACKOFF_MOST_S,
    EXIT_NO_LEARNER,
    HEALTHY_S,
    LEAVE_WITHIN_S,
    POLL_S,
    Supervisor,
)


@dataclass
class FakeRunning:
    end: tuple[int, str] | None = None
    requests: list[str] = field(default_factory=list)

    def ended(self) -> tuple[int, str] | None:
        return self.end

    def stop(self) -> None:
        self.requests.append("stop")

    def wait(self, timeout_s: float) -> None:
        self.requests.append("wait")

    def kill(self) -> None:
        self.requests.append("kill")


class Machine:
    """Starts fake workers and has a clock."""

    def __init__(self, workers: int = 1) -> None:
        self.now = 0.0
        self.started: list[tuple[str, FakeRunning]] = []
        self.host = Supervisor(self.start, workers, lambda: self.now)

    def start(self, name: str) -> FakeRunning:
        self.started.append((name, FakeRunning()))
        return self.started[-1][1]

    def die(self, code: int, after_s: float = 0.0) -> list[tuple[str, str]]:
        self.now += after_s
        self.started[-1][1].end = (code, "why")
        return self.host.poll()

    def pause_s(self) -> float:
        """Seconds until the worker is started again, to a tenth of a second."""
        before, died_s = len(self.started), self.now
        while len(self.started) == before:
            self.now += 0.1
            assert self.now - died_s < 2 * BACKOFF_MOST_S, "it is not started again"
            assert self.host.poll() == []
        return self.now - died_s


def test_a_worker_that_died_is_restarted_under_its_name_with_backoff() -> None:
    machine = Machine()
    pauses = []
    for _ in range(9):
        assert machine.die(1) == [("w0", "why")]
        pauses.append(machine.pause_s())
    assert {name for name, _ in machine.started} == {"w0"}
    expected = [min(BACKOFF_FIRST_S * 2**n, BACKOFF_MOST_S) for n in range(9)]
    assert pauses == pytest.approx(expected, abs=0.11)


def test_the_backoff_of_a_worker_that_was_healthy_is_reset() -> None:
    machine = Machine()
    for _ in range(4):
        machine.die(-9)
        machine.pause_s()
    machine.die(-9, after_s=HEALTHY_S + 1)
    assert machine.pause_s() == pytest.approx(BACKOFF_FIRST_S, abs=0.11)


@pytest.mark.parametrize("code", [0, 2, EXIT_NO_LEARNER])
def test_a_worker_that_left_on_purpose_or_was_refused_is_not_restarted(code: int) -> None:
    machine = Machine()
    assert machine.die(code) == [("w0", "why")]
    machine.now += 10 * BACKOFF_MOST_S
    assert machine.host.poll() == []
    assert len(machine.started) == 1


def test_each_end_is_reported_once() -> None:
    machine = Machine(workers=2)
    assert machine.die(1) == [("w1", "why")]
    assert machine.host.poll() == []


def test_stop_asks_all_waits_for_all_and_restarts_none() -> None:
    machine = Machine(workers=2)
    machine.die(1)
    machine.host.stop()
    machine.now += 10
    assert machine.host.poll() == []
    assert [running.requests for _, running in machine.started] == [["stop", "wait"], []]


@pytest.mark.parametrize(
    ("codes", "expected"),
    [
        ([0, 0], 0),
        ([0, EXIT_NO_LEARNER], 1),
        ([2, EXIT_NO_LEARNER], 2),
        ([0, 2], 2),
        ([EXIT_NO_LEARNER, EXIT_NO_LEARNER], 1),
    ],
)
def test_a_host_without_workers_returns_the_exit_code_and_reports_each_end(codes: list[int], expected: int) -> None:
    machine = Machine(workers=2)
    for (_, running), code in zip(machine.started, codes, strict=True):
        running.end = (code, f"ended with {code}")
    reports: list[str] = []
    assert machine.host.run(lambda: 0, reports.append) == expected
    assert reports == [f"w0 ended with {codes[0]}", f"w1 ended with {codes[1]}"]


def test_every_request_to_stop_is_passed_on_and_a_worker_that_does_not_leave_is_killed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine = Machine(workers=1)
    worker = machine.started[0][1]
    requests = 0

    def sleeps(seconds: float) -> None:
        """Time passes; the worker is asked twice, and ends only when it is killed."""
        nonlocal requests
        machine.now += seconds
        requests = 2 if machine.now > 5 else 1 if machine.now > 1 else 0
        if "wait" in worker.requests:
            worker.end = (-9, "was killed")

    monkeypatch.setattr("workers.supervisor.time.sleep", sleeps)
    assert machine.host.run(lambda: requests, lambda line: None) == 1
    assert worker.requests == ["stop", "stop", "stop", "wait"]
    assert machine.now == pytest.approx(1 + LEAVE_WITHIN_S, abs=5 * POLL_S)
    assert len(machine.started) == 1
