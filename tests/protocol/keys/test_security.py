"""Who gets through a learner's port, over real sockets on loopback: every wait is a poll with a deadline, nothing sleeps."""

from __future__ import annotations

import errno
import itertools
import logging
import socket as plain
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
import zmq

from millrace.learner.members.member_server import MemberServer
from millrace.learner.members.membership import REMEMBERED
from millrace.learner.rollouts.hub import Hub, HubSettings
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.protocol.address import worker_name
from millrace.protocol.errors import BadMessage, RunError, UsageError
from millrace.protocol.keys.handshake import DOMAIN, ZAP, answer
from millrace.protocol.keys.handshake_failures import (
    NO_ZEROMQ,
    ConnectionProblem,
    PendingHandshakes,
    connection_problem,
    handshake_failure,
)
from millrace.protocol.keys.key_folder import KeyFolder, Keyring
from millrace.protocol.keys.keys import ClientList, Key, Token
from millrace.protocol.messages import (
    Collect,
    Heartbeat,
    Hello,
    Inquire,
    Refuse,
    Rejoin,
    ToLearner,
    Weights,
    Welcome,
)
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.learner_link import LearnerLink
from millrace.protocol.wire.worker_link import WorkerLink
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import BUFFERS, PARAMETERS, run_spec
from tests.support.in_process.fake_processes import FakeProcesses

DEADLINE_S = 5.0  # within so long both sides must have said what is wrong
NOW = datetime(2026, 11, 21, 10, tzinfo=UTC)
SERVER, LAB, HOME, STRANGER = (Key.new() for _ in range(4))


def hello(worker: str = "w0", process_nonce: int = 1) -> Hello:
    return example(Hello, worker=worker, process_nonce=process_nonce)


def token(client: Key = LAB, server: Key = SERVER) -> Token:
    return Token(server.public, client)


class Net:
    """Makes links in contexts of their own, and closes all of them."""

    def __init__(self) -> None:
        self.links: list[LearnerLink | WorkerLink] = []
        self.contexts: list[zmq.Context[zmq.Socket[bytes]]] = []
        self.sockets: list[zmq.Socket[bytes]] = []

    def context(self) -> zmq.Context[zmq.Socket[bytes]]:
        self.contexts.append(zmq.Context())
        return self.contexts[-1]

    def learner(self, keyring: Keyring | None, address: str = "tcp://127.0.0.1:*") -> LearnerLink:
        link = LearnerLink(address, self.context(), keyring)
        self.links.append(link)
        return link

    def keyed(self) -> LearnerLink:
        allowed = ClientList().with_client("lab", LAB.public, NOW).with_client("home", HOME.public, NOW)
        return self.learner(Keyring(SERVER, allowed))

    def worker(self, learner: LearnerLink | str, token: Token | None, name: str = "w0") -> WorkerLink:
        address = learner if isinstance(learner, str) else learner.address
        link = WorkerLink(address, name, self.context(), token)
        self.links.append(link)
        return link

    def raw(self, learner: LearnerLink, token: Token, routing_id: bytes) -> zmq.Socket[bytes]:
        """A client that claims any routing id, and does not come back when it is cut off."""
        dealer = self.context().socket(zmq.DEALER)
        self.sockets.append(dealer)
        dealer.linger = 0
        dealer.routing_id = routing_id
        dealer.reconnect_ivl = -1
        dealer.curve_serverkey, dealer.curve_publickey = token.server, token.client.public
        dealer.curve_secretkey = token.client.secret
        dealer.connect(learner.address)
        return dealer

    def close(self) -> None:
        for link in self.links:
            link.close(linger_s=0.0)
        for socket in self.sockets:
            socket.close(linger=0)
        for context in self.contexts:
            context.term()  # would wait for ever for a socket that was forgotten


@pytest.fixture
def net() -> Iterator[Net]:
    net = Net()
    yield net
    net.close()


def heard(link: LearnerLink, messages: int = 1) -> list[tuple[bytes, ToLearner | Inquire | BadMessage]]:
    got: list[tuple[bytes, ToLearner | Inquire | BadMessage]] = []
    while len(got) < messages:
        assert link.poll(DEADLINE_S), f"only {len(got)} of {messages} messages arrived"
        got += link.receive()
    return got


