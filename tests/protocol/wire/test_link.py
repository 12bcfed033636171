"""The two ends of the wire over real sockets: inproc, ipc and tcp. Every wait is a poll with a deadline; nothing sleeps."""

from __future__ import annotations

import os
import shutil
import socket as plain
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zmq

import millrace.protocol.wire.sockets
from millrace.protocol.address import check_address, is_local
from millrace.protocol.errors import BadMessage, CannotUnpack, UsageError
from millrace.protocol.messages import (
    Drain,
    Goodbye,
    Hello,
    Inquire,
    Rejoin,
    Rollout,
    ToLearner,
    ToWorker,
    Weights,
)
from millrace.protocol.wire.codec import decode_to_worker, encode
from millrace.protocol.wire.compression import Packing, has_zstd
from millrace.protocol.wire.learner_link import LearnerLink
from millrace.protocol.wire.message_sizes import MAX_FRAMES
from millrace.protocol.wire.sockets import COPY_BELOW_BYTES
from millrace.protocol.wire.worker_link import OF_OBSERVER, WorkerLink
from tests.support.conversation.every_message import to_learner, to_worker
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import fake_rollout

Context = zmq.Context[zmq.Socket[bytes]]

DEADLINE_S = 10.0
HELLO = example(Hello)

TO_LEARNER, TO_WORKER = to_learner(1), to_worker(1)


class Ends:
    """Makes sockets, and closes all of them."""

    def __init__(self, address: str) -> None:
        self.context: Context = zmq.Context()
        self.address = address
        self.links: list[LearnerLink | WorkerLink] = []
        self.sockets: list[zmq.Socket[bytes]] = []

    def learner(self, address: str | None = None) -> LearnerLink:
        link = LearnerLink(address or self.address, self.context)
        self.links.append(link)
        return link

    def worker(self, learner: LearnerLink | str, name: str = "w0") -> WorkerLink:
        link = WorkerLink(learner if isinstance(learner, str) else learner.address, name, self.context)
        self.links.append(link)
        return link

    def raw(self, learner: LearnerLink, name: bytes = b"raw") -> zmq.Socket[bytes]:
        """A DEALER that may say anything; it does not come back when it is cut off."""
        dealer = self.context.socket(zmq.DEALER)
        self.sockets.append(dealer)
        dealer.linger = 0
        dealer.routing_id = name
        dealer.reconnect_ivl = -1
        dealer.connect(learner.address)
        return dealer

    def close(self) -> None:
        for link in self.links:
            link.close(linger_s=0.0)
        for raw in self.sockets:
            raw.close(linger=0)
        self.context.term()  # would wait for ever for a socket that was forgotten


@pytest.fixture(params=["inproc", "ipc", "tcp"])
def ends(request: pytest.FixtureRequest) -> Iterator[Ends]:
    folder = Path(tempfile.mkdtemp(prefix="mr"))  # short: an ipc path may have 107 characters
    addresses = {"inproc": "inproc://learner", "ipc": f"ipc://{folder}/learner", "tcp": "tcp://127.0.0.1:*"}
    ends = Ends(addresses[request.param])
    yield ends
    ends.close()
    shutil.rmtree(folder)


@pytest.fixture
def tcp() -> Iterator[Ends]:
    ends = Ends("tcp://127.0.0.1:*")
    yield ends
    ends.close()


def heard(link: LearnerLink, messages: int = 1) -> list[tuple[bytes, ToLearner | Inquire | BadMessage]]:
    """So many messages, with their senders; fails at the deadline."""
    got: list[tuple[bytes, ToLearner | Inquire | BadMessage]] = []
    while len(got) < messages:
        assert link.poll(DEADLINE_S), f"only {len(got)} of {messages} messages arrived"
        got += link.receive()
    return got


def told(link: WorkerLink, messages: int = 1) -> list[ToWorker | BadMessage]:
    got: list[ToWorker | BadMessage] = []
    while len(got) < messages:
        assert link.poll(DEADLINE_S), f"only {len(got)} of {messages} messages arrived"
        got += link.receive()
    return got


def same(first: object, second: object) -> bool:
    """Equal records: two messages that have the same frames."""
    return [bytes(f) for f in encode(first)] == [bytes(f) for f in encode(second)]  # type: ignore[arg-type]


def joined(learner: LearnerLink, worker: WorkerLink) -> None:
    """The learner knows the worker's connection."""
    worker.send(encode(HELLO))
    heard(learner)


