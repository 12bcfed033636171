"""Wrappers of an environment by name: `module:Class`, or `module:Class(key=value)` with plain values.

Rule: the arguments are Python literals (numbers, text, lists, dicts, None), which are parsed and never evaluated. Names are
imported where the environment is made, that is, in a worker.
"""

from __future__ import annotations

import ast
import functools
import traceback
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium

from millrace.protocol.bounds import one_line
from millrace.protocol.envs.advice.several_agents import what_it_lacks
from millrace.protocol.envs.found_names import found_by_others, in_main, last_part, name_of
from millrace.protocol.envs.seats import has_seats
from millrace.protocol.errors import UsageError, first_line, safe_repr
from millrace.protocol.own_module import own_callable

Wrapper = Callable[..., Any]
WrapperLike = str | Wrapper
"""`module:Class`, with or without plain arguments, or a callable that takes an environment and returns one."""
MAX_WRAPPER_NAME = 1000


class NamedWrapper(NamedTuple):
    """A parsed name of a wrapper."""

    module: str
    qualname: str
    args: tuple[Any, ...]
    kwargs: dict[str, Any]


def read_wrapper(text: str) -> NamedWrapper:
    """Parse `module:Class` or `module:Class(key=value)`. Raises `UsageError` for anything else."""
    module, colon, rest = text.partition(":")
    qualname, bracket, _ = rest.partition("(")
    words = [*module.split("."), *qualname.split(".")]
    if not colon or not all(word.isidentifier() for word in words) or len(text) > MAX_WRAPPER_NAME:
        raise UsageError(
            f"wrapper {one_line(text, 200)}: expected module:Class, or module:Class(key=value) with plain values, as in "
            "gymnasium.wrappers:FlattenObservation"
        )
    if not bracket:
        return NamedWrapper(module, qualname, (), {})
    try:
        match ast.parse(rest, mode="eval").body:
            case ast.Call(func, args, keywords) if ast.unparse(func) == qualname and all(each.arg for each in keywords):
                values = tuple(ast.literal_eval(arg) for arg in args)
                named = {str(each.arg): ast.literal_eval(each.value) for each in keywords}
                return NamedWrapper(module, qualname, values, named)
    except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError):
        pass
    raise UsageError(
        f"wrapper {one_line(text, 200)}: expected arguments that are plain values (numbers, text, lists), as in "
        "gymnasium.wrappers:FilterObservation(filter_keys=['image'])"
    )


def wrapper_name(wrapper: WrapperLike) -> str:
    """The name under which a run records a wrapper. Raises `UsageError` for a string that isn't a wrapper's name."""
    if isinstance(wrapper, str):
        if found_by_others(wrapper):
            read_wrapper(wrapper)
        return wrapper
    if not callable(wrapper):
        raise UsageError(f"wrappers: expected functions, classes or module:Class, got {type(wrapper).__name__}")
    if not isinstance(wrapper, functools.partial):
        return name_of(wrapper)
    name = name_of(wrapper.func)
    arguments = [*map(safe_repr, wrapper.args), *(f"{key}={safe_repr(value)}" for key, value in wrapper.keywords.items())]
    named = f"{name}({', '.join(arguments)})"
    try:
        read = read_wrapper(named)
        plain = (read.args, read.kwargs) == (wrapper.args, wrapper.keywords)
    except (UsageError, ValueError):  # ValueError: arrays cannot be compared
        plain = False
    return named if plain and found_by_others(name) else f"<{last_part(name)}>"


def wrapper_names(wrappers: Sequence[WrapperLike]) -> tuple[str, ...]:
    """The `wrapper_name` of each wrapper. Raises `UsageError` if a wrapper has none."""
    return tuple(map(wrapper_name, wrappers))


def not_named(wrapper: WrapperLike) -> Wrapper | None:
    """The wrapper itself, if other processes can't find it by its name; else None.

    Raises `UsageError` if only the name was given, and this process can't find the wrapper either.
    """
    name = wrapper_name(wrapper)
    if found_by_others(name):
        return None
    if not isinstance(wrapper, str):
        return wrapper
    named = in_main(name)
    if not callable(named):
        last = "my_wrapper" if "lambda" in name else last_part(name)
        raise UsageError(
            f"wrapper {name} was made in a script, a notebook or a function, and cannot be found here; pass it again: "
            f"wrappers=[{last}] there, or --wrappers my_module:{last} from a module"
        )
    return named


def wrap(env: Any, wrapper: WrapperLike) -> Any:
    """Put this wrapper around the environment: a gymnasium wrapper, or, for a PettingZoo environment, a PettingZoo wrapper.

    Raises `UsageError` if the wrapper can't be found, fails or returns something other than an environment. If the wrapper
    itself raised, the error's `detail` is the traceback.
    """
    name = wrapper_name(wrapper)
    if has_seats(env) and name.startswith("gymnasium."):
        raise UsageError(
            f"wrapper {name}: expected one of PettingZoo's or supersuit's, because the environment has several agents"
        )
    try:
        made: object = _found(wrapper)(env) if isinstance(wrapper, str) else wrapper(env)
    except UsageError:
        raise
    except TypeError as error:
        line = f"wrapper {name}: {first_line(error)}"
        if isinstance(wrapper, str) and "argument" in line:
            read = read_wrapper(wrapper)
            how = f'give its arguments, as in --wrappers "{read.module}:{read.qualname}(name=value)"'
            raise UsageError(f"{line}; {how}") from error
        raise UsageError(line, traceback.format_exc()) from error
    except Exception as error:
        raise UsageError(f"wrapper {name}: {type(error).__name__}: {first_line(error)}", traceback.format_exc()) from error
    if not (isinstance(made, gymnasium.Env) or has_seats(made)):
        raise UsageError(
            f"wrapper {name}: expected it to return an environment of gymnasium or PettingZoo, got {type(made).__name__}"
            f"{f'; {lacks}' if (lacks := what_it_lacks(made)) else ''}"
        )
    return made


def _found(text: str) -> Wrapper:
    """Import the wrapper with this name, and bind its arguments. Raises `UsageError` if it can't be found."""
    read = read_wrapper(text)
    wrapper = own_callable(f"{read.module}:{read.qualname}", f"wrapper {text}", "gymnasium.wrappers:FlattenObservation")
    return lambda env: wrapper(env, *read.args, **read.kwargs)