def until(happens: Callable[[], bool], *links: LearnerLink | WorkerLink) -> None:
    """Serve these links until it happens; fails at the deadline."""
    deadline_s = time.monotonic() + DEADLINE_S
    while not happens():
        assert time.monotonic() < deadline_s, "it did not happen in time"
        for link in links:
            if link.poll(0.02):
                list(link.receive())


def lines(caplog: pytest.LogCaptureFixture, logger: str) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name == logger]


# ---------------------------------------------------------------- the answer to ZAP: pure


def asked(key: bytes = LAB.public, domain: bytes = DOMAIN, mechanism: bytes = b"CURVE") -> list[bytes]:
    return [b"1.0", b"7", domain, b"10.0.0.7", b"", mechanism, key]


KEYRING = Keyring(SERVER, ClientList().with_client("lab", LAB.public, NOW))


def test_a_key_on_the_list_is_let_in_under_its_own_name() -> None:
    reply, why = answer(asked(), KEYRING)
    assert reply == [b"1.0", b"7", b"200", b"OK", LAB.public.hex().encode(), b""]
    assert why == ""


@pytest.mark.parametrize(
    "request_",
    [
        asked(STRANGER.public),
        asked(LAB.secret),
        asked(b""),
        asked(LAB.public[:-1]),
        asked(domain=b""),
        asked(domain=b"other"),
        asked(mechanism=b"NULL"),
        asked(mechanism=b"PLAIN"),
        [b"2.0", *asked()[1:]],
        asked()[:-1],
        [*asked(), b""],
        [],
        [b"1.0"],
        [b"\xff" * 100] * 7,
    ],
)
def test_whatever_else_is_asked_is_refused_and_nothing_raised(request_: list[bytes]) -> None:
    reply, why = answer(request_, KEYRING)
    assert reply[2] == b"400"
    assert reply[4] == b""
    assert why


def test_a_list_that_raises_lets_nobody_in(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: bytes) -> str:
        raise RuntimeError("disk on fire")

    monkeypatch.setattr(KEYRING, "rejection_reason", broken)
    reply, why = answer(asked(), KEYRING)
    assert reply[2] == b"400"
    assert "disk on fire" in why


# ---------------------------------------------------------------- what is said of a handshake: pure


def test_only_a_refused_key_is_final() -> None:
    refused = connection_problem(zmq.EVENT_HANDSHAKE_FAILED_AUTH, 400, "tcp://h:1", token())
    assert refused.final
    assert LAB.public.hex()[:12] in refused.line
    for event, value in (
        (zmq.EVENT_HANDSHAKE_FAILED_AUTH, 300),
        (zmq.EVENT_HANDSHAKE_FAILED_AUTH, 500),
        (zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL, errno.EPIPE),
        (zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL, errno.EAGAIN),
        (zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH),
    ):
        for mine in (None, token()):
            assert not connection_problem(event, value, "tcp://h:1", mine).final


def test_every_complaint_is_a_line_of_its_own() -> None:
    said = {
        handshake_failure(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.PROTOCOL_ERROR_ZMTP_CRYPTOGRAPHIC, True),
        handshake_failure(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH, True),
        handshake_failure(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH, False),
        handshake_failure(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, 1, True),
        handshake_failure(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL, errno.EAGAIN, True),
        handshake_failure(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL, errno.EPIPE, True),
        handshake_failure(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL, errno.EFAULT, True),
    }
    assert len(said) == 7
    assert not [line for line in said if "\n" in line]


def test_a_failed_handshake_is_told_with_its_address_once_its_connection_ends() -> None:
    pending = PendingHandshakes(True, lambda fd: f"10.0.0.{fd}")
    failed = (zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.PROTOCOL_ERROR_ZMTP_CRYPTOGRAPHIC)
    assert pending.handle_event(zmq.EVENT_ACCEPTED, 5) is None
    assert pending.handle_event(zmq.EVENT_ACCEPTED, 6) is None
    assert pending.handle_event(*failed) is None
    assert pending.handle_event(zmq.EVENT_DISCONNECTED, 6) == ("10.0.0.6", handshake_failure(*failed, True))
    assert pending.handle_event(zmq.EVENT_DISCONNECTED, 5) == ("10.0.0.5", NO_ZEROMQ)


