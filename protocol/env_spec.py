"""The environment of a run as plain data, how to make it, and how much code a learner may have a worker run.

Only this file may unpickle, and only in `PickledCallable.load`: a callable that the *learner* sent to a worker which allows
`AllowedCode.CALLABLES`. Nothing that a worker sends is ever unpickled.
"""

from __future__ import annotations

import importlib
import traceback
from collections.abc import Callable
from enum import Enum
from importlib.util import find_spec
from typing import Any, TypeVar

import gymnasium
import msgspec
from gymnasium.envs.registration import VectorizeMode
from gymnasium.vector import VectorEnv

from protocol.errors import UsageError, first_line

# By namespace: the module that registers its environments. The id is then passed to gymnasium as `module:id`, so that
# gymnasium imports the module.
REGISTERING_MODULES = {"millrace": "workers.envs", "ALE": "ale_py"}
MAX_CALLABLE_BYTES = 1 << 26
Scalar = bool | int | float | str
_Made = TypeVar("_Made")


class AllowedCode(Enum):
    """Which code a worker runs for its learner. It depends on how surely the worker knows the learner."""

    REGISTERED = 0
    """only environments that are registered on the worker's machine, by id, and their attributes without a leading
    underscore: the learner may be anybody
    """
    MODULES = 1
    """also `module:EnvId`, which imports the module: the learner runs on this machine"""
    CALLABLES = 2
    """also pickled callables: the learner's key is known, or only this user can have started it"""


class PickledCallable:
    """A callable, pickled by cloudpickle. It travels in a frame of its own."""

    __slots__ = ("data",)

    def __init__(self, data: bytes) -> None:
        self.data = data

    @classmethod
    def of(cls, made: Callable[..., object], what: str) -> PickledCallable:
        """Pickle a callable. `what` names it in errors. Raises `UsageError` for one that cannot be sent."""
        import cloudpickle

        data = cloudpickle.dumps(made)
        if len(data) > MAX_CALLABLE_BYTES:
            raise UsageError(
                f"{what}: expected its callable to pickle to at most {MAX_CALLABLE_BYTES:,} bytes, got "
                f"{len(data):,}; let it load its data when it is called, from a file that every worker can read"
            )
        return cls(data)

    def load(self) -> Callable[..., object]:
        """The callable. For a worker that allows `AllowedCode.CALLABLES`."""
        import cloudpickle

        found: Callable[..., object] = cloudpickle.loads(self.data)
        return found

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PickledCallable) and other.data == self.data

    def __hash__(self) -> int:
        return hash(self.data)

    def __repr__(self) -> str:
        return f"PickledCallable({len(self.data)} bytes)"


class EnvSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The environment: a gymnasium id, or a factory that the learner pickled."""

    id: str
    """any id that `gymnasium.make` takes: `CartPole-v1`, `ALE/Pong-v5`, `my_package.envs:MyEnv-v0`"""
    kwargs: dict[str, Scalar] = {}
    """keyword arguments of `gymnasium.make`"""
    factory: PickledCallable | None = None
    """a cloudpickled callable that returns one environment; `id` is then only its name"""

    @staticmethod
    def of(env: str | Callable[[], object], kwargs: dict[str, Scalar] | None = None) -> EnvSpec:
        """Make a spec from an id, or from a callable that takes `kwargs` and returns a `gymnasium.Env`.

        Raises `UsageError` for a callable that is too large to send.
        """
        if isinstance(env, str):
            return EnvSpec(env, kwargs or {})
        name = getattr(env, "__name__", type(env).__name__)
        return EnvSpec(name, kwargs or {}, PickledCallable.of(env, f"environment {name}"))

    def rejection_reason(self, code: AllowedCode) -> str:
        """Why a worker that allows only this code cannot make it; empty if it can."""
        if self.factory is not None and code is not AllowedCode.CALLABLES:
            return (
                f"environment {self.id} is a callable, which this worker does not unpickle; it may come over ipc, inproc or "
                "with a token (and not with --no-code), else name it as my_module:MyEnv-v0"
            )
        if self.factory is None and ":" in self.id and code is AllowedCode.REGISTERED:
            return (
                f"environment {self.id} imports a module, which this worker does not do for a learner it cannot be sure of; "
                "give it a token (and not --no-code)"
            )
        return ""

    def make(self, render_mode: str | None = None) -> gymnasium.Env[object, object]:
        """Make one env copy. Raises `UsageError`, with advice, if the id is unknown or a package is missing."""
        extra: dict[str, object] = {} if render_mode is None else {"render_mode": render_mode}
        if self.factory is not None:
            env = self.factory.load()(**self.kwargs, **extra)
            if not isinstance(env, gymnasium.Env):
                raise UsageError(f"env factory {self.id}: expected it to return a gymnasium.Env, got {type(env).__name__}")
            return env
        # Without gymnasium's checker: it costs a tenth of a CartPole step, and `protocol.rollout.validate` checks every row.
        return self._made(lambda env_id: gymnasium.make(env_id, disable_env_checker=True, **self.kwargs, **extra))  # type: ignore[arg-type]

    def make_vectorized(self, copies: int) -> VectorEnv[Any, Any, Any]:
        """Make `copies` copies in the environment's own vectorized form; `protocol.envs.vectorized` checks it."""
        own, kwargs = VectorizeMode.VECTOR_ENTRY_POINT, dict[str, Any](self.kwargs)
        return self._made(lambda env_id: gymnasium.make_vec(env_id, copies, own, **kwargs))

    def registered(self) -> gymnasium.envs.registration.EnvSpec:
        """Gymnasium's registry entry of the id. Raises `UsageError`."""

        def look_up(env_id: str) -> gymnasium.envs.registration.EnvSpec:
            module, colon, name = env_id.partition(":")
            if colon:
                importlib.import_module(module)
            return gymnasium.spec(name if colon else env_id)

        return self._made(look_up)

    def _made(self, make: Callable[[str], _Made]) -> _Made:
        """Call `make` with the id. Raises `UsageError`."""
        registrar = REGISTERING_MODULES.get(self.id.partition("/")[0])
        try:
            return make(f"{registrar}:{self.id}" if registrar and find_spec(registrar) else self.id)
        except (gymnasium.error.Error, ImportError, TypeError) as error:  # TypeError: keyword arguments it does not take
            raise UsageError(_make_error(self.id, error)) from error
        except Exception as error:  # its constructor raised any exception
            line = f"environment {self.id} cannot be made: {type(error).__name__}: {first_line(error)}"
            raise UsageError(line, traceback.format_exc()) from error


def _make_error(env_id: str, error: Exception) -> str:
    """One line for an environment that is not known, or whose package is missing."""
    module, colon, _ = env_id.partition(":")
    says = first_line(error)
    match error:
        case gymnasium.error.NamespaceNotFound() if env_id.startswith("ALE/"):
            return f"environment {env_id}: Atari games are an extra; pip install 'millrace-rl[atari]'"
        case gymnasium.error.DependencyNotInstalled():
            return f"environment {env_id}: {says}"
        case ModuleNotFoundError() if colon and f"'{module.split('.')[0]}" in says:
            return f"environment {env_id}: no module named {module}; is it installed, or its folder on PYTHONPATH?"
        case ImportError():
            return f"environment {env_id}: a package it needs is missing ({says}); pip install it, then try again"
        case gymnasium.error.Error() if "vector entry point" in says:
            return (
                f"environment {env_id} has no vectorized form of its own (gymnasium's vector_entry_point); use --vector loop"
            )
        case gymnasium.error.UnregisteredEnv() if not colon:
            return f"environment {env_id} is not registered: {says} One of your own is given as my_module:MyEnv-v0"
        case _:
            return f"environment {env_id} cannot be made: {says}"
