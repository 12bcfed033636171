"""examples/saved_states.py: a copy that loads a state goes on as the saved one does."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import suppress
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
import pytest

from examples import saved_states
from millrace.workers.copies.saved_state import load, save, saver


def play(env: gymnasium.Env[Any, Any], actions: list[Any]) -> list[tuple[Any, ...]]:
    return [env.step(action)[:4] for action in actions]


def check_that_it_goes_on(one: gymnasium.Env[Any, Any], other: gymnasium.Env[Any, Any]) -> None:
    assert saver(one) is not None
    one.action_space.seed(0)
    actions = [one.action_space.sample() for _ in range(60)]
    one.reset(seed=1)
    play(one, actions[:30])
    state = save(one)
    went_on = play(one, actions[30:])
    other.reset(seed=2)
    load(other, state)
    for loaded, saved in zip(play(other, actions[30:]), went_on, strict=True):
        np.testing.assert_array_equal(loaded[0], saved[0])
        assert loaded[1:] == saved[1:]
    one.close()
    other.close()


@pytest.mark.skipif(find_spec("ale_py") is None, reason="no emulator: pip install ale-py")
def test_an_atari_game_goes_on_with_its_random_repetitions() -> None:
    import ale_py

    gymnasium.register_envs(ale_py)
    games = [gymnasium.make("ALE/Breakout-v5", obs_type="ram", repeat_action_probability=0.25) for _ in range(2)]
    one, other = map(saved_states.AtariState, games)
    check_that_it_goes_on(one, other)


@pytest.mark.skipif(find_spec("mujoco") is None, reason="no MuJoCo: pip install mujoco")
@pytest.mark.parametrize("task", ["HalfCheetah-v5", "Ant-v5"])
def test_a_task_of_mujoco_goes_on_bit_for_bit(task: str) -> None:
    one, other = (saved_states.MujocoState(gymnasium.make(task)) for _ in range(2))
    check_that_it_goes_on(one, other)


class Simulator(threading.Thread):
    """A simulator for one connection after another."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._listens = socket.create_server(("127.0.0.1", 0))
        self.port = self._listens.getsockname()[1]

    def run(self) -> None:
        with suppress(OSError):
            while True:
                connection = self._listens.accept()[0]
                threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def stop(self) -> None:
        self._listens.close()

    def _serve(self, connection: socket.socket) -> None:
        place = np.zeros(2, np.float32)
        with suppress(ConnectionError, struct.error), connection, connection.makefile("rwb") as stream:
            while True:
                what = stream.read(1)
                content = stream.read(struct.unpack("<I", stream.read(4))[0])
                answer = b""
                if what == b"r":
                    place = np.random.default_rng(struct.unpack("<q", content)[0]).normal(size=2).astype(np.float32)
                    answer = place.tobytes()
                elif what == b"s":
                    place = (place * np.float32(0.9) + content[0]).astype(np.float32)
                    answer = place.tobytes() + struct.pack("<d?", float(place.sum()), False)
                elif what == b"w":
                    answer = place.tobytes()
                elif what == b"l":
                    place = np.frombuffer(content, np.float32).copy()
                stream.write(struct.pack("<I", len(answer)) + answer)
                stream.flush()


@pytest.fixture
def port() -> Iterator[int]:
    simulator = Simulator()
    simulator.start()
    yield simulator.port
    simulator.stop()


def test_a_simulator_behind_a_connection_goes_on(port: int) -> None:
    check_that_it_goes_on(saved_states.TcpSimulator(port), saved_states.TcpSimulator(port))
