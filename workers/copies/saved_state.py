"""Environments that can save their state, with methods `save_state() -> bytes` and `load_state(bytes)`.

Rule: the environment or one of its wrappers may have these methods. Wrappers around the object with the methods must be
stateless, or have a state that is known here, such as the step count of `TimeLimit`. With any other wrapper around it, the
environment counts as unable to save. The state of `np_random` is kept in addition to the saved state. Nothing is unpickled
here; what `load_state` does with its bytes is up to the environment.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import msgspec
from gymnasium.wrappers import (
    ClipAction,
    FlattenObservation,
    OrderEnforcing,
    PassiveEnvChecker,
    RescaleAction,
    TimeLimit,
)

from millrace.protocol.arrays import Bytes
from millrace.protocol.bounds import MAX_SAVED_BYTES
from millrace.workers.copies.random_state import pack, repeatable, set_state, state_of

WITHOUT_STATE = (ClipAction, FlattenObservation, OrderEnforcing, PassiveEnvChecker, RescaleAction)
"""Wrappers that keep no state during an episode. Types are compared exactly, because a subclass may keep one."""


class SavedCopy(msgspec.Struct, frozen=True, array_like=True):
    """The state of one env copy."""

    state: bytes
    """the bytes that the environment saved"""
    random: bytes | None
    """state of the environment's `np_random`; None if it cannot be read"""
    elapsed: tuple[int, ...]
    """number of steps that each `TimeLimit` around the object that saves has counted, the outermost first"""


class CannotSave(Exception):
    """The state can't be kept. The exception's text says why."""


def saver(env: gymnasium.Env[Any, Any]) -> Any | None:
    """The object that can save the environment's state: the environment or one of its wrappers; None if there is none."""
    inner: Any = env
    while True:
        if callable(getattr(type(inner), "save_state", None)) and callable(getattr(type(inner), "load_state", None)):
            return inner
        if type(inner) not in (*WITHOUT_STATE, TimeLimit):
            return None
        inner = inner.env


def save(env: gymnasium.Env[Any, Any]) -> SavedCopy:
    """Save the state of an environment that can do so. Raises whatever its code raises, and `CannotSave` if the state isn't
    bytes, or is too long.
    """
    outermost = _saver(env)
    state = outermost.save_state()
    if not isinstance(state, bytes | bytearray | memoryview):
        raise CannotSave(f"save_state returned {type(state).__name__}; expected bytes")
    if len(state) > MAX_SAVED_BYTES:
        raise CannotSave(f"save_state returned {len(state):,} bytes; at most {MAX_SAVED_BYTES:,} are kept")
    return SavedCopy(
        bytes(state), pack(state_of(repeatable(env))), tuple(each._elapsed_steps or 0 for each in _limits(env, outermost))
    )


def load(env: gymnasium.Env[Any, Any], saved: SavedCopy) -> None:
    """Load this state into an environment that has been reset. Raises whatever the environment's code raises."""
    outermost = _saver(env)
    outermost.load_state(saved.state)
    if saved.random is not None:
        set_state(repeatable(env), saved.random)
    for limit, steps in zip(_limits(env, outermost), saved.elapsed, strict=True):
        limit._elapsed_steps = steps


def packed(states: list[SavedCopy]) -> bytes:
    """Encode the states of several copies as bytes."""
    return msgspec.msgpack.encode(states)


def unpacked(data: Bytes) -> list[SavedCopy]:
    """Decode the states of several copies. Raises `msgspec.ValidationError` or `msgspec.DecodeError` if that fails."""
    return msgspec.msgpack.decode(data.tobytes(), type=list[SavedCopy])


def _saver(env: gymnasium.Env[Any, Any]) -> Any:
    found = saver(env)
    assert found is not None
    return found


def _limits(env: gymnasium.Env[Any, Any], outermost: Any) -> list[Any]:
    """The `TimeLimit` wrappers around the object that saves, the outermost first."""
    limits = []
    inner: Any = env
    while inner is not outermost:
        if isinstance(inner, TimeLimit):
            limits.append(inner)
        inner = inner.env
    return limits