# -------------------------------------------------------------------- both directions


def frame_stacks() -> Rollout:
    """A rollout whose observations are frame stacks [33, 1, 4, 50, 50], larger than what is copied when it is received."""
    frames = np.random.default_rng(0).integers(0, 256, (36, 50, 50), dtype=np.uint8)
    obs = np.stack([frames[t : t + 4] for t in range(33)])[:, None]
    return msgspec.structs.replace(fake_rollout(1, 2, 3, 4, 5), obs=(obs,))


def test_a_packed_rollout_arrives_whole_where_there_is_room_for_it(ends: Ends) -> None:
    learner, rollout = ends.learner(), frame_stacks()
    worker = ends.worker(learner)
    frames = encode(rollout, Packing(stack=True))
    worker.send(frames)
    ((_, error),) = heard(learner)
    assert isinstance(error, CannotUnpack)
    assert error.session == rollout.session
    learner.packed_bytes_limit = rollout.obs[0].nbytes
    before = learner.received.bytes
    worker.send(frames)
    ((_, back),) = heard(learner)
    assert same(back, rollout)
    assert COPY_BELOW_BYTES < learner.received.bytes - before < 0.3 * rollout.obs[0].nbytes


def test_what_leaves_the_machine_or_is_encrypted_is_packed(ends: Ends) -> None:
    assert ends.worker(ends.learner()).packing == Packing(stack=False)
    assert ends.worker("tcp://192.0.2.1:5555", "w1").packing == Packing(stack=True, zstd=has_zstd())
    assert ends.worker("tcp://localhost:9", "w2").packing == Packing(stack=False)


def test_every_message_to_a_learner_arrives_in_order_with_its_sender(ends: Ends) -> None:
    learner = ends.learner()
    worker = ends.worker(learner, "wörker-0")
    for message in TO_LEARNER:
        worker.send(encode(message))
    got = heard(learner, len(TO_LEARNER))
    assert {peer for peer, _ in got} == {"wörker-0".encode()}
    assert all(same(message, said) for message, (_, said) in zip(TO_LEARNER, got, strict=True))


def test_every_message_to_a_worker_arrives_in_order(ends: Ends) -> None:
    learner = ends.learner()
    worker = ends.worker(learner)
    joined(learner, worker)
    for message in TO_WORKER:
        assert learner.send(b"w0", encode(message))
    got = told(worker, len(TO_WORKER))
    assert all(same(message, said) for message, said in zip(TO_WORKER, got, strict=True))


def test_each_worker_is_told_its_own(ends: Ends) -> None:
    learner = ends.learner()
    workers = [ends.worker(learner, f"w{number}") for number in range(3)]
    for worker in workers:
        joined(learner, worker)
    for number in range(3):
        assert learner.send(f"w{number}".encode(), encode(Rejoin(number)))
    assert [told(worker) for worker in workers] == [[Rejoin(0)], [Rejoin(1)], [Rejoin(2)]]


def test_a_worker_in_a_thread_of_its_own(ends: Ends) -> None:
    learner = ends.learner()
    failed: list[BaseException] = []

    def work() -> None:
        try:
            link = WorkerLink(learner.address, "thread", ends.context)
            link.send(encode(HELLO))
            (message,) = told(link)
            assert isinstance(message, Rejoin)
            link.send(encode(Goodbye(message.session, "bye", ())))
            link.close()
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    ((peer, _),) = heard(learner)
    assert learner.send(peer, encode(Rejoin(17)))
    assert heard(learner) == [(b"thread", Goodbye(17, "bye", ()))]
    thread.join(DEADLINE_S)
    assert not thread.is_alive()
    assert failed == []


def test_a_worker_may_come_before_its_learner(ends: Ends) -> None:
    with plain.socket() as reserved:  # bound and not listening: nobody else gets the port, and nobody answers there
        if ends.address.startswith("tcp"):
            reserved.bind(("127.0.0.1", 0))
            ends.address = f"tcp://127.0.0.1:{reserved.getsockname()[1]}"
        worker = ends.worker(ends.address)
        worker.send(encode(HELLO))
    assert heard(ends.learner()) == [(b"w0", HELLO)]


def test_sending_never_waits_for_a_learner_that_is_not_there(ends: Ends) -> None:
    worker = ends.worker(ends.address.replace("*", "9"))
    for _ in range(3000):  # more than any default high-water mark
        worker.send(encode(HELLO))
    assert not worker.poll(0.0)