def test_a_worker_that_leaves_is_no_failed_handshake() -> None:
    pending = PendingHandshakes(True, lambda fd: f"10.0.0.{fd}")
    for fd in (5, 6):
        pending.handle_event(zmq.EVENT_ACCEPTED, fd)
    pending.add_approved("10.0.0.6")
    pending.handle_event(zmq.EVENT_HANDSHAKE_SUCCEEDED, 0)
    assert pending.handle_event(zmq.EVENT_DISCONNECTED, 6) is None
    assert pending.handle_event(zmq.EVENT_DISCONNECTED, 5) == ("10.0.0.5", NO_ZEROMQ)


def test_a_refused_key_is_counted_once_by_zap_alone() -> None:
    pending = PendingHandshakes(True, lambda fd: "10.0.0.7")
    pending.handle_event(zmq.EVENT_ACCEPTED, 5)
    pending.handle_event(zmq.EVENT_HANDSHAKE_FAILED_AUTH, 400)
    assert pending.handle_event(zmq.EVENT_DISCONNECTED, 5) is None


# ---------------------------------------------------------------- the handshake


def test_what_is_encrypted_is_packed_even_on_this_machine(net: Net) -> None:
    learner = net.keyed()
    assert net.worker(learner, token()).packing.stack
    assert not net.worker(learner, None, "w1").packing.stack


def test_who_has_a_token_is_heard_and_answered(net: Net) -> None:
    learner = net.keyed()
    worker = net.worker(learner, token(), "wörker")
    worker.send(encode(hello("wörker")))
    ((peer, message),) = heard(learner)
    assert message == hello("wörker")
    assert worker_name(peer) == "wörker".encode()
    assert learner.name_for_log(peer) == "lab"
    assert learner.rejection_reason(peer) == ""
    assert learner.send(peer, encode(Rejoin(3)))
    assert worker.poll(DEADLINE_S)
    assert list(worker.receive()) == [Rejoin(3)]
    assert (worker.problem, learner.refused) == (None, 0)


CASES: dict[str, tuple[bool, Token | None, str, str, bool]] = {
    # what: has the learner keys?, the worker's token, the learner says, the worker says, is that final?
    "a key that is not allowed": (True, token(STRANGER), "is not allowed here", "refused this worker's key", True),
    "another learner's token": (
        True,
        token(server=STRANGER),
        "its token is for another learner",
        "token is of another",
        False,
    ),
    "no token": (True, None, "no key|no token", "perhaps it asks for a key: give this worker --token", False),
    "a token too many": (False, token(), "shows a key|has a token", "started without keys; then leave the token", False),
}


@pytest.mark.parametrize(("keys", "mine", "learner_says", "worker_says", "final"), CASES.values(), ids=CASES.keys())
def test_both_sides_say_what_is_wrong(
    net: Net,
    caplog: pytest.LogCaptureFixture,
    keys: bool,
    mine: Token | None,
    learner_says: str,
    worker_says: str,
    final: bool,
) -> None:
    learner = net.keyed() if keys else net.learner(None)
    worker = net.worker(learner, mine)
    worker.send(encode(hello()))
    until(lambda: learner.refused > 0 and worker.problem is not None, worker)
    assert worker.problem is not None
    assert worker_says in worker.problem.line
    assert worker.problem.final is final
    (line, *_) = lines(caplog, "millrace.authenticator")
    assert "was not let in" in line
    assert any(says in line for says in learner_says.split("|"))
    assert not learner.poll(0.0)
    assert list(learner.receive()) == []


@pytest.mark.parametrize("keys", [True, False])
def test_plain_bytes_are_counted_and_do_no_harm(net: Net, keys: bool, caplog: pytest.LogCaptureFixture) -> None:
    learner = net.keyed() if keys else net.learner(None)
    host, _, port = learner.address.removeprefix("tcp://").rpartition(":")
    with plain.create_connection((host, int(port)), timeout=DEADLINE_S) as stranger:
        stranger.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" + bytes(range(256)) * 10)
    until(lambda: learner.refused == 1, learner)
    worker = net.worker(learner, token() if keys else None)
    worker.send(encode(hello()))
    got: list[ToLearner | Inquire | BadMessage] = []
    while hello() not in got:
        got += [message for _, message in heard(learner)]
    assert not (keys and len(got) > 1), "what came without a key was read"
    assert {type(message) for message in got} <= {Hello, BadMessage}
    assert "was not let in" in lines(caplog, "millrace.authenticator")[0]


