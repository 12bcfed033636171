"""A TCP proxy, which can delay data, cut it into pieces, reset connections, or forward nothing.

Rule: the proxy does not change bytes or their order. It only decides when they arrive, in what pieces, and whether they
arrive. Commands also apply to connections that are already open. It can also run as a separate process.
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
QUEUED = 256  # chunks on their way in one direction


class Proxy:
    """Listens on a port of address `at` and forwards to another port there. A context manager, which ends its thread."""

    def __init__(self, port: int, *, at: str = "127.0.0.1", listen: int = 0) -> None:
        self.latency_s = 0.0
        """seconds by which each chunk is delayed"""
        self.slice_bytes = 0
        """size of the pieces in which data is forwarded, in bytes; 0: as it arrives"""
        self.connections = 0
        """number of connections accepted so far"""
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
        """The address to which a worker connects."""
        return f"tcp://{self._at}:{self._server.sockets[0].getsockname()[1]}"

    def swallow(self) -> None:
        """Forward nothing. Connections stay open, as when a cable is cut."""
        self._loop.call_soon_threadsafe(self._flowing.clear)

    def flow(self) -> None:
        """Forward everything again, beginning with what arrived in the meantime."""
        self._loop.call_soon_threadsafe(self._flowing.set)

    def freeze(self) -> None:
        """Forward nothing more over the connections that are open now, and keep them open. New ones work."""
        self._do(self._freeze())

    def reset(self) -> None:
        """Reset every connection (RST)."""
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
        except OSError:  # nothing listens at the target
            writer.transport.abort()
            return
        self._writers |= {writer, back}
        for source, target in ((reader, back), (there, writer)):
            self._spawn(self._carry(source, target, self._flowing))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _carry(self, source: asyncio.StreamReader, target: asyncio.StreamWriter, flowing: asyncio.Event) -> None:
        """Forward one direction: read at once, write when the delay has passed."""
        chunks: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(QUEUED)

        async def read() -> None:
            chunk = b" "
            while chunk:
                try:
                    chunk = await source.read(READ_BYTES)
                except OSError:  # the source reset the connection
                    chunk = b""
                await chunks.put((self._loop.time() + self.latency_s, chunk))

        async def write() -> None:
            while True:
                due, chunk = await chunks.get()
                await asyncio.sleep(max(0.0, due - self._loop.time()))
                await flowing.wait()
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
        except OSError:  # one end reset the connection
            pass
        finally:
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)
            self._writers.discard(target)
            target.close()

    async def _freeze(self) -> None:
        self._flowing.clear()
        self._flowing = asyncio.Event()
        self._flowing.set()

    async def _reset(self) -> None:
        for writer in list(self._writers):
            with suppress(OSError):  # the connection was just closed
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
    """Make closing this connection send RST instead of FIN."""
    set_option: Callable[..., None] = writer.get_extra_info("socket").setsockopt
    set_option(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def main(port: int, at: str, listen: int) -> None:
    """Run the proxy until stdin ends. A line of stdin is a command: `reset`, `freeze` or `delay SECONDS`."""
    with Proxy(port, at=at, listen=listen) as proxy:
        for line in sys.stdin:
            match line.split():
                case ["reset"]:
                    proxy.reset()
                case ["freeze"]:
                    proxy.freeze()
                case ["delay", seconds]:
                    proxy.latency_s = float(seconds)
                case _:
                    raise ValueError(f"proxy: expected reset, freeze or delay SECONDS, got {line!r}")


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
