"""A learner is asked while somebody looks at its run, and only then."""

import tempfile
import threading
from collections.abc import Iterator
from itertools import repeat
from pathlib import Path

import pytest
import zmq

from millrace.extras.monitoring.dashboard import lookout as lookout_module
from millrace.extras.monitoring.dashboard.lookout import Lookout, Seen
from millrace.learner.run_folder.lease import Listens
from millrace.learner.run_folder.run_lock import RunLock
from millrace.protocol.messages import Status
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.worker_link import OF_OBSERVER
from tests.extras.monitoring.dashboard.test_site import status, worker

WITHIN_S = 20.0


class AnsweringLearner:
    """Answers every message with a status, and counts them."""

    def __init__(self, address: str, answer: Status) -> None:
        self.asked = 0
        self._stop, self._answer = threading.Event(), answer
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.ROUTER)
        self._socket.bind(address)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            if self._socket.poll(10):
                peer, *_ = self._socket.recv_multipart()
                self.asked += 1
                self._socket.send_multipart([peer, *map(bytes, encode(self._answer))])
        self._socket.close(linger=0)

    def close(self) -> None:
        self._stop.set()
        self._thread.join(WITHIN_S)


@pytest.fixture
def address() -> Iterator[str]:
    with tempfile.TemporaryDirectory() as folder:
        yield f"ipc://{folder}/socket"


@pytest.fixture(autouse=True)
def _often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lookout_module, "ASK_EVERY_S", 0.01)
    monkeypatch.setattr(lookout_module, "ANSWER_WITHIN_S", 0.05)


def looked(lookout: Lookout, run: Path, samples: int) -> Seen:
    """Look until this number of samples is there."""
    pause = threading.Event()
    for _ in range(round(WITHIN_S / 0.01)):
        seen = lookout.look(run)
        if len(seen.samples) >= samples or seen.problem:
            return seen
        pause.wait(0.01)
    raise AssertionError(f"{seen} after {WITHIN_S} s")


def test_a_learner_is_asked_as_long_as_somebody_looks(tmp_path: Path, address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    learner = AnsweringLearner(address, status(worker(), waiting="waiting 3 s for lane 0"))
    try:
        with RunLock(tmp_path) as lock, Lookout() as lookout:
            lock.announce(Listens(address, address))
            seen = looked(lookout, tmp_path, 3)
            assert seen.status is not None
            assert seen.status.progress.waiting == "waiting 3 s for lane 0"
            assert seen.samples[-1].lanes == {0: "collecting", 1: "no worker"}
            assert seen.samples[-1].learner == "waiting"
            monkeypatch.setattr(lookout_module, "LOOKED_AT_S", 0.0)
            threading.Event().wait(0.2)
            asked = learner.asked
            threading.Event().wait(0.2)
            assert learner.asked == asked
            monkeypatch.setattr(lookout_module, "FORGOTTEN_S", 0.0)
            threading.Event().wait(0.2)
            assert lookout.look(tmp_path) == Seen()
    finally:
        learner.close()


def test_a_run_that_cannot_be_asked_says_why(tmp_path: Path) -> None:
    with Lookout() as lookout:
        assert "no process trains it now" in looked(lookout, tmp_path, 1).problem


def test_a_learner_that_never_stops_answering_holds_nobody_up(tmp_path: Path) -> None:
    class Answering:
        problem = None

        def poll(self, timeout_s: float) -> None:
            pass

        def answers(self) -> Iterator[Status]:
            return repeat(status(worker()))

    watched = lookout_module._Watched(0.0, Answering())  # type: ignore[arg-type]
    Lookout()._listen(watched, 0.0)
    assert watched.status == status(worker())


def test_what_is_remembered_is_bounded(tmp_path: Path, address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lookout_module, "SAMPLES", 4)
    learner = AnsweringLearner(address, status(worker(), wanted=10**9))
    try:
        with RunLock(tmp_path) as lock, Lookout() as lookout:
            lock.announce(Listens(address, address))
            looked(lookout, tmp_path, 4)
            while learner.asked < 10:
                threading.Event().wait(0.01)
            seen = lookout.look(tmp_path)
            assert len(seen.samples) == 4
            assert len(seen.samples[0].lanes) == lookout_module.MOST_LANES
    finally:
        learner.close()


class SilentLearner:
    """Accepts a connection, and sends parts of a message that never ends."""

    problem = None

    def __init__(self, *args: object, **limits: object) -> None:
        self.closed = False
        self.limits = limits
        MADE.append(self)

    def send(self, frames: object) -> None:
        pass

    def poll(self, timeout_s: float) -> None:
        pass

    def answers(self) -> Iterator[Status]:
        return iter(())

    def close(self, linger_s: float) -> None:
        self.closed = True


MADE: list[SilentLearner] = []


def test_a_learner_that_is_silent_is_asked_anew_after_a_pause(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What it has sent of a message fills our memory as long as the connection is open."""
    MADE.clear()
    monkeypatch.setattr(lookout_module, "WorkerLink", SilentLearner)
    now = 100.0
    lookout, watched = Lookout(lambda: now), lookout_module._Watched(now)
    with RunLock(tmp_path) as lock:
        lock.announce(Listens("tcp://127.0.0.1:9", "tcp://127.0.0.1:9"))
        for now, made, closed in (
            (100.0, 1, False),
            (100.0 + lookout_module.SILENT_S, 1, False),
            (100.1 + lookout_module.SILENT_S, 1, True),
            (100.1 + lookout_module.SILENT_S + lookout_module.PAUSE_S / 2, 1, True),
            (100.2 + lookout_module.SILENT_S + lookout_module.PAUSE_S, 2, False),
        ):
            lookout._ask(tmp_path, watched)
            lookout._listen(watched, 0.0)
            assert (len(MADE), MADE[-1].closed) == (made, closed), now
    assert MADE[0].limits["limits"] == OF_OBSERVER
    assert watched.problem
