"""A run's environment as plain data, how to make it, and how much code a learner may make a worker run.

Only this file may unpickle, and only in `PickledCallable.load`: a callable that the *learner* sent to a worker that allows
`AllowedCode.CALLABLES`. Nothing that a worker sends is ever unpickled.

Rule: things that other processes can find by name are sent by name. Things that only this process has (a function, class or
registered id defined in a script or notebook) are sent as a pickled callable, with the specs of the ids that this callable
may request from gymnasium.
"""

from __future__ import annotations

import dataclasses
import importlib
import traceback
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from importlib.util import find_spec
from typing import Any, TypeVar

import gymnasium
import msgspec
from gymnasium.envs.registration import EnvSpec as GymnasiumSpec
from gymnasium.envs.registration import VectorizeMode
from gymnasium.vector import VectorEnv

from millrace.protocol.bounds import one_line
from millrace.protocol.envs.found_names import MAIN, found_by_others, in_main, last_part, name_of, names_a_function
from millrace.protocol.envs.make_env import made_by_callable, made_by_id, made_without_checker, why_not_made
from millrace.protocol.envs.seats import has_seats, seated
from millrace.protocol.envs.unknown_ids import (
    ids_of_gymnasium,
    is_registered,
    load_plugins,
    plugin_modules,
    registered_by_plugins,
)
from millrace.protocol.envs.which_copy import filled
from millrace.protocol.envs.wrappers import WrapperLike, not_named, wrap, wrapper_names
from millrace.protocol.errors import UsageError, first_line, safe_repr

# The module that registers the environments of each namespace. An id in one of these namespaces is passed to gymnasium as
# `module:id`, so that gymnasium imports the module.
REGISTERING_MODULES = {"millrace": "millrace.extras.envs", "ALE": "ale_py"}
MAX_CALLABLE_BYTES = 1 << 26
Scalar = bool | int | float | str
EnvLike = str | GymnasiumSpec | Callable[..., object]
"""An id that `gymnasium.make` accepts, the name of a function or class that returns an environment, gymnasium's `EnvSpec`,
or a callable that returns an environment.
"""
_Made = TypeVar("_Made")


class AllowedCode(Enum):
    """Which code a worker runs for its learner. It depends on whether the worker can trust the learner."""

    REGISTERED = 0
    """only environments that are registered on the worker's machine, by id, and their attributes without a leading
    underscore; for any learner
    """
    MODULES = 1
    """also `module:EnvId`, which imports the module; for a learner on this machine"""
    CALLABLES = 2
    """also pickled callables, and functions and classes that the learner names; for a learner whose key is known, or that
    only this user can have started
    """

    def refuses_to_call(self, what: str) -> str:
        """Why a worker that allows only this code does not call `what`, whether named or pickled; empty if it does.

        A name can be any function of any module, with any arguments, so it can do as much as a pickled callable.
        """
        if self is AllowedCode.CALLABLES:
            return ""
        return (
            f"{what} is a function or a class to call, which this worker does not do for a learner it is not sure of; "
            "it may come over ipc, inproc or with a token (and not with --no-code)"
        )


FACTORY = "an environment factory"
REGISTER_IT = (
    "; or register an id for it (gymnasium.register in a module that workers have) and name it as my_module:MyEnv-v0"
)


