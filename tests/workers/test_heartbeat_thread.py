"""One thread at a time has the conversation: the second only while the first is away, in the environment's code."""

from __future__ import annotations

import threading

import pytest

from workers import heartbeat_thread
from workers.heartbeat_thread import HeartbeatThread

SOON_S = 10.0


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heartbeat_thread, "INTERVAL_S", 0.001)


def test_it_breathes_while_the_first_thread_is_away() -> None:
    breathed = threading.Event()
    made = HeartbeatThread(breathed.set)
    made.start()
    made.start()
    with made.lock_released():
        assert breathed.wait(SOON_S)
    made.stop()
    assert not any(thread.name == "heartbeat" for thread in threading.enumerate())


def test_it_holds_its_breath_while_the_first_thread_is_here_or_back() -> None:
    inside, breathed = threading.Event(), threading.Event()
    meetings: list[str] = []

    def breathe() -> None:
        if inside.is_set():
            meetings.append("both")
        breathed.set()

    made = HeartbeatThread(breathe)
    inside.set()
    made.start()
    for _ in range(100):
        inside.clear()
        with made.lock_released():
            breathed.clear()
            assert breathed.wait(SOON_S)
            with made.lock_reacquired():
                inside.set()
                breathed.clear()
                assert not breathed.wait(0.002)
                inside.clear()
        inside.set()
    made.stop()
    assert meetings == []


def test_what_the_environment_raises_brings_the_first_thread_back() -> None:
    breathed = threading.Event()
    made = HeartbeatThread(breathed.set)
    with pytest.raises(KeyError), made.lock_released():
        raise KeyError
    made.start()
    assert not breathed.wait(0.01)
    made.stop()


def test_one_that_never_started_can_be_stopped() -> None:
    HeartbeatThread(lambda: None).stop()
