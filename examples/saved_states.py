"""Environments that save their state: an Atari game, a MuJoCo task, and a simulator behind a TCP connection.

    python examples/saved_states.py

When a worker is lost, or a run is resumed, another env copy goes on where the lost one was, without repeating its steps. The
wrappers stand where nothing outside of them remembers anything: frames that are stacked outside would be missing.
"""

from __future__ import annotations

import socket
import struct
from contextlib import suppress
from typing import Any

import gymnasium
import numpy as np

import millrace

with suppress(ImportError):
    import mujoco

    INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION


class AtariState(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Saves an Atari game with its emulator's random numbers, and how many lives and frames it has had."""

    def save_state(self) -> bytes:
        """The emulator's own format."""
        game: Any = self.unwrapped
        state: bytes = game.clone_state(include_rng=True).serialize()
        return state

    def load_state(self, state: bytes) -> None:
        """Put it back."""
        from ale_py import ALEState

        game: Any = self.unwrapped
        game.restore_state(ALEState(state))


class MujocoState(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Saves all from which MuJoCo computes its next step, and where the bodies were: tasks compute rewards from it."""

    def save_state(self) -> bytes:
        """The numbers of `mjSTATE_INTEGRATION`, then the places of all bodies, float64."""
        task: Any = self.unwrapped
        numbers = np.empty(self._size())
        mujoco.mj_getState(task.model, task.data, numbers, INTEGRATION)
        state: bytes = numbers.tobytes() + task.data.xpos.tobytes() + task.data.xipos.tobytes()
        return state

    def load_state(self, state: bytes) -> None:
        """Put them back: twice, because what MuJoCo computes from them changes what its next step begins with."""
        task: Any = self.unwrapped
        numbers, places = np.split(np.frombuffer(state), [self._size()])
        mujoco.mj_setState(task.model, task.data, numbers, INTEGRATION)
        mujoco.mj_forward(task.model, task.data)
        mujoco.mj_setState(task.model, task.data, numbers, INTEGRATION)
        task.data.xpos[:], task.data.xipos[:] = places.reshape(2, -1, 3)

    def _size(self) -> int:
        task: Any = self.unwrapped
        size: int = mujoco.mj_stateSize(task.model, INTEGRATION)
        return size


class TcpSimulator(gymnasium.Env[Any, Any]):
    """A simulator that answers `reset`, `step`, `save` and `load` over TCP: a byte that says what, a length, and bytes."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, port: int) -> None:
        self._connection = socket.create_connection(("127.0.0.1", port), timeout=60)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode from a seed of `np_random`, so that the simulator repeats itself."""
        super().reset(seed=seed)
        answer = self._ask(b"r", struct.pack("<q", int(self.np_random.integers(2**31))))
        return np.frombuffer(answer[:8], np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Ask for one step."""
        answer = self._ask(b"s", bytes([int(action)]))
        reward, ended = struct.unpack("<d?", answer[8:17])
        return np.frombuffer(answer[:8], np.float32), reward, ended, False, {}

    def save_state(self) -> bytes:
        """What the simulator writes when it is asked to save."""
        return self._ask(b"w", b"")

    def load_state(self, state: bytes) -> None:
        """Let the simulator read it."""
        self._ask(b"l", state)

    def close(self) -> None:
        """Hang up."""
        self._connection.close()

    def _ask(self, what: bytes, content: bytes) -> bytes:
        self._connection.sendall(what + struct.pack("<I", len(content)) + content)
        (size,) = struct.unpack("<I", self._receive(4))
        return self._receive(size)

    def _receive(self, size: int) -> bytes:
        received = b""
        while len(received) < size:
            part = self._connection.recv(size - len(received))
            if not part:
                raise ConnectionError("the simulator has hung up")
            received += part
        return received


def train(**settings: Any) -> millrace.Run:
    """Train on Pong whose games are saved. If you kill a worker meanwhile, its lanes go on, and no step is repeated."""
    return millrace.train("ALE/Pong-v5", wrappers=[AtariState], env_kwargs={"obs_type": "ram"}, **settings)


if __name__ == "__main__":
    print(train(steps=20_000, workers=2, envs=4, lanes=4).path)