def test_a_wait_ends_when_a_watched_descriptor_can_be_read(ends: Ends) -> None:
    readable, writable = os.pipe()
    try:
        link = ends.worker(ends.learner())
        link.watch(readable)
        os.write(writable, b"x")
        began_s = time.monotonic()
        assert not link.poll(DEADLINE_S), "no message has come"
        assert time.monotonic() - began_s < DEADLINE_S / 2
    finally:
        os.close(readable)
        os.close(writable)


def test_nothing_to_receive_is_nothing(ends: Ends) -> None:
    learner = ends.learner()
    worker = ends.worker(learner)
    assert not learner.poll(0.0)
    assert not worker.poll(0.0)
    assert list(learner.receive()) == []
    assert list(worker.receive()) == []


# -------------------------------------------------------------------- arrays


def test_large_arrays_arrive_read_only_and_are_not_copied(ends: Ends) -> None:
    learner = ends.learner()
    worker = ends.worker(learner)
    joined(learner, worker)
    parameters = np.random.default_rng(0).standard_normal(COPY_BELOW_BYTES).astype(np.float32)
    assert learner.send(b"w0", encode(Weights(1, parameters, np.zeros(0, np.float32))))
    (weights,) = told(worker)
    assert isinstance(weights, Weights)
    assert np.array_equal(weights.parameters, parameters)
    assert not weights.parameters.flags.writeable
    assert not weights.parameters.flags.owndata
    assert isinstance(owner(weights.parameters), zmq.Frame)  # the bytes lie where ZeroMQ received them


def test_small_arrays_arrive_read_only(ends: Ends) -> None:
    learner = ends.learner()
    ends.worker(learner).send(encode(fake_rollout(1, 0, 0, 0, 0)))
    ((_, rollout),) = heard(learner)
    assert isinstance(rollout, Rollout)
    assert not rollout.reward.flags.writeable
    assert isinstance(owner(rollout.reward), bytes)


def owner(array: np.ndarray[tuple[int, ...], np.dtype[np.generic]]) -> object:
    """What holds the memory that an array is a view on."""
    base: object = array
    while isinstance(base, np.ndarray):
        base = base.base
    while isinstance(base, memoryview):
        base = base.obj
    return base


# -------------------------------------------------------------------- rubbish

GARBAGE: dict[str, list[bytes]] = {
    "an empty frame": [b""],
    "no head": [b"\xff" * 100],
    "a number": [b"\x07"],
    "many frames": [b"\x80"] + [b"x"] * (MAX_FRAMES - 1),
    "too many frames": [b"\x80"] + [b"x"] * 1000,
    "an unknown type": [b"\x81\xa4type\xa4Evil"],
    "deep nesting": [b"\x91" * 100_000],
    "a list that claims to be huge": [b"\xdd\xff\xff\xff\xff"],
    "a message to workers": [bytes(frame) for frame in encode(Drain("x"))],
    "a frame too few": [bytes(frame) for frame in encode(fake_rollout(1, 0, 0, 0, 0))][:-1],
    "a frame too many": [bytes(frame) for frame in encode(fake_rollout(1, 0, 0, 0, 0))] + [b""],
}


@pytest.mark.parametrize("frames", GARBAGE.values(), ids=GARBAGE.keys())
def test_garbage_comes_out_as_bad_message_with_its_sender_and_does_not_raise(tcp: Ends, frames: list[bytes]) -> None:
    learner = tcp.learner()
    raw = tcp.raw(learner)
    raw.send_multipart(frames)
    raw.send_multipart(encode(HELLO))
    (peer, error), (_, hello) = heard(learner, 2)
    assert (peer, hello) == (b"raw", HELLO)
    assert isinstance(error, BadMessage)
    assert "\n" not in str(error)


def test_a_message_of_too_many_frames_is_not_cut_to_one_that_passes(tcp: Ends) -> None:
    learner = tcp.learner()
    one = np.zeros(1, np.float32)
    most = example(
        Rollout,
        session=1,
        obs=(one,) * (MAX_FRAMES - 8),
        action=one,
        log_prob=one,
        reward=one,
        terminated=one,
        truncated=one,
        valid=one,
        state=one,
    )
    frames = encode(most)
    assert len(frames) == MAX_FRAMES
    tcp.raw(learner).send_multipart([*frames, b"one too many"])
    ((_, error),) = heard(learner)
    assert isinstance(error, BadMessage)


