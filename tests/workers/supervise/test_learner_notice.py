"""What a supervisor tells the learner, and when. The times are those that the test names; the socket is real."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
import zmq

from millrace.protocol.alive import Alive, WorkerActivity, WorkerExit
from millrace.workers.shared_weights import SharedWeights, SharedWeightsReader
from millrace.workers.supervise.learner_notice import (
    ENDED_AFTER_S,
    ENDED_FOR_S,
    EVERY_S,
    EVERY_S_WHILE_SLOW,
    SLOW_S,
    AliveSender,
)

SOON_MS = 10_000
STARTING = WorkerActivity("w0", 1, "starting", 0.0, 0)
WAITING, SLOW = WorkerActivity("w0", 1, "waiting", 9.0, 5), WorkerActivity("w0", 1, "stepping", 2 * SLOW_S, 5)
CRASHED, LEFT = WorkerExit("w1", 2, "was killed", True), WorkerExit("w2", 3, "exit code 0", False)


class Notices:
    """A sender, and the learner's end of its connection."""

    def __init__(self, address: str, weights: SharedWeights | None = None) -> None:
        self.learner: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.ROUTER)
        self.learner.bind(address)
        self.sender = AliveSender(address, None, weights)

    def said(self) -> Alive:
        """The next message."""
        assert self.learner.poll(SOON_MS)
        self.peer, head, *_ = self.learner.recv_multipart()
        return msgspec.msgpack.decode(head, type=Alive)

    def hears(self, head: object, *frames: bytes) -> None:
        """The learner says this; it has arrived."""
        self.hears_bytes(msgspec.msgpack.encode(head), *frames)

    def hears_bytes(self, *frames: bytes) -> None:
        """The same, of frames that may be anything."""
        self.learner.send_multipart([self.peer, *frames])
        assert self.sender._socket is not None
        assert self.sender._socket.poll(SOON_MS)

    def close(self) -> None:
        self.sender.close()
        self.learner.close(linger=0)


@pytest.fixture
def notices(tmp_path: Path) -> Iterator[Notices]:
    made = Notices(f"ipc://{tmp_path}/s")
    yield made
    made.close()


def test_nothing_is_said_before_a_worker_has_joined(notices: Notices) -> None:
    notices.sender.send([STARTING], [], 0.0)
    notices.sender.send([STARTING, WAITING], [], 0.1)
    assert notices.said().running == (WAITING,)


@pytest.mark.parametrize(("doing", "every_s"), [(WAITING, EVERY_S), (SLOW, EVERY_S_WHILE_SLOW)])
def test_it_is_said_again_after_a_time_that_is_shorter_while_a_call_takes_long(
    notices: Notices, doing: WorkerActivity, every_s: float
) -> None:
    again = msgspec.structs.replace(doing, env_calls=6)
    for activity, now in ((doing, 0.0), (msgspec.structs.replace(doing, env_calls=7), 0.9 * every_s), (again, every_s)):
        notices.sender.send([activity], [], now)
    assert [notices.said().running[0].env_calls for _ in range(2)] == [5, 6]


def test_a_call_that_begins_to_take_long_is_told_sooner_than_was_due(notices: Notices) -> None:
    notices.sender.send([WAITING], [], 0.0)
    notices.sender.send([SLOW], [], 0.1)
    notices.sender.send([SLOW], [], 0.1 + EVERY_S_WHILE_SLOW)
    assert [notices.said().running[0].doing for _ in range(2)] == ["waiting", "stepping"]


def test_a_failed_worker_is_named_at_once_and_one_that_left_a_moment_later(notices: Notices) -> None:
    notices.sender.send([WAITING], [], 0.0)
    notices.sender.send([WAITING], [LEFT], 0.1)  # its own last messages come first
    notices.sender.send([WAITING], [CRASHED], 0.2)
    notices.sender.send([WAITING], [], 0.1 + ENDED_AFTER_S)
    assert [notices.said().ended for _ in range(3)] == [(), (CRASHED,), (LEFT, CRASHED)]


def test_who_has_ended_is_named_for_a_while(notices: Notices) -> None:
    notices.sender.send([WAITING], [CRASHED], 0.0)
    for now in (EVERY_S, ENDED_FOR_S):
        notices.sender.send([WAITING], [], now)
    assert [notices.said().ended for _ in range(3)] == [(CRASHED,), (CRASHED,), ()]


@pytest.mark.parametrize(("head", "over"), [(["Drain", "done"], True), (["HeartbeatReply", 1], False), ("Drain", False)])
def test_only_a_drain_says_that_the_run_is_over(notices: Notices, head: object, over: bool) -> None:
    notices.sender.send([WAITING], [], 0.0)
    notices.said()
    assert not notices.sender.listen(0.0)
    notices.hears(head)
    assert notices.sender.listen(0.0) is over


def test_weights_that_come_are_shared_at_once_and_the_next_word_says_what_has_come(tmp_path: Path) -> None:
    shared = SharedWeights()
    notices = Notices(f"ipc://{tmp_path}/s", shared)
    try:
        worker = SharedWeightsReader(*shared.descriptors("w0"))
        notices.sender.send([WAITING], [], 0.0)
        assert notices.said().replies == 0
        for said in (["HeartbeatReply", 70, 9, []], ["Weights", 3, "described"]):
            notices.hears(said, b"parameters")
            notices.sender.listen(0.0)
        (frames,) = worker.find(70, {3})
        assert frames == [msgspec.msgpack.encode(["Weights", 3, "described"]), b"parameters"]
        notices.sender.send([WAITING], [], EVERY_S)
        assert notices.said().replies == 9
    finally:
        notices.close()
        shared.close()


def test_a_supervisor_that_cannot_share_says_so_and_goes_on(tmp_path: Path) -> None:
    shared = SharedWeights()
    notices = Notices(f"ipc://{tmp_path}/s", shared)
    try:
        notices.sender.send([WAITING], [], 0.0)
        notices.said()
        notices.hears(["Weights", -1], b"parameters")
        assert not notices.sender.listen(0.0)
        notices.sender.send([WAITING], [], EVERY_S)
        assert notices.said().replies is None
    finally:
        notices.close()
        shared.close()


@pytest.mark.parametrize(
    "head",
    [b"", b"\xc1", b"\x92\xa5Drain\xa1\xff", b"\x91" * 100_000, b"\x92\xa5Drain\x81\x80\x01", b"\x91\xd9\x7fDrain"],
    ids=["empty", "no type", "no UTF-8", "nested", "dict as a key", "cut"],
)
def test_a_message_that_cannot_be_read_is_ignored(notices: Notices, head: bytes) -> None:
    """Its workers would end with the supervisor."""
    notices.sender.send([WAITING], [], 0.0)
    notices.said()
    notices.hears_bytes(head)
    assert not notices.sender.listen(0.0)
    notices.hears(["Drain", "done"])
    assert notices.sender.listen(0.0)
