"""Which environments count as ones that save their state, and what is kept of it."""

from __future__ import annotations

import struct
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import FrameStackObservation, NormalizeReward, TimeLimit

from millrace.protocol.bounds import MAX_SAVED_BYTES
from millrace.workers.copies.saved_state import CannotSave, load, packed, save, saver, unpacked
from tests.support.envs.toy import Countdown


class Walk(gymnasium.Env[Any, Any]):
    """Draws each step from `np_random`."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self) -> None:
        self.place = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.place = float(self.np_random.normal())
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.place += float(self.np_random.normal()) + action
        return self._seen(), self.place, False, False, {}

    def _seen(self) -> Any:
        return np.array([self.place], np.float32)


class Saves(Walk):
    def save_state(self) -> Any:
        return struct.pack("d", self.place)

    def load_state(self, state: bytes) -> None:
        (self.place,) = struct.unpack("d", state)


class SavesFromOutside(gymnasium.Wrapper[Any, Any, Any, Any]):
    def save_state(self) -> bytes:
        return b""

    def load_state(self, state: bytes) -> None: ...


def test_the_outermost_that_saves_is_asked_and_nothing_outside_may_have_a_state_of_its_own() -> None:
    env = Saves()
    assert saver(env) is env
    assert saver(TimeLimit(env, 5)) is env
    assert saver(NormalizeReward(env)) is None
    assert saver(FrameStackObservation(env, 2)) is None
    outside = SavesFromOutside(NormalizeReward(env))
    assert saver(outside) is outside
    assert saver(Walk()) is None
    assert saver(Countdown()) is None


def test_a_loaded_copy_goes_on_as_the_saved_one_does_with_its_random_numbers_and_its_time_limit() -> None:
    one, other = (TimeLimit(Saves(), 6) for _ in range(2))
    one.reset(seed=1)
    one.step(0)
    one.step(1)
    (state,) = unpacked(np.frombuffer(packed([save(one)]), np.uint8))
    went_on = [one.step(1) for _ in range(4)]
    other.reset(seed=2)
    load(other, state)
    loaded = [other.step(1) for _ in range(4)]
    assert [answer[1:4] for answer in loaded] == [answer[1:4] for answer in went_on]
    assert loaded[-1][3], "the time limit has come"


@pytest.mark.parametrize(
    ("state", "says"),
    [("text", "returned str; expected bytes"), (bytes(MAX_SAVED_BYTES + 1), "returned 4,194,305 bytes; at most 4,194,304")],
)
def test_what_cannot_be_kept_is_said(state: Any, says: str) -> None:
    env = Saves()
    env.reset(seed=1)
    env.save_state = lambda: state  # type: ignore[method-assign]
    with pytest.raises(CannotSave, match=says):
        save(env)