def test_a_worker_too_counts_the_frames(tcp: Ends) -> None:
    router = tcp.context.socket(zmq.ROUTER)
    tcp.sockets.append(router)
    router.linger = 0
    port = router.bind_to_random_port("tcp://127.0.0.1")
    worker = tcp.worker(f"tcp://127.0.0.1:{port}")
    worker.send(encode(HELLO))
    assert router.poll(int(DEADLINE_S * 1000))
    router.recv_multipart()
    router.send_multipart([b"w0", *[b"x"] * (MAX_FRAMES + 1)])
    router.send_multipart([b"w0", b"rubbish"])
    router.send_multipart([b"w0", *encode(Rejoin(1))])
    many, rubbish, rejoin = told(worker, 3)
    assert isinstance(many, BadMessage)
    assert f"1 to {MAX_FRAMES} frames" in str(many)
    assert isinstance(rubbish, BadMessage)
    assert rejoin == Rejoin(1)


def test_a_frame_above_the_limit_is_not_received_and_the_learner_lives(tcp: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(millrace.protocol.wire.socket_options, "MAX_FRAME_BYTES", 10_000)
    learner = tcp.learner()
    worker = tcp.worker(learner)
    joined(learner, worker)
    worker.send([b"x" * 10_001])
    for _ in range(100):  # its connection is closed, and comes back by itself
        worker.send(encode(HELLO))
        if learner.poll(0.1):
            break
    assert {(peer, type(message)) for peer, message in heard(learner)} == {(b"w0", Hello)}


def test_bytes_that_are_not_zeromq_do_no_harm(tcp: Ends) -> None:
    learner = tcp.learner()
    host, _, port = learner.address.removeprefix("tcp://").rpartition(":")
    with plain.create_connection((host, int(port)), timeout=DEADLINE_S) as stranger:
        stranger.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" + bytes(range(256)) * 10)
        joined(learner, tcp.worker(learner))


# -------------------------------------------------------------------- peers that come and go


def test_sending_to_an_unknown_peer_returns_false(ends: Ends) -> None:
    assert not ends.learner().send(b"nobody", encode(Rejoin(1)))


def test_a_returning_worker_takes_its_name_over(ends: Ends) -> None:
    learner = ends.learner()
    first = ends.worker(learner)
    joined(learner, first)
    first.close(linger_s=0.0)
    second = ends.worker(learner)
    joined(learner, second)
    assert learner.send(b"w0", encode(Rejoin(2)))
    assert told(second) == [Rejoin(2)]


def test_a_returning_worker_takes_over_while_its_old_connection_still_looks_open(ends: Ends) -> None:
    """As after a power failure: without ROUTER_HANDOVER it would be locked out."""
    learner = ends.learner()
    old = ends.raw(learner, b"w0")
    old.send_multipart(encode(HELLO))
    heard(learner)
    new = ends.worker(learner)
    joined(learner, new)
    assert learner.send(b"w0", encode(Rejoin(2)))
    assert told(new) == [Rejoin(2)]
    assert not old.poll(0)


def test_a_link_that_connects_again_keeps_its_name_and_hears_and_is_heard(ends: Ends) -> None:
    learner = ends.learner()
    worker = ends.worker(learner)
    joined(learner, worker)
    for session in (2, 3):
        worker.connect_again()
        joined(learner, worker)
        assert learner.send(b"w0", encode(Rejoin(session)))
        assert told(worker) == [Rejoin(session)]
    assert worker.problem is None


def test_what_was_said_last_still_goes_out_when_a_link_closes(ends: Ends) -> None:
    learner = ends.learner()
    worker = ends.worker(learner)
    joined(learner, worker)
    worker.send(encode(Goodbye(1, "bye", ())))
    worker.close()
    assert heard(learner) == [(b"w0", Goodbye(1, "bye", ()))]


LAST_WORDS = """
import sys
from millrace.protocol.messages import Goodbye
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.worker_link import WorkerLink

link = WorkerLink(sys.argv[1], "w0")
link.send([bytes(200 << 20)])  # Python frees this memory when the process ends
link.send(encode(Goodbye(1, "bye", ())))
link.close()
"""


@pytest.mark.process
def test_a_process_that_ends_behind_its_link_has_sent_everything(tcp: Ends) -> None:
    learner = tcp.learner()
    process = subprocess.run([sys.executable, "-c", LAST_WORDS, learner.address], capture_output=True, check=False)
    assert process.returncode == 0, process.stderr.decode()
    assert heard(learner, 2)[1] == (b"w0", Goodbye(1, "bye", ()))


# -------------------------------------------------------------------- addresses


def test_the_bound_address_says_which_port_was_chosen(tcp: Ends) -> None:
    address = tcp.learner().address
    assert address.startswith("tcp://127.0.0.1:")
    assert int(address.rpartition(":")[2]) > 0


@pytest.mark.parametrize("transport", ["tcp", "inproc"])
def test_an_occupied_address_is_a_usage_error_of_one_line(tcp: Ends, transport: str) -> None:
    first = tcp.learner("inproc://taken" if transport == "inproc" else None)
    with pytest.raises(UsageError) as caught:
        tcp.learner(first.address)
    assert "in use" in str(caught.value)
    assert first.address in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    "address",
    [
        "",
        "localhost:5555",
        "http://localhost:5555",
        "tcp://",
        "tcp://localhost",
        "tcp://localhost:",
        "tcp://h:port",
        "ipc://",
    ],
)
def test_an_address_that_is_none_of_ours_is_a_usage_error(address: str) -> None:
    makers: list[Callable[[], object]] = [
        lambda: check_address(address),
        lambda: LearnerLink(address),
        lambda: WorkerLink(address, "w0"),
    ]
    for make in makers:
        with pytest.raises(UsageError, match="expected"):
            make()