def test_who_connects_and_says_nothing_is_shown_out(net: Net) -> None:
    learner = net.keyed()
    host, _, port = learner.address.removeprefix("tcp://").rpartition(":")
    with plain.create_connection((host, int(port)), timeout=DEADLINE_S) as silent:
        silent.settimeout(DEADLINE_S)
        while silent.recv(1000):  # ZeroMQ's greeting, then the end
            pass
    until(lambda: learner.refused == 1, learner)


def test_a_worker_at_another_kind_of_server_says_so(net: Net) -> None:
    with plain.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(DEADLINE_S)
        worker = net.worker(f"tcp://127.0.0.1:{server.getsockname()[1]}", token())
        connection, _ = server.accept()
        with connection:
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        until(lambda: worker.problem is not None, worker)
    assert worker.problem is not None
    assert not worker.problem.final
    assert worker.address in worker.problem.line


def test_a_worker_at_a_name_that_nobody_knows_says_so(net: Net) -> None:
    worker = net.worker("tcp://no.such.host.invalid:5555", token())
    assert worker.problem == ConnectionProblem(
        "the host of tcp://no.such.host.invalid:5555 is not known here; is it spelled right?"
    )


def test_trouble_that_is_over_is_forgotten(net: Net) -> None:
    first = net.learner(Keyring(STRANGER, ClientList()))
    worker = net.worker(first, token())
    until(lambda: worker.problem is not None, worker)
    address = first.address
    first.close(0.0)
    first.context.term()  # then the port is free
    learner = net.learner(Keyring(SERVER, ClientList().with_client("lab", LAB.public, NOW)), address)
    worker.send(encode(hello()))
    until(lambda: worker.problem is None, worker)
    assert [message for _, message in heard(learner)] == [hello()]


def end_the_authenticator(learner: LearnerLink) -> None:
    """As if its thread had died."""
    assert learner._authenticator is not None
    learner._authenticator._end_sender.send(b"")
    learner._authenticator.join(DEADLINE_S)


def test_no_client_connects_while_zap_is_not_answered(net: Net) -> None:
    """The server's two options are what shuts the port then: it fails without either."""
    learner = net.keyed()
    end_the_authenticator(learner)
    worker = net.worker(learner, token())
    worker.send(encode(hello()))
    until(lambda: worker.problem is not None, worker)
    assert not learner._socket.poll(300)


def test_a_dead_authenticator_ends_the_run(net: Net) -> None:
    learner = net.keyed()
    end_the_authenticator(learner)
    with pytest.raises(RunError, match="its thread has ended"):
        learner.poll(0.0)


def test_the_authenticator_answers_while_the_learner_learns(net: Net) -> None:
    """Nobody polls the learner's link here."""
    learner = net.keyed()
    good, bad = net.worker(learner, token()), net.worker(learner, token(STRANGER), "w1")
    until(lambda: good.connected and bad.problem is not None, good, bad)


