"""One thread at a time has the conversation: the second only while the first is away, in the environment's code."""

from __future__ import annotations

import threading

import pytest

from workers import heartbeat_thread as breath
from workers.heartbeat_thread import Breath

SOON_S = 10.0


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(breath, "EVERY_S", 0.001)


def test_it_breathes_while_the_first_thread_is_away() -> None:
    breathed = threading.Event()
    made = Breath(breathed.set)
    made.start()
    made.start()
    with made.away():
        assert breathed.wait(SOON_S)
    made.stop()
    assert not any(thread.name == "breath" for thread in threading.enumerate())


def test_it_holds_its_breath_while_the_first_thread_is_here_or_back() -> None:
    inside, breathed = threading.Event(), threading.Event()
    meetings: list[str] = []

    def breathe() -> None:
        if inside.is_set():
            meetings.append("both")
        breathed.set()

    made = Breath(breathe)
    inside.set()
    made.start()
    for _ in range(100):
        inside.clear()
        with made.away():
            breathed.clear()
            assert breathed.wait(SOON_S)
            with made.back():
                inside.set()
                breathed.clear()
                assert not breathed.wait(0.002)
                inside.clear()
        inside.set()
    made.stop()
    assert meetings == []


def test_what_the_environment_raises_brings_the_first_thread_back() -> None:
    breathed = threading.Event()
    made = Breath(breathed.set)
    with pytest.raises(KeyError), made.away():
        raise KeyError
    made.start()
    assert not breathed.wait(0.01)
    made.stop()


def test_one_that_never_started_can_be_stopped() -> None:
    Breath(lambda: None).stop()
