"""An environment whose simulator is a process of its own, as real ones are: it binds port 5000 + slot and has a folder.

    python slot_env.py FOLDER PORT     # serves clients, and says so in FOLDER/taken if its port or folder is taken

Rule: the simulator dies every few hundred steps. It imports nothing of ours, so that it starts fast. Its parent sees the end
of a start that failed; `taken` is for the test, because a run goes on after such an end.
"""

from __future__ import annotations

import fcntl
import os
import random
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

EPISODE = 20  # steps
DIES_AFTER = (150, 400)  # steps


def simulator(folder: Path, port: int) -> None:
    """Serve one client after the other with lines of text, until it dies. It outlives its clients, as most servers do."""

    def taken(what: str) -> None:
        with (folder / "taken").open("a") as report:
            report.write(f"{what}\n")
        sys.exit(1)

    own = folder / str(port)
    own.mkdir(exist_ok=True)
    with (own / "state").open("a") as state:
        try:
            fcntl.flock(state, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            taken(f"folder {own}")
        try:
            server = socket.create_server(("127.0.0.1", port))
        except OSError as error:
            taken(f"port {port}: {error}")
        with (folder / "started").open("a") as started:
            started.write(f"{port}\n")
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        lives = random.randint(*DIES_AFTER)
        while True:
            with server.accept()[0] as client:
                for number, _ in enumerate(client.makefile()):
                    if number == lives:
                        os.abort()
                    client.sendall(f"{number % EPISODE / EPISODE}\n".encode())


if __name__ == "__main__":
    simulator(Path(sys.argv[1]), int(sys.argv[2]))
    sys.exit()

import gymnasium  # noqa: E402 (the simulator needs none of this)
import numpy as np  # noqa: E402


class SlotEnv(gymnasium.Env[Any, Any]):
    """Asks its simulator for each observation."""

    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, port: int) -> None:
        command = [sys.executable, "-I", "-S", __file__, os.environ["SIMULATORS"], str(port)]
        self._simulator = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        assert self._simulator.stdout is not None
        if self._simulator.stdout.readline() != b"ready\n":
            raise OSError(f"the simulator of port {port} did not start")
        self._connection = socket.create_connection(("127.0.0.1", port))
        self._lines = self._connection.makefile()
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        super().reset(seed=seed)
        self._steps = 0
        return self._ask("reset"), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step, which gives 1 for action 1."""
        self._steps += 1
        return self._ask(str(action)), float(action), self._steps >= EPISODE, False, {}

    def _ask(self, line: str) -> Any:
        self._connection.sendall(f"{line}\n".encode())
        if not (answer := self._lines.readline()):
            raise ConnectionError("the simulator has died")
        return np.array([float(answer)], np.float32)

    def close(self) -> None:
        """End the simulator."""
        self._lines.close()
        self._connection.close()
        self._simulator.terminate()
        self._simulator.wait(10)
        if self._simulator.stdout is not None:
            self._simulator.stdout.close()
