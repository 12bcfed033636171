"""The dashboard's sockets: they accept connections and send the answers of `site.py`. No files are written.

Rule: no client can block the server. A connection carries one request. The request's head and each part of the answer have a
deadline and a maximum size. If there are too many connections, the oldest one is closed. Pages are made one at a time in a
thread.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

from millrace.extras.monitoring.dashboard.http import PageAnswer, PageRequest, answer_parts, parsed, refusal, why_refused
from millrace.protocol.address import WILDCARDS
from millrace.protocol.errors import UsageError

log = logging.getLogger("millrace.dashboard")

MOST_CONNECTIONS = 128
MOST_HEAD_BYTES = 16_384
HEAD_WITHIN_S = 10.0
PART_WITHIN_S = 10.0

MakePage = Callable[[PageRequest], PageAnswer]


class DashboardServer:
    """Listens, and answers clients that know the token."""

    def __init__(self, make: MakePage, token: str = "") -> None:
        self._make = make
        self.token = token or secrets.token_urlsafe(24)
        self._hosts: frozenset[str] = frozenset()
        self._pages = ThreadPoolExecutor(1, "dashboard-pages")
        self._open: dict[asyncio.Task[None], None] = {}  # connections, the oldest first

    async def serve(self, host: str, port: int, listening: Callable[[str], None]) -> None:
        """Serve until cancelled. `listening` is called with the address of the first page.

        Raises `UsageError` if it can't listen there.
        """
        named = "" if host in WILDCARDS and ":" not in host else host.strip("[]")
        try:
            server = await asyncio.start_server(self._connected, named or None, port, limit=MOST_HEAD_BYTES)
        except OSError as error:
            why = error.strerror or str(error)
            raise UsageError(f"bind {host}:{port}: cannot listen there ({why}); choose another port, or 0") from error
        port = server.sockets[0].getsockname()[1]
        if host not in WILDCARDS:
            self._hosts = frozenset(f"{name}:{port}".lower() for name in (host, "localhost", "127.0.0.1", "[::1]"))
        try:
            async with server:
                listening(f"http://{host if host not in WILDCARDS else '127.0.0.1'}:{port}/{self.token}/")
                await server.serve_forever()
        finally:
            for connection in self._open:
                connection.cancel()
            await asyncio.gather(*self._open)  # these must end before the thread that they wait for
            self._pages.shutdown(wait=False, cancel_futures=True)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        writer.transport.set_write_buffer_limits(high=0)  # so that `drain` waits until the whole part is sent
        self._open[task] = None
        if len(self._open) > MOST_CONNECTIONS:
            oldest = next(iter(self._open))
            del self._open[oldest]  # so that the next new connection closes another one
            oldest.cancel()
        try:
            with suppress(
                OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, asyncio.CancelledError
            ):
                await self._answer(reader, writer)
        finally:
            self._open.pop(task, None)
            writer.transport.abort() if writer.transport.get_write_buffer_size() else writer.close()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_WITHIN_S)
        request = parsed(head.removesuffix(b"\r\n\r\n"))
        if status := why_refused(request, self.token, self._hosts):
            writer.writelines(answer_parts(request, refusal(status)))
            return
        assert request is not None
        loop = asyncio.get_running_loop()
        parts = self._made(request)
        while part := await loop.run_in_executor(self._pages, next, parts, b""):
            writer.write(part)
            await asyncio.wait_for(writer.drain(), PART_WITHIN_S)

    def _made(self, request: PageRequest) -> Iterator[bytes]:
        try:
            answer = self._make(request)
        except Exception:
            log.exception("a page could not be made")
            answer = refusal(500)
        yield from answer_parts(request, answer)
