"""Stand-ins for other people's simulators, as docs/how-to/simulators.md starts them. They behave as real ones do.

    python simulators.py simulator --port 5000 [--licences 127.0.0.1:4999]   # JSON lines; draws if $DISPLAY is set
    python simulators.py simulator                                           # JSON lines, from its input to its output
    python simulators.py solver                                              # one interval in the working folder
    python simulators.py licence-server --port 4999 --licences 2

Rule: what two live copies may not share is refused: a port, a folder, a licence. `$STAND_IN` (a JSON object) says what goes
wrong (`start_s`, `dies_after` and `hangs_after` steps), and what is insisted on (`draws`, `ranks`). It imports nothing of
ours, because `mpirun` runs it with the system's Python, which has mpi4py.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import random
import signal
import socket
import socketserver
import struct
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, TextIO

FAULTS: dict[str, Any] = {"start_s": 0.2, "dies_after": 0, "hangs_after": 0, "draws": False}
NO_LICENCE = 3
EPISODE = 20  # steps
HELD_S = 1.0  # how long the licence of a process that was killed stays taken


class Walk:
    """A walk on a line. The reward is for steps to the right."""

    def __init__(self, seed: int) -> None:
        self.random, self.place, self.steps = random.Random(seed), 0.0, 0

    def step(self, action: int) -> dict[str, Any]:
        """One step."""
        self.place += (1 if action else -1) * self.random.random()
        self.steps += 1
        return {**self.seen(), "reward": float(action), "ended": self.steps >= EPISODE}

    def seen(self) -> dict[str, Any]:
        """What it looks like."""
        return {"observation": [max(-10.0, min(10.0, self.place)), self.steps / EPISODE]}


def simulator(port: int, licences: str) -> None:
    """Serve one client after the other, until SIGTERM. It outlives its clients, as most servers do.

    Without a port, serve the program that started it, over pipes.
    """
    faults = {**FAULTS, **json.loads(os.environ.get("STAND_IN", "{}"))}
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with checked_out(licences) if licences else nullcontext():
        if faults["draws"]:
            draw()
        time.sleep(faults["start_s"])
        if not port:
            serve(sys.stdin, sys.stdout, faults)
            return
        with socket.create_server(("127.0.0.1", port)) as server:  # "Address already in use" if another one lives
            while True:
                with server.accept()[0] as connection, suppress(ConnectionError):
                    stream = connection.makefile("rw")
                    serve(stream, stream, faults)


def serve(questions: TextIO, answers: TextIO, faults: dict[str, Any]) -> None:
    """Answer questions until the client goes."""
    walk, steps = Walk(0), 0
    for line in questions:
        question = json.loads(line)
        if "reset" in question:
            walk = Walk(question["reset"])
            answer = walk.seen()
        else:
            answer, steps = walk.step(question["action"]), steps + 1
        if steps and steps == faults["dies_after"]:
            os.abort()
        if steps and steps == faults["hangs_after"]:
            time.sleep(1e6)
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


@contextmanager
def checked_out(server: str) -> Iterator[None]:
    """A licence, which the open connection holds. Without one the process ends."""
    host, _, port = server.rpartition(":")
    with socket.create_connection((host, int(port))) as connection:
        if connection.recv(16) != b"yes\n":
            sys.stderr.write("simulator: all licences are in use\n")
            sys.exit(NO_LICENCE)
        try:
            yield
        finally:
            connection.sendall(b"bye\n")


def draw() -> None:
    """Connect to the X server of $DISPLAY, as whatever opens a window does."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(f"/tmp/.X11-unix/X{os.environ['DISPLAY'].lstrip(':').split('.')[0]}")
        connection.sendall(struct.pack("<BxHHHHxx", ord("l"), 11, 0, 0, 0))
        if connection.recv(1) != b"\x01":
            sys.exit("simulator: cannot open display")


def solver() -> None:
    """One interval: reads control.json and state.json of the working folder, and writes state.json."""
    rank, ranks = 0, 1
    if "OMPI_COMM_WORLD_SIZE" in os.environ:
        from mpi4py import MPI  # type: ignore[import-not-found, unused-ignore]

        rank, ranks = MPI.COMM_WORLD.rank, MPI.COMM_WORLD.size
        assert MPI.COMM_WORLD.allreduce(1) == ranks
    assert ranks == json.loads(os.environ.get("STAND_IN", "{}")).get("ranks", ranks)
    if rank:
        return
    with open("solver.lock", "w") as lock:
        fcntl.flock(
            lock, fcntl.LOCK_EX | fcntl.LOCK_NB
        )  # ends with "Resource temporarily unavailable" if two share a folder
        state, control = (json.loads(Path(f"{name}.json").read_text()) for name in ("state", "control"))
        walk = Walk(state.get("seed", 0) + state["steps"])
        walk.place, walk.steps = state["place"], state["steps"]
        answer = {**walk.step(control["action"]), "place": walk.place, "steps": walk.steps, "ranks": ranks}
        Path("state.json").write_text(json.dumps({"seed": state.get("seed", 0), **answer}))


class Licences(socketserver.ThreadingTCPServer):
    """Gives each connection a licence while there is one."""

    allow_reuse_address = daemon_threads = True

    def __init__(self, port: int, licences: int) -> None:
        super().__init__(("127.0.0.1", port), Checkout)
        self.free = threading.Semaphore(licences)


class Checkout(socketserver.StreamRequestHandler):
    """One connection. A client that goes without a word keeps its licence for a while."""

    server: Licences

    def handle(self) -> None:
        """Give a licence, or say no."""
        if not self.server.free.acquire(blocking=False):
            self.wfile.write(b"no\n")
            return
        try:
            self.wfile.write(b"yes\n")
            said = b""
            with suppress(ConnectionError):
                said = self.rfile.readline()
            if not said:
                time.sleep(HELD_S)
        finally:
            self.server.free.release()


def main() -> None:
    """Be one of the three programs."""
    parser = argparse.ArgumentParser()
    parser.add_argument("program", choices=("simulator", "solver", "licence-server"))
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--licences", default="")
    flags = parser.parse_args()
    match flags.program:
        case "simulator":
            simulator(flags.port, flags.licences)
        case "solver":
            solver()
        case "licence-server":
            Licences(flags.port, int(flags.licences)).serve_forever(0.1)


if __name__ == "__main__":
    main()
