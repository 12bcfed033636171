"""The host's law: who is started again, and when. Time and processes are faked."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from workers.host import BACKOFF_FIRST_S, BACKOFF_MOST_S, HEALTHY_S, Host


@dataclass
class FakeRunning:
    end: tuple[int, str] | None = None
    asked: list[str] = field(default_factory=list)

    def ended(self) -> tuple[int, str] | None:
        return self.end

    def stop(self) -> None:
        self.asked.append("stop")

    def wait(self, timeout_s: float) -> None:
        self.asked.append("wait")


class Machine:
    """Starts fakes and tells the time."""

    def __init__(self, workers: int = 1) -> None:
        self.now = 0.0
        self.started: list[tuple[str, FakeRunning]] = []
        self.host = Host(self.start, workers, lambda: self.now)

    def start(self, name: str) -> FakeRunning:
        self.started.append((name, FakeRunning()))
        return self.started[-1][1]

    def die(self, code: int, after_s: float = 0.0) -> list[tuple[str, str]]:
        self.now += after_s
        self.started[-1][1].end = (code, "why")
        return self.host.poll()

    def pause_s(self) -> float:
        """How long until it is started again, to a tenth of a second."""
        before, died_s = len(self.started), self.now
        while len(self.started) == before:
            self.now += 0.1
            assert self.now - died_s < 2 * BACKOFF_MOST_S, "it is not started again"
            assert self.host.poll() == []
        return self.now - died_s


def test_a_worker_that_died_comes_back_under_its_name_after_a_pause_that_doubles() -> None:
    machine = Machine()
    pauses = []
    for _ in range(9):
        assert machine.die(1) == [("w0", "why")]
        pauses.append(machine.pause_s())
    assert {name for name, _ in machine.started} == {"w0"}
    expected = [min(BACKOFF_FIRST_S * 2**n, BACKOFF_MOST_S) for n in range(9)]
    assert pauses == pytest.approx(expected, abs=0.11)


def test_a_worker_that_was_healthy_starts_anew() -> None:
    machine = Machine()
    for _ in range(4):
        machine.die(-9)
        machine.pause_s()
    machine.die(-9, after_s=HEALTHY_S + 1)
    assert machine.pause_s() == pytest.approx(BACKOFF_FIRST_S, abs=0.11)


@pytest.mark.parametrize("code", [0, 2])
def test_one_that_left_on_purpose_or_was_refused_stays_away(code: int) -> None:
    machine = Machine()
    assert machine.die(code) == [("w0", "why")]
    machine.now += 10 * BACKOFF_MOST_S
    assert machine.host.poll() == []
    assert len(machine.started) == 1


def test_each_end_is_told_once() -> None:
    machine = Machine(workers=2)
    assert machine.die(1) == [("w1", "why")]
    assert machine.host.poll() == []


def test_stopping_asks_all_waits_for_all_and_starts_nobody() -> None:
    machine = Machine(workers=2)
    machine.die(1)
    machine.host.stop()
    machine.now += 10
    assert machine.host.poll() == []
    assert [running.asked for _, running in machine.started] == [["stop", "wait"], []]