@pytest.mark.parametrize("address", ["tcp://192.0.2.1:5555", "tcp://no.such.host.invalid:5555", "ipc:///no/such/folder/x"])
def test_an_address_that_cannot_be_bound_here_is_a_usage_error(tcp: Ends, address: str) -> None:
    with pytest.raises(UsageError, match="cannot bind") as caught:
        tcp.learner(address)
    assert "\n" not in str(caught.value)


def test_an_address_that_cannot_be_connected_to_is_a_usage_error(tcp: Ends) -> None:
    with pytest.raises(UsageError, match="cannot connect"):
        tcp.worker("tcp://127.0.0.1:*")


def test_a_port_above_65535_is_a_usage_error() -> None:
    with pytest.raises(UsageError):
        check_address("tcp://127.0.0.1:99999")


@pytest.mark.parametrize(
    ("address", "local"),
    [
        ("inproc://x", True),
        ("ipc:///tmp/x", True),
        ("tcp://127.0.0.1:5555", True),
        ("tcp://127.0.0.2:5555", True),
        ("tcp://localhost:5555", True),
        ("tcp://[::1]:5555", True),
        ("tcp://0.0.0.0:5555", False),
        ("tcp://*:5555", False),
        ("tcp://[::]:5555", False),
        ("tcp://192.168.0.1:5555", False),
        ("tcp://localhost.example.com:5555", False),
        ("tcp://127.example.com:5555", False),
    ],
)
def test_only_what_this_machine_alone_can_reach_is_local(address: str, local: bool) -> None:
    assert is_local(address) is local


def test_the_worker_reads_what_the_learners_codec_wrote() -> None:
    """The two ends share one codec; this is what the round trips above rest on."""
    for message in TO_WORKER:
        assert same(message, decode_to_worker(encode(message)))


def test_who_only_asks_keeps_little_of_what_is_sent(tcp: Ends) -> None:
    """The address may be one that a stranger's run folder names, and what answers there may be anything."""
    learner = tcp.context.socket(zmq.ROUTER)
    tcp.sockets.append(learner)
    port = learner.bind_to_random_port("tcp://127.0.0.1")
    link = WorkerLink(f"tcp://127.0.0.1:{port}", "asks", tcp.context, limits=OF_OBSERVER)
    tcp.links.append(link)
    link.send(encode(Inquire()))
    assert learner.poll(int(1000 * DEADLINE_S))
    peer, *_ = learner.recv_multipart()
    learner.send_multipart([peer, bytes(OF_OBSERVER.frame_bytes)])
    assert link.poll(DEADLINE_S), "the largest one arrives"
    assert len(list(link.answers())) == 1
    learner.send_multipart([peer, bytes(OF_OBSERVER.frame_bytes + 1)])
    deadline_s = time.monotonic() + DEADLINE_S
    while link.connected and time.monotonic() < deadline_s:
        link.poll(0.01)
    assert not link.connected, "a larger one ends the connection"
    assert not list(link.answers())
    assert link._socket.rcvhwm == OF_OBSERVER.messages
