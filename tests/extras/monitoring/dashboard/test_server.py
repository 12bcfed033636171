"""The server over real sockets: whoever does not know the token gets nothing, and nobody can hold it up."""

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from queue import Queue
from urllib.parse import urlsplit

import pytest

from millrace.extras.monitoring.dashboard import server as dashboard_server
from millrace.extras.monitoring.dashboard.command import where_to_listen
from millrace.extras.monitoring.dashboard.http import PageAnswer, PageRequest, parsed
from millrace.extras.monitoring.dashboard.server import MOST_CONNECTIONS, MOST_HEAD_BYTES, DashboardServer
from millrace.protocol.errors import UsageError

TIMEOUT_S = 20.0


@contextmanager
def served(make: Callable[[PageRequest], PageAnswer] = lambda request: PageAnswer(b"page")) -> Iterator[str]:
    """The address of a dashboard that is served in another thread."""
    found: Queue[str] = Queue()
    loop = asyncio.new_event_loop()

    async def serve() -> None:
        await DashboardServer(make).serve("127.0.0.1", 0, found.put)

    task = loop.create_task(serve())

    def run() -> None:
        asyncio.set_event_loop(loop)
        try:
            loop.run_until_complete(task)
        except asyncio.CancelledError:
            left = asyncio.all_tasks(loop)
            for each in left:
                each.cancel()
            loop.run_until_complete(asyncio.gather(*left, return_exceptions=True))
        finally:
            loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield found.get(timeout=TIMEOUT_S)
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(TIMEOUT_S)
        assert not thread.is_alive()


def connect(address: str) -> socket.socket:
    url = urlsplit(address)
    assert url.hostname is not None
    return socket.create_connection((url.hostname, url.port or 0), TIMEOUT_S)


def get(address: str, path: str | None = None, host: str = "") -> bytes:
    """The whole answer, until the server closes."""
    url = urlsplit(address)
    with closing(connect(address)) as client:
        client.sendall(f"GET {url.path if path is None else path} HTTP/1.1\r\nHost: {host or url.netloc}\r\n\r\n".encode())
        answer = b""
        while part := client.recv(1 << 16):
            answer += part
        return answer


def test_only_who_knows_the_token_gets_a_page() -> None:
    with served() as address:
        assert get(address).endswith(b"\r\n\r\npage")
        assert get(address, host=f"localhost:{urlsplit(address).port}").endswith(b"page")
        wrong, none = get(address, "/wrong/"), get(address, "/")
        assert wrong == none
        assert wrong.startswith(b"HTTP/1.1 404 ")
        assert get(address, host="evil.example").startswith(b"HTTP/1.1 421 ")
    with served() as another:
        assert urlsplit(another).path != urlsplit(address).path
        assert len(urlsplit(another).path) > 32


def test_idle_clients_do_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dashboard_server, "HEAD_WITHIN_S", 1_000.0)
    with served() as address:
        idle = [connect(address) for _ in range(MOST_CONNECTIONS + 40)]
        for client in idle[::2]:
            client.sendall(b"GET / HTTP/1.1\r\n")  # and never the rest
        try:
            assert get(address).endswith(b"page")
            assert idle[0].recv(1) == b"", "of too many, the one that has been open for longest is closed"
        finally:
            for client in idle:
                client.close()


def test_of_clients_that_come_at_once_no_more_stay_than_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    come, held = threading.Event(), threading.Event()

    def held_up(head: bytes) -> PageRequest | None:
        held.set()
        come.wait(TIMEOUT_S)
        return parsed(head)

    monkeypatch.setattr(dashboard_server, "HEAD_WITHIN_S", 1_000.0)
    monkeypatch.setattr(dashboard_server, "MOST_CONNECTIONS", 4)
    monkeypatch.setattr(dashboard_server, "parsed", held_up)
    with served() as address, closing(connect(address)) as first:
        first.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert held.wait(TIMEOUT_S)
        clients = [connect(address) for _ in range(40)]
        come.set()
        try:
            assert [client.recv(1) for client in clients[:-4]] == [b""] * 36
        finally:
            for client in clients:
                client.close()


def test_a_client_that_never_finishes_its_request_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dashboard_server, "HEAD_WITHIN_S", 0.1)
    with served() as address, closing(connect(address)) as client:
        client.sendall(b"GET /")
        assert client.recv(1) == b""