def test_whatever_goes_wrong_with_one_visitor_the_next_is_answered(net: Net, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []

    def once(request: list[bytes], keyring: Keyring) -> tuple[list[bytes], str]:
        calls.append(1)
        if len(calls) == 1:
            raise RuntimeError("a fault of ours")
        return answer(request, keyring)

    monkeypatch.setattr("millrace.protocol.keys.handshake.answer", once)
    learner = net.keyed()
    net.worker(learner, token(), "first")
    until(lambda: len(calls) == 1)
    worker = net.worker(learner, token())
    worker.send(encode(hello()))
    assert (worker_name(heard(learner)[0][0]), learner.poll(0.0)) == (b"w0", False)


def test_a_malformed_zap_request_does_not_stop_the_authenticator(net: Net) -> None:
    learner = net.keyed()
    odd = learner.context.socket(zmq.DEALER)
    net.sockets.append(odd)
    odd.connect(ZAP)
    for frames in ([b""], [b"", b"1.0"], [b"x"] * 50):
        odd.send_multipart(frames)
    worker = net.worker(learner, token())
    worker.send(encode(hello()))
    heard(learner)


def test_two_learners_with_keys_need_a_context_each(net: Net) -> None:
    first = net.keyed()
    with pytest.raises(UsageError, match="needs a ZeroMQ context of its own"):
        LearnerLink("tcp://127.0.0.1:*", first.context, Keyring(SERVER, ClientList()))


# ---------------------------------------------------------------- what an eavesdropper sees


class Tap(threading.Thread):
    """Passes one connection on to the learner, and keeps what went by."""

    def __init__(self, learner: LearnerLink) -> None:
        super().__init__(daemon=True)
        self.seen = bytearray()
        self._to = int(learner.address.rpartition(":")[2])
        self._server = plain.create_server(("127.0.0.1", 0))
        self._server.settimeout(DEADLINE_S)
        self.address = f"tcp://127.0.0.1:{self._server.getsockname()[1]}"
        self.start()

    def run(self) -> None:
        with self._server, self._server.accept()[0] as near, plain.create_connection(("127.0.0.1", self._to)) as far:
            poller = zmq.Poller()
            poller.register(near.fileno(), zmq.POLLIN)
            poller.register(far.fileno(), zmq.POLLIN)
            ways = {near.fileno(): (near, far), far.fileno(): (far, near)}
            while ready := poller.poll(int(DEADLINE_S * 1000)):
                for descriptor, _ in ready:
                    source, sink = ways[int(descriptor)]
                    try:
                        data = source.recv(65536)
                        sink.sendall(data)
                    except OSError:
                        return
                    if not data:
                        return
                    self.seen += data


@pytest.mark.parametrize("keys", [True, False])
def test_an_eavesdropper_reads_everything_without_keys_and_nothing_with_them(net: Net, keys: bool) -> None:
    learner = net.keyed() if keys else net.learner(None)
    tap = Tap(learner)
    worker = net.worker(tap.address, token() if keys else None, "a-worker-of-note")
    worker.send(encode(hello("a-worker-of-note")))
    ((peer, _),) = heard(learner)
    learner.send(peer, encode(Refuse("a reason of note")))
    assert worker.poll(DEADLINE_S)
    assert list(worker.receive()) == [Refuse("a reason of note")]
    worker.close(0.0)
    tap.join(DEADLINE_S)
    assert not tap.is_alive()
    assert len(tap.seen) > 200
    for text in (b"a-worker-of-note", b"a reason of note", b"Hello"):
        assert (text in tap.seen) is not keys
    assert LAB.secret not in tap.seen
    assert LAB.public not in tap.seen


# ---------------------------------------------------------------- a session is bound to its key


def coordinator(workers: int = 2) -> TicketCoordinator:
    return TicketCoordinator(run_spec(workers), RolloutDealer(workers, Rounds(0)), worker_timeout_s=60.0, first_session=1000)


def hub_of(link: LearnerLink) -> Hub:
    hub = Hub(link, coordinator(), HubSettings(no_workers_timeout_s=60, stall_timeout_s=60, max_env_failures=3))
    hub.publish(0, PARAMETERS, BUFFERS)
    return hub


def serve(hub: Hub, happens: Callable[[], bool], *workers: WorkerLink) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not happens():
        assert time.monotonic() < deadline_s, "it did not happen in time"
        hub._listen(0.02)
        for worker in workers:
            worker.poll(0.0)


def test_another_key_cannot_speak_in_a_workers_session_nor_take_it_over(net: Net) -> None:
    """Not even one that knows its routing id, which is a secret."""
    learner = net.keyed()
    hub = hub_of(learner)
    worker = net.worker(learner, token(LAB))
    worker.send(encode(hello()))
    serve(hub, lambda: len(hub.coordinator.members) == 1)
    ((peer, member),) = hub.coordinator.members.items()
    routing_id = peer.rpartition(b"\0")[0]
    lanes = set(member.lanes)
    thief = net.raw(learner, token(HOME), routing_id)
    for message in (example(Heartbeat, session=member.session), hello(process_nonce=2)):
        thief.send_multipart(encode(message))
    serve(hub, lambda: len(hub.coordinator.members) == 2)
    assert hub.coordinator.members[peer] is member, "the session was replaced"
    assert member.heartbeat is None, "another key's heartbeat was taken for this one's"
    assert member.hello.process_nonce == 1
    assert member.lanes <= lanes
    other = next(m for p, m in hub.coordinator.members.items() if p != peer)
    assert other.session != member.session
    assert learner.name_for_log(other.peer) == "home"


def test_what_is_meant_for_one_key_is_not_sent_to_another(net: Net) -> None:
    learner = net.keyed()
    worker = net.worker(learner, token(LAB))
    worker.send(encode(hello()))
    ((mine, _),) = heard(learner)
    thief = net.raw(learner, token(HOME), mine.rpartition(b"\0")[0])
    thief.send_multipart(encode(hello(process_nonce=2)))
    ((theirs, _),) = heard(learner)
    assert mine != theirs
    assert not learner.send(mine, encode(Rejoin(1)))
    assert learner.send(theirs, encode(Rejoin(2)))
    assert thief.poll(int(DEADLINE_S * 1000))
    assert thief.recv_multipart() == [bytes(frame) for frame in encode(Rejoin(2))]


def test_nobody_can_guess_a_routing_id_of_another_key(net: Net) -> None:
    learner = net.keyed()
    ids = []
    for client in (LAB, HOME, LAB):
        worker = net.worker(learner, token(client))
        worker.send(encode(hello()))
        ids.append(heard(learner)[0][0].rpartition(b"\0")[0])
        worker.close(0.0)
    assert ids[0] == ids[2], "a worker that was started again does not take its own place"
    assert ids[0] != ids[1]
    assert {worker_name(one) for one in ids} == {b"w0"}


def test_two_workers_of_one_name_and_two_keys_do_not_disturb_each_other(net: Net) -> None:
    learner = net.keyed()
    hub = hub_of(learner)
    workers = [net.worker(learner, token(client)) for client in (LAB, HOME)]
    for number, worker in enumerate(workers):
        worker.send(encode(hello(process_nonce=number)))
    serve(hub, lambda: len(hub.coordinator.members) == 2)
    for worker in workers:
        assert worker.poll(DEADLINE_S)
        got = list(worker.receive())
        assert {type(message) for message in got} <= {Welcome, Weights, Collect}
        session = next(message.session for message in got if isinstance(message, Welcome))
        worker.send(encode(example(Heartbeat, session=session)))
    serve(hub, lambda: all(member.heartbeat is not None for member in hub.coordinator.members.values()))


def test_the_table_of_who_spoke_last_stays_small(net: Net, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("millrace.protocol.wire.learner_link.MAX_REMEMBERED_KEYS", 10)
    learner = net.keyed()
    for number in range(100):
        learner._peer(b"%d" % number, LAB.public.hex())
    assert list(learner._last_keys) == [b"%d" % number for number in range(90, 100)]


# ---------------------------------------------------------------- revoking


def test_who_is_revoked_is_cut_off_at_once_and_told(net: Net, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = KeyFolder(tmp_path / "keys")
    tokens = [Token.from_text(folder.new(name, NOW).read_text(), "") for name in ("lab", "home")]
    learner = net.learner(Keyring(folder.server(), folder.allowed(), folder))
    hub = hub_of(learner)
    workers = [net.worker(learner, one, f"w{number}") for number, one in enumerate(tokens)]
    for number, worker in enumerate(workers):
        worker.send(encode(hello(f"w{number}", number)))
    serve(hub, lambda: len(hub.coordinator.members) == 2)
    session = min(member.session for member in hub.coordinator.members.values())
    folder.revoke("lab", NOW)
    serve(hub, lambda: len(hub.coordinator.members) == 1, *workers)
    (left,) = hub.coordinator.members.values()
    assert left.hello.worker == "w1"
    assert left.lanes == {0, 1}, "the lanes of the one that was cut off are nobody's"

    got: list[object] = []
    while not any(isinstance(message, Refuse) for message in got):
        assert workers[0].poll(DEADLINE_S)
        got += workers[0].receive()
    assert any(isinstance(message, Refuse) and "was revoked" in message.reason for message in got)

    workers[0].send(encode(hello("w0", 9)))  # its connection is still there
    workers[0].send(encode(example(Heartbeat, session=session)))
    serve(hub, lambda: learner.refused_messages == 2)
    assert len(hub.coordinator.members) == 1
    assert workers[0].poll(DEADLINE_S)
    assert all(isinstance(message, Refuse) for message in workers[0].receive())

    again = net.worker(learner, tokens[0], "w2")
    serve(hub, lambda: again.problem is not None, again)
    assert again.problem is not None
    assert again.problem.final
    assert any("was revoked" in line for line in lines(caplog, "millrace.authenticator"))


def test_messages_of_a_revoked_key_take_no_longer_than_a_turn(net: Net, tmp_path: Path) -> None:
    folder = KeyFolder(tmp_path / "keys")
    lab = Token.from_text(folder.new("lab", NOW).read_text(), "")
    learner = net.learner(Keyring(folder.server(), folder.allowed(), folder))
    worker = net.worker(learner, lab, "w0")
    worker.send(encode(Inquire()))
    ((peer, _),) = heard(learner)
    folder.revoke("lab", NOW)
    until(lambda: learner.rejection_reason(peer) != "")
    for _ in range(50):
        worker.send(encode(Inquire()))
    hub = hub_of(learner)
    now = itertools.count()
    server = MemberServer(learner, hub.coordinator, hub, FakeProcesses(), clock=lambda: float(next(now)))
    server.receive(DEADLINE_S, turn_s=3.0)
    assert learner.refused_messages <= 4
    serve(hub, lambda: learner.refused_messages == 50)
    assert not hub.coordinator.members


def test_revoking_is_noticed_while_the_learner_learns(net: Net, tmp_path: Path) -> None:
    folder = KeyFolder(tmp_path / "keys")
    lab = Token.from_text(folder.new("lab", NOW).read_text(), "")
    learner = net.learner(Keyring(folder.server(), folder.allowed(), folder))
    folder.revoke("lab", NOW)
    keyring = learner.keyring
    assert keyring is not None
    until(lambda: keyring.rejection_reason(lab.client.public) != "")  # nobody polls


# ---------------------------------------------------------------- rubbish and floods


def test_rubbish_makes_few_lines_and_ends_a_session(net: Net, caplog: pytest.LogCaptureFixture) -> None:
    learner = net.keyed()
    hub = hub_of(learner)
    worker = net.worker(learner, token())
    worker.send(encode(hello()))
    for _ in range(200):
        worker.send([b"rubbish"])
    serve(hub, lambda: hub.coordinator.rollouts.ledger.messages_bad == 200)
    assert not hub.coordinator.members
    assert len([line for line in lines(caplog, "millrace.learner") if "message from" in line]) == 1


def test_strangers_make_few_lines(net: Net, caplog: pytest.LogCaptureFixture) -> None:
    learner = net.keyed()
    port = int(learner.address.rpartition(":")[2])
    for _ in range(100):
        with plain.create_connection(("127.0.0.1", port), timeout=DEADLINE_S) as stranger:
            stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
    until(lambda: learner.refused == 100, learner)
    assert len(lines(caplog, "millrace.authenticator")) <= 4


def test_who_comes_under_ever_new_names_does_not_fill_the_memory() -> None:
    logging.disable(logging.CRITICAL)
    learner = coordinator()
    for number in range(3 * REMEMBERED):
        peer = b"w%d" % number
        learner.receive(peer, hello(f"w{number}", number), 0.0)
        for _ in range(3):
            learner.reject_message(peer, "rubbish", 0.0)
    logging.disable(logging.NOTSET)
    assert not learner.members
    assert len(learner.membership._refused) == REMEMBERED
    assert isinstance(learner.receive(peer, hello(f"w{number}", number), 0.0)[0][1], Refuse), "it came back"


def test_an_ipv6_address_works_with_and_without_keys(net: Net) -> None:
    if not plain.has_ipv6:
        pytest.skip("no IPv6 here")
    for keyring, mine in ((None, None), (Keyring(SERVER, ClientList().with_client("lab", LAB.public, NOW)), token())):
        learner = net.learner(keyring, "tcp://[::1]:*")
        assert learner.address.startswith("tcp://[::1]:")
        worker = net.worker(learner, mine)
        worker.send(encode(hello()))
        assert [message for _, message in heard(learner)] == [hello()]