class PickledCallable:
    """A callable, pickled by cloudpickle. It is sent in its own frame."""

    __slots__ = ("data",)

    def __init__(self, data: bytes) -> None:
        self.data = data

    @classmethod
    def of(cls, made: Callable[..., object], what: str) -> PickledCallable:
        """Pickle a callable. `what` names it in errors. Raises `UsageError` if it can't be sent."""
        import cloudpickle

        try:
            data = cloudpickle.dumps(made)
        except Exception as error:  # any type of error: the callable may refer to any object
            raise UsageError(
                f"{what}: its callable cannot be sent to workers: {type(error).__name__}: {first_line(error)}; let it make "
                "what it needs when it is called"
            ) from error
        if len(data) > MAX_CALLABLE_BYTES:
            raise UsageError(
                f"{what}: expected its callable to pickle to at most {MAX_CALLABLE_BYTES:,} bytes, got "
                f"{len(data):,}; let it load its data when it is called, from a file that every worker can read"
            )
        return cls(data)

    def load(self) -> Callable[..., object]:
        """Unpickle the callable. Only a worker that allows `AllowedCode.CALLABLES` may do so."""
        import cloudpickle

        factory: Callable[..., object] = cloudpickle.loads(self.data)
        return factory

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PickledCallable) and other.data == self.data

    def __hash__(self) -> int:
        return hash(self.data)

    def __repr__(self) -> str:
        return f"PickledCallable({len(self.data)} bytes)"


def check_arguments(arguments: Mapping[str, Any], of: str, makes: str = "gymnasium.make(ID, {name}={name})") -> None:
    """Raise `UsageError` for a keyword argument that no message can carry.

    `of`: what the arguments are for, as the error says it. `makes`: for a value of another type, the error suggests that the
    user put this call into a function of their own.
    """
    for name, value in arguments.items():
        try:
            if not isinstance(value, Scalar):  # msgspec would encode a date, for example, as text
                raise TypeError
            msgspec.msgpack.decode(msgspec.msgpack.encode({name: value}), type=dict[str, Scalar])
        except (TypeError, ValueError, OverflowError) as error:  # a msgspec.ValidationError is also a ValueError
            raise UsageError(
                f"{of}: argument {name}: expected a number of at most 64 bits, text, True or False, got "
                f"{type(value).__name__} {one_line(safe_repr(value), 60)}; for others, pass a function in place of the "
                f"name: lambda: {makes.format(name=name)}"
            ) from error


class EnvSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The environment: a gymnasium id, the name of a function that makes it, or a factory that the learner pickled."""

    id: str
    """any id that `gymnasium.make` accepts: `CartPole-v1`, `ALE/Pong-v5`, `my_package.envs:MyEnv-v0`; or a function or
    class, `my_package.envs:MyEnv`, that returns an environment
    """
    kwargs: dict[str, Scalar] = {}
    """keyword arguments for `gymnasium.make`. A string may contain expressions in braces, such as `{5000 + slot}`, which are
    computed for each copy: integers, `+ - * // %`, and at least one of `number`, `lane`, `copy` and `slot`
    (`millrace.EnvCopy`). A worker that cannot compute them declines the run
    """
    factory: PickledCallable | None = None
    """a cloudpickled callable that returns one environment; `id` is then only its name"""
    wrappers: tuple[str, ...] = ()
    """wrappers of every copy, the innermost first: `module:Class`, or `module:Class(key=value)` with plain values. A factory
    applies the wrappers itself; this field then only lists their names.
    """
    eval_kwargs: dict[str, Scalar] = {}
    """keyword arguments for evaluation copies, in addition to `kwargs`; they override those of the same name"""

    @staticmethod
    def of(
        env: EnvLike | EnvSpec,
        kwargs: dict[str, Scalar] | None = None,
        wrappers: Sequence[WrapperLike] = (),
        eval_kwargs: dict[str, Scalar] | None = None,
    ) -> EnvSpec:
        """Make a spec from the user's argument: an id or a name, gymnasium's `EnvSpec`, or a callable that takes `kwargs`.

        Each of `wrappers` takes an environment and returns one, or is the name of such a callable. For `eval_kwargs`, see
        the field. Raises `UsageError` for names that can't be found, a callable that is too large to send, and arguments
        that no message can carry.
        """
        if isinstance(env, EnvSpec):
            return env
        name, factory = _given(env)
        name = env if isinstance(env, str) else name
        check_arguments({**(kwargs or {}), **(eval_kwargs or {})}, f"environment {name}")
        names = wrapper_names(wrappers)
        own = [not_named(wrapper) for wrapper in wrappers]
        pickled = None
        if factory is not None or any(wrapper is not None for wrapper in own):
            layers = [name if wrapper is None else wrapper for name, wrapper in zip(names, own, strict=True)]
            pickled = _pickled(name, factory, tuple(layers))
        return EnvSpec(name, kwargs or {}, pickled, names, eval_kwargs or {})

    def for_evaluation(self) -> EnvSpec:
        """The spec for evaluation copies: `eval_kwargs` are merged into `kwargs`."""
        if not self.eval_kwargs:
            return self
        return msgspec.structs.replace(self, kwargs=self.kwargs | self.eval_kwargs, eval_kwargs={})

    def rejection_reason(self, code: AllowedCode) -> str:
        """Why a worker that allows only this code cannot make the environment, or an empty string if it can."""
        if self.factory is not None and code is not AllowedCode.CALLABLES:
            return (
                f"environment {self.id} is a callable, which this worker does not unpickle; it may come over ipc, inproc or "
                f"with a token (and not with --no-code){REGISTER_IT}"
            )
        if self.factory is None and (":" in self.id or names_a_function(self.id)) and code is AllowedCode.REGISTERED:
            return (
                f"environment {self.id} imports a module, which this worker does not do for a learner it is not sure of; "
                "give it a token (and not --no-code), or name an id that a package installed there registers by itself "
                "(entry point gymnasium.envs)"
            )
        if self.wrappers:
            return code.refuses_to_call(f"wrapper {self.wrappers[0]}")
        refused = code.refuses_to_call(f"environment {self.id}") if names_a_function(self.id) else ""
        return f"{refused}{REGISTER_IT}" if refused else ""

    @property
    def called_code(self) -> str:
        """The factory or wrapper that a worker must call for the learner, in words; empty if there is only an id."""
        if self.factory is not None or names_a_function(self.id):
            return FACTORY
        return "a wrapper" if self.wrappers else ""

    def kwargs_of_copy(self) -> dict[str, Any]:
        """The keyword arguments for the copy that is being made. Raises `UsageError` if an expression can't be computed."""
        return filled(self.kwargs, self.id)

    def make(self, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """Make one env copy, including its wrappers.

        A PettingZoo environment becomes one with seats. Raises `UsageError`, with advice, if the environment or a package
        cannot be found. If a constructor raised, the error's `detail` is the traceback.
        """
        made = self.make_as_given(render_mode)
        return seated(made, self.id) if has_seats(made) else made

    def make_as_given(self, render_mode: str | None = None) -> Any:
        """Like `make`, but a PettingZoo environment is returned as it is."""
        kwargs = self.kwargs_of_copy() | ({} if render_mode is None else {"render_mode": render_mode})
        if self.factory is not None:
            return made_by_callable(self.id, self.factory.load(), kwargs)
        env = self._made(lambda env_id: made_by_id(env_id, kwargs))
        for wrapper in self.wrappers:
            env = wrap(env, wrapper)
        return env

    def make_vectorized(self, copies: int) -> VectorEnv[Any, Any, Any]:
        """Make `copies` copies in the environment's own vectorized form, whatever its autoreset mode."""
        own = VectorizeMode.VECTOR_ENTRY_POINT
        kwargs = self.kwargs_of_copy()
        return self._made(lambda env_id: gymnasium.make_vec(env_id, copies, own, **kwargs))

    def registered(self) -> gymnasium.envs.registration.EnvSpec:
        """Gymnasium's registry entry for the id. Raises `UsageError` if there is none."""

        def look_up(env_id: str) -> gymnasium.envs.registration.EnvSpec:
            module, colon, name = env_id.partition(":")
            if colon:
                importlib.import_module(module)
            return gymnasium.spec(name if colon else env_id)

        return self._made(look_up)

    def _made(self, make: Callable[[str], _Made]) -> _Made:
        """Call `make` with the id. Turns every exception into a `UsageError` that says why the environment can't be made."""
        registrar = REGISTERING_MODULES.get(self.id.partition("/")[0])
        plain = registrar is None and ":" not in self.id and not names_a_function(self.id)
        failed = load_plugins(self.id) if plain and not is_registered(self.id) else []
        try:
            return make(f"{registrar}:{self.id}" if registrar and find_spec(registrar) else self.id)
        except UsageError:
            raise
        except (gymnasium.error.Error, ImportError, TypeError) as error:  # TypeError: wrong keyword arguments
            raise UsageError(why_not_made(self.id, error, failed, _why_not)) from error
        except Exception as error:  # an environment's constructor can raise anything
            line = f"environment {self.id} cannot be made: {type(error).__name__}: {first_line(error)}"
            raise UsageError(line, traceback.format_exc()) from error


def _why_not(env_id: str) -> str:
    """Why a registered environment that the user may have meant can't be made, or an empty string if it can.

    For an id with a module, returns an empty string, so that no function is called.
    """
    if ":" in env_id:
        return ""
    load_plugins(env_id)
    if not is_registered(env_id):
        return "it is not registered"
    try:
        EnvSpec(env_id).make().close()
    except UsageError as error:
        return str(error)
    except BaseException as error:  # the environment's `close` may raise anything
        return f"{type(error).__name__}: {first_line(error)}"
    return ""


# ------------------------------------------------------------------------------------- things that only this process has


class _Factory:
    """A callable that makes an environment and wraps it. This is the object that gets pickled."""

    def __init__(
        self,
        name: str,
        env: Callable[..., object] | None,
        wrappers: tuple[WrapperLike, ...],
        specs: tuple[GymnasiumSpec, ...] = (),
    ) -> None:
        """`env` returns the environment without wrappers. If it is None, `name` is the id of the environment.

        `specs` are the specs of ids that a new process may not know, and that the user's code may request from gymnasium.
        """
        self._name = name
        self._env = env
        self._wrappers = wrappers
        self._specs = specs

    def __call__(self, render_mode: str | None = None, **kwargs: Scalar) -> Any:
        for spec in self._specs:
            gymnasium.registry.setdefault(spec.id, spec)
        if self._env is None:
            env = EnvSpec(self._name, kwargs).make_as_given(render_mode)
        else:
            env = made_by_callable(
                self._name, self._env, kwargs | ({} if render_mode is None else {"render_mode": render_mode})
            )
        for wrapper in self._wrappers:
            env = wrap(env, wrapper)
        return env


class _UnpickledLater:
    """A class or function that is unpickled only when called, so a process that never calls it doesn't need its modules."""

    def __init__(self, point: Callable[..., object]) -> None:
        """Pickle `point`. Raises `UsageError` if it can't be sent."""
        self._point = PickledCallable.of(point, "environment")

    def __call__(self, **kwargs: Any) -> Any:
        return self._point.load()(**kwargs)


def _pickled(name: str, env: Callable[..., object] | None, wrappers: tuple[WrapperLike, ...]) -> PickledCallable:
    """The factory, pickled, without the specs if those can't be pickled. Raises `UsageError` if it can't be sent."""
    try:
        specs = tuple(_perhaps_needed(spec) for spec in gymnasium.registry.values() if not _is_gymnasiums(spec))
        return PickledCallable.of(_Factory(name, env, wrappers, specs), f"environment {name}")
    except UsageError:
        return PickledCallable.of(_Factory(name, env, wrappers), f"environment {name}")


def _perhaps_needed(spec: GymnasiumSpec) -> GymnasiumSpec:
    """Like `_sent`, for a spec that may never be used: its class or function is only unpickled when it is called."""
    sent = _sent(spec)
    return dataclasses.replace(sent, entry_point=_UnpickledLater(sent.entry_point)) if callable(sent.entry_point) else sent


class _SpecFactory:
    """A callable that makes an environment from gymnasium's `EnvSpec`, in a process where this spec is not registered."""

    def __init__(self, spec: GymnasiumSpec) -> None:
        self._spec = _sent(spec)

    def __call__(self, **kwargs: Any) -> gymnasium.Env[Any, Any]:
        return made_without_checker(self._spec, kwargs)


def _sent(spec: GymnasiumSpec) -> GymnasiumSpec:
    """The spec in a form that another process can use.

    A class defined in this script is part of the spec itself, because its name means nothing elsewhere. A class that
    gymnasium can import is given by its name, so that only a process that makes this environment needs the module.
    """
    point = spec.entry_point
    name = point if isinstance(point, str) else name_of(point)
    module, _, qualname = name.partition(":")
    if callable(own := in_main(name)):
        return dataclasses.replace(spec, entry_point=own)
    return dataclasses.replace(spec, entry_point=name) if module == _module_of(spec) and "." not in qualname else spec


def remembered_name(env: EnvLike | EnvSpec) -> str:
    """The name under which a run records an environment that was passed as a Python object, so that a resume can find it."""
    return env.id if isinstance(env, EnvSpec) else _named(env)[0]


def _given(env: EnvLike) -> tuple[str, Callable[..., object] | None]:
    """The name of the user's argument, and a callable that makes the environment if workers can't find it by that name.

    Raises `UsageError` if the argument is only a name and this process can't find it either.
    """
    name, factory = _named(env)
    if factory is None and not found_by_others(name):
        last = "my_env" if "lambda" in name else last_part(name)
        raise UsageError(
            f"environment {name} was made in a script, a notebook or a function, and cannot be found here; go on where it "
            f"was made, or name a module that has or registers it, as my_module:{last} (train: ENV; evaluate, record: --env)"
        )
    return name, factory


def _named(env: EnvLike) -> tuple[str, Callable[..., object] | None]:
    match env:
        case str():
            return _registered_here(env)
        case GymnasiumSpec():
            return (env.id, None) if _is_of_everyone(env) else _registered_here(env.id, env)
        case _ if callable(env):
            return name_of(env), env
        case _:
            raise UsageError(
                f"environment: expected an id, a gymnasium EnvSpec or a callable that returns one, got {env!r:.100}"
            )


def _registered_here(env_id: str, given: GymnasiumSpec | None = None) -> tuple[str, Callable[..., object] | None]:
    """The name to send for an id, and a callable that makes the environment if it is registered in this process only."""
    module, _, plain = env_id.rpartition(":")
    if module not in ("", MAIN):
        return env_id, None
    if module == MAIN and callable(own := in_main(env_id)):
        return env_id, own
    known = gymnasium.registry.get(plain)
    if given is not None and given is not known:
        return f"<{plain}>", _SpecFactory(given)
    if known is None or _is_of_everyone(known):
        return env_id, None
    return f"{MAIN}:{plain}", _SpecFactory(known)


def _is_of_everyone(spec: GymnasiumSpec) -> bool:
    """Whether a new process knows this spec, because it comes unchanged from gymnasium, millrace or a plugin."""
    known = gymnasium.registry.get(spec.id)
    try:
        if known is None or spec != known:
            return False
    except ValueError:  # arrays among the keyword arguments, which can't be compared with !=
        return False
    if _is_gymnasiums(spec) or spec.namespace in REGISTERING_MODULES:
        return True
    return _module_of(spec).partition(".")[0] in plugin_modules() and registered_by_plugins(spec.id)


def _is_gymnasiums(spec: GymnasiumSpec) -> bool:
    """Whether gymnasium itself registers this spec. The id must match too: anyone can register gymnasium's classes under
    other ids.
    """
    return spec.id in ids_of_gymnasium() and _module_of(spec).partition(".")[0] == "gymnasium"


def _module_of(spec: GymnasiumSpec) -> str:
    """The module of the class or function that makes the environment."""
    where = spec.entry_point if isinstance(spec.entry_point, str) else getattr(spec.entry_point, "__module__", "")
    return where.partition(":")[0]