def test_a_head_that_is_too_long_is_not_read() -> None:
    with served() as address, closing(connect(address)) as client:
        try:
            client.sendall(b"GET /" + b"x" * (1 << 22))
            found = client.recv(1)
        except ConnectionError:
            found = b""
        assert found == b""
        assert MOST_HEAD_BYTES < 1 << 22


def test_a_client_that_reads_slowly_gets_the_whole_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    connected = DashboardServer._connected

    async def with_a_small_buffer(self: DashboardServer, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4_096)
        await connected(self, reader, writer)

    monkeypatch.setattr(DashboardServer, "_connected", with_a_small_buffer)
    with served(lambda request: PageAnswer(b"x" * 100_000)) as address, closing(socket.socket()) as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4_096)
        client.settimeout(TIMEOUT_S)
        url = urlsplit(address)
        client.connect((url.hostname, url.port))
        client.sendall(f"GET {url.path} HTTP/1.1\r\nHost: {url.netloc}\r\n\r\n".encode())
        received = b""
        while part := client.recv(1_024):
            received += part
            threading.Event().wait(0.001)
        assert received.count(b"x") >= 100_000


def test_a_client_that_does_not_read_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dashboard_server, "PART_WITHIN_S", 0.1)
    with served(lambda request: PageAnswer(b"x" * (1 << 25))) as address:
        url = urlsplit(address)
        with closing(connect(address)) as client:
            client.sendall(f"GET {url.path} HTTP/1.1\r\nHost: {url.netloc}\r\n\r\n".encode())
            received = len(client.recv(1))  # it has begun
            assert get(address, "/").startswith(b"HTTP/1.1 404 "), "others are answered meanwhile"
            threading.Event().wait(1.0)
            try:
                while part := client.recv(1 << 20):
                    received += len(part)
            except ConnectionError:
                pass
            assert received < 1 << 25


def test_a_page_that_cannot_be_made_says_nothing_of_why(caplog: pytest.LogCaptureFixture) -> None:
    def fails(request: PageRequest) -> PageAnswer:
        raise ValueError("a secret")

    with served(fails) as address:
        answer = get(address)
    assert answer.startswith(b"HTTP/1.1 500 ")
    assert b"secret" not in answer
    assert "a secret" in caplog.text


def test_an_address_that_others_reach_must_be_asked_for() -> None:
    assert where_to_listen("127.0.0.1:0", insecure=False) == ("127.0.0.1", 0)
    assert where_to_listen("[::1]:80", insecure=False) == ("[::1]", 80)
    assert where_to_listen("0.0.0.0:80", insecure=True) == ("0.0.0.0", 80)
    with pytest.raises(UsageError, match="anyone who learns the URL sees settings, logs and videos of these runs"):
        where_to_listen("0.0.0.0:80", insecure=False)
    for bind in ("80", ":80", "127.0.0.1:", "127.0.0.1:70000", "127.0.0.1:x"):
        with pytest.raises(UsageError, match="expected HOST:PORT"):
            where_to_listen(bind, insecure=False)


def test_a_port_in_use_is_one_line() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as other:
        port = other.getsockname()[1]
        with pytest.raises(UsageError, match=rf"bind 127.0.0.1:{port}: cannot listen there"):
            asyncio.run(DashboardServer(lambda request: PageAnswer(b"")).serve("127.0.0.1", port, print))


def test_when_it_ends_no_connection_is_left_that_would_ask_for_more_pages() -> None:
    asked, goes_on = threading.Event(), threading.Event()

    def make(request: PageRequest) -> PageAnswer:
        asked.set()
        goes_on.wait(TIMEOUT_S)
        return PageAnswer(b"page")

    async def play() -> None:
        server, address = DashboardServer(make), asyncio.Queue[str]()
        serving = asyncio.create_task(server.serve("127.0.0.1", 0, address.put_nowait))
        url = urlsplit(await asyncio.wait_for(address.get(), TIMEOUT_S))
        _, writer = await asyncio.open_connection(url.hostname, url.port)
        writer.write(f"GET {url.path} HTTP/1.1\r\nHost: {url.netloc}\r\n\r\n".encode())
        assert await asyncio.to_thread(asked.wait, TIMEOUT_S)
        serving.cancel()
        with pytest.raises(asyncio.CancelledError):
            await serving
        assert not server._open
        writer.close()

    try:
        asyncio.run(play())
    finally:
        goes_on.set()
