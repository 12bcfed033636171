"""Environments that save their state: an Atari game, a MuJoCo task, and a simulator behind a TCP connection.

    python examples/saved_states.py

When a worker is lost or a run is resumed, a new env copy continues from the state of the old one, without replaying its
steps. No wrapper outside of these may have a state of its own: frames that are stacked outside, for example, would be
missing.
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
    """Saves an Atari game with the state of its emulator's random generator, and its numbers of lives and frames."""

    def save_state(self) -> bytes:
        """The state in the emulator's own format."""
        game: Any = self.unwrapped
        state: bytes = game.clone_state(include_rng=True).serialize()
        return state

    def load_state(self, state: bytes) -> None:
        """Restore the game."""
        from ale_py import ALEState

        game: Any = self.unwrapped
        game.restore_state(ALEState(state))


class MujocoState(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Saves everything that MuJoCo's next step depends on, and the bodies' positions, from which tasks compute rewards."""

    def save_state(self) -> bytes:
        """The numbers of `mjSTATE_INTEGRATION`, followed by the positions of all bodies, as float64."""
        task: Any = self.unwrapped
        numbers = np.empty(self._size())
        mujoco.mj_getState(task.model, task.data, numbers, INTEGRATION)
        state: bytes = numbers.tobytes() + task.data.xpos.tobytes() + task.data.xipos.tobytes()
        return state

    def load_state(self, state: bytes) -> None:
        """Restore the numbers twice, because what MuJoCo computes from them changes the state before its next step."""
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
    """A simulator that answers `reset`, `step`, `save` and `load` over TCP. A request is a kind byte, a length, and data."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, port: int) -> None:
        self._connection = socket.create_connection(("127.0.0.1", port), timeout=60)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode with a seed drawn from `np_random`, so that the simulator is deterministic."""
        super().reset(seed=seed)
        answer = self._ask(b"r", struct.pack("<q", int(self.np_random.integers(2**31))))
        return np.frombuffer(answer[:8], np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Request one step."""
        answer = self._ask(b"s", bytes([int(action)]))
        reward, ended = struct.unpack("<d?", answer[8:17])
        return np.frombuffer(answer[:8], np.float32), reward, ended, False, {}

    def save_state(self) -> bytes:
        """The simulator's answer to a `save` request."""
        return self._ask(b"w", b"")

    def load_state(self, state: bytes) -> None:
        """Send the state to the simulator."""
        self._ask(b"l", state)

    def close(self) -> None:
        """Close the connection."""
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
    """Train on Pong with saved games. If you kill a worker meanwhile, its lanes continue, and no step is replayed."""
    return millrace.train("ALE/Pong-v5", wrappers=[AtariState], env_kwargs={"obs_type": "ram"}, **settings)


if __name__ == "__main__":
    print(train(steps=20_000, workers=2, envs=4, lanes=4).path)
