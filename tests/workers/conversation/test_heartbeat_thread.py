"""Only one thread at a time has the lock: the second sends heartbeats only while the first runs the environment's code."""

from __future__ import annotations

import threading

import pytest

from millrace.workers.conversation import heartbeat_thread
from millrace.workers.conversation.heartbeat_thread import HeartbeatThread

SOON_S = 10.0


@pytest.fixture(autouse=True)
def short_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heartbeat_thread, "CHECK_EVERY_S", 0.001)


def test_it_sends_heartbeats_while_the_first_thread_has_released_the_lock() -> None:
    sent = threading.Event()
    heartbeats = HeartbeatThread(sent.set)
    heartbeats.start()
    heartbeats.start()
    with heartbeats.lock_released():
        assert sent.wait(SOON_S)
    heartbeats.stop()
    assert not any(thread.name == "heartbeat" for thread in threading.enumerate())


def test_it_sends_none_while_the_first_thread_has_the_lock() -> None:
    first_thread_has_lock, sent = threading.Event(), threading.Event()
    overlaps: list[str] = []

    def heartbeat() -> None:
        if first_thread_has_lock.is_set():
            overlaps.append("both")
        sent.set()

    heartbeats = HeartbeatThread(heartbeat)
    first_thread_has_lock.set()
    heartbeats.start()
    for _ in range(100):
        first_thread_has_lock.clear()
        with heartbeats.lock_released():
            sent.clear()
            assert sent.wait(SOON_S)
            with heartbeats.lock_reacquired():
                first_thread_has_lock.set()
                sent.clear()
                assert not sent.wait(0.002)
                first_thread_has_lock.clear()
        first_thread_has_lock.set()
    heartbeats.stop()
    assert overlaps == []


def test_the_first_thread_has_the_lock_again_when_the_environment_raises() -> None:
    sent = threading.Event()
    heartbeats = HeartbeatThread(sent.set)
    with pytest.raises(KeyError), heartbeats.lock_released():
        raise KeyError
    heartbeats.start()
    assert not sent.wait(0.01)
    heartbeats.stop()


def test_a_thread_that_never_started_can_be_stopped() -> None:
    HeartbeatThread(lambda: None).stop()
