"""A TCP proxy in the way of a connection: it delays, slices, resets, or swallows everything. Also a process of its own.

Rule: bytes keep their order and none is changed; only when they arrive, in what pieces, and whether at all, is its own.
What it is told holds for connections that are open, too.
"""

from __future__ import annotations

import asyncio
import socket
import struct
import sys
import threading
from collections.abc import Callable, Coroutine
from contextlib import suppress
from types import TracebackType
from typing import Any

READ_BYTES = 1 << 16
QUEUED = 256  # chunks under way in one direction


class Proxy:
    """Listens on a port of address `at` and passes on to another port there. A context; its thread ends with it."""

    def __init__(self, port: int, *, at: str = "127.0.0.1", listen: int = 0) -> None:
        self.latency_s = 0.0
        """how much later each chunk arrives"""
        self.slice_bytes = 0
        """pieces in which chunks are passed on; 0: as they come"""
        self.connections = 0
        """accepted so far"""
        self._port, self._at = port, at
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._loop = asyncio.new_event_loop()
        self._server: asyncio.Server
        self._flowing = asyncio.Event()
        self._flowing.set()
        self._thread = threading.Thread(target=self._loop.run_forever, name="proxy", daemon=True)
        self._thread.start()
        self._do(self._listen(listen))

    @property
    def address(self) -> str:
        """Where a worker connects."""
        return f"tcp://{self._at}:{self._server.sockets[0].getsockname()[1]}"

    def swallow(self) -> None:
        """Pass nothing on; connections stay open, as when a cable is cut."""
        self._loop.call_soon_threadsafe(self._flowing.clear)

    def flow(self) -> None:
        """Pass everything on again, what came meanwhile first."""
        self._loop.call_soon_threadsafe(self._flowing.set)

    def reset(self) -> None:
        """End every connection with RST."""
        self._do(self._reset())

    def __enter__(self) -> Proxy:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._do(self._close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10)
        self._loop.close()

    # ---------------------------------------------------------------- in the thread

    def _do(self, work: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result(10)

    async def _listen(self, port: int) -> None:
        self._server = await asyncio.start_server(self._accept, self._at, port)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        try:
            there, back = await asyncio.open_connection(self._at, self._port)
        except OSError:  # nobody listens there
            writer.transport.abort()
            return
        self._writers |= {writer, back}
        for source, target in ((reader, back), (there, writer)):
            self._spawn(self._carry(source, target))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _carry(self, source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
        """One direction: read at once, write when it is due."""
        chunks: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(QUEUED)

        async def read() -> None:
            chunk = b" "
            while chunk:
                chunk = await source.read(READ_BYTES)
                await chunks.put((self._loop.time() + self.latency_s, chunk))

        async def write() -> None:
            while True:
                due, chunk = await chunks.get()
                await asyncio.sleep(max(0.0, due - self._loop.time()))
                await self._flowing.wait()
                if not chunk:
                    return
                size = self.slice_bytes or len(chunk)
                for start in range(0, len(chunk), size):
                    target.write(chunk[start : start + size])
                    await target.drain()
                    if self.slice_bytes:
                        await asyncio.sleep(0)

        reading = self._loop.create_task(read())
        try:
            await write()
        except OSError:  # reset by either end
            pass
        finally:
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)
            self._writers.discard(target)
            target.close()

    async def _reset(self) -> None:
        for writer in list(self._writers):
            with suppress(OSError):  # it has just been closed
                _with_reset(writer)
            writer.transport.abort()

    async def _close(self) -> None:
        self._server.close()
        await self._reset()
        self._flowing.set()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await asyncio.sleep(0)


def _with_reset(writer: asyncio.StreamWriter) -> None:
    """Closing this connection sends RST, not FIN."""
    set_option: Callable[..., None] = writer.get_extra_info("socket").setsockopt
    set_option(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def main(port: int, at: str, listen: int) -> None:
    """Proxy until stdin ends; a line there is `reset`, or `delay SECONDS`."""
    with Proxy(port, at=at, listen=listen) as proxy:
        for line in sys.stdin:
            match line.split():
                case ["reset"]:
                    proxy.reset()
                case ["delay", seconds]:
                    proxy.latency_s = float(seconds)
                case _:
                    raise ValueError(f"proxy: expected reset or delay SECONDS, got {line!r}")


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
