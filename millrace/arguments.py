"""Converts the arguments of public functions to plain values, and checks those that aren't settings.

Rule: numpy scalars and enum members become plain Python numbers and strings. An integer must fit into 64 bits, and a string
must be encodable as UTF-8. An argument must match its parameter's annotation. Settings, which a function takes as
`**settings: Unpack[ATypedDict]`, are checked later, when msgspec builds a record from them. Arguments annotated as `object`
are the user's own objects and are left unchanged. An error is one line that begins with the function's name.

For `help` and notebooks, the signature shows each key of such a `TypedDict` as a keyword of its own.
"""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable, Iterator, Sequence
from types import UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin

import msgspec
import numpy as np

from millrace.protocol.errors import UsageError, usage_error

WORDS: dict[Any, str] = {
    str: "text",
    type(None): "None",
    Callable: "a function",
    os.PathLike: "a path",
    tuple: "a tuple",
    Sequence: "a list",
    dict: "a dict",
}
UNSET = type("Unset", (), {"__repr__": lambda unset: "..."})()
"""Shown by `help` as a setting's default, because the real default may depend on other settings"""
_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def checked(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Wrap a function so that it raises `UsageError` for arguments that its annotations do not allow."""
    signature = inspect.signature(function)
    who = function.__qualname__.removesuffix(".__init__").rpartition(".")[2]

    @functools.cache
    def hints() -> dict[str, Any]:
        texts = {name: text for name, text in function.__annotations__.items() if name != "return"}
        return {name: Any if _names_keys(text) else eval(text, function.__globals__) for name, text in texts.items()}

    def fitting(name: str, value: Any, hint: Any) -> Any:
        if hint is object:
            return value
        value = plain(value)
        if why := unusable(value) or ("" if fits(value, hint) else f"expected {words(hint)}"):
            raise UsageError(f"{who}: {name}: {why}, got {value!r:.60}")
        return value

    @functools.wraps(function)
    def door(*args: _Arguments.args, **keywords: _Arguments.kwargs) -> _Result:
        try:
            given = signature.bind(*args, **keywords)
        except TypeError:
            return function(*args, **keywords)  # raises Python's own TypeError, which names the function
        for name, value in given.arguments.items():
            match signature.parameters[name].kind:
                case inspect.Parameter.VAR_KEYWORD:
                    given.arguments[name] = {key: fitting(key, one, hints()[name]) for key, one in value.items()}
                case inspect.Parameter.VAR_POSITIONAL:
                    given.arguments[name] = tuple(fitting(name, one, hints()[name]) for one in value)
                case _ if name in hints():  # every argument except self
                    given.arguments[name] = fitting(name, value, hints()[name])
        try:
            return function(*given.args, **given.kwargs)
        except OSError as error:
            if (ours := usage_error(error)) is None:
                raise
            raise UsageError(f"{who}: {ours}") from error

    door.__signature__ = signature.replace(parameters=list(_by_name(function, signature)))  # type: ignore[attr-defined]
    return door


def _by_name(function: Callable[..., Any], signature: inspect.Signature) -> Iterator[inspect.Parameter]:
    """A function's parameters, in which `**settings` is replaced by one parameter for each key of its TypedDict."""
    for parameter in signature.parameters.values():
        if _names_keys(parameter.annotation):
            keys = get_args(eval(parameter.annotation, function.__globals__))[0].__annotations__
            for name, hint in keys.items():
                yield inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=UNSET, annotation=hint.__forward_arg__)
        else:
            yield parameter


def _names_keys(annotation: object) -> bool:
    """Whether an annotation (a string) says that the keywords are the keys of a TypedDict."""
    return str(annotation).startswith("Unpack[")


def plain(value: Any) -> Any:
    """The value, with numpy scalars and subclasses of str, int and float made plain, even inside lists, tuples and dicts."""
    match value:
        case np.generic():
            return value.item()
        case bool():
            return value
        case str():
            return str.__str__(value)  # for a member of an enum, `str(value)` would give its name
        case int() | float():
            return (int if isinstance(value, int) else float)(value)
        case list() | tuple() if type(value) in (list, tuple):
            return type(value)(map(plain, value))
        case dict() if type(value) is dict:
            return {plain(key): plain(one) for key, one in value.items()}
    return value


def unusable(value: Any) -> str:
    """Why a value can't be written to messages and files, worded as `expected …`, or an empty string if it can."""
    try:
        match value:
            case os.PathLike():
                os.fsencode(value)
            case str() | int() | list() | tuple() | dict():
                msgspec.msgpack.encode(value, enc_hook=lambda own: None)
    except UnicodeEncodeError:
        return "expected text that can be encoded"
    except OverflowError:
        return "expected a number of at most 64 bits"
    return ""


def fits(value: Any, hint: Any) -> bool:
    """Whether the annotation `hint` allows this value."""
    origin = get_origin(hint)
    parts = get_args(hint)
    if origin in (Union, UnionType):
        return any(fits(value, part) for part in parts)
    if origin is Literal:
        return isinstance(value, str) and value in parts
    if origin is Callable:
        return callable(value)
    if origin is Sequence:
        listed = isinstance(value, Sequence) and not isinstance(value, str | bytes)
        return listed and all(fits(one, parts[0]) for one in value)
    if hint in (int, float):
        return isinstance(value, int | hint) and not isinstance(value, bool)
    return hint is Any or getattr(hint, "_is_protocol", False) or isinstance(value, origin or hint)


def words(hint: Any) -> str:
    """An annotation as error messages phrase it, such as `a list of text`."""
    origin = get_origin(hint)
    parts = get_args(hint)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(map(words, parts)))
    if origin is Literal:
        return f"one of {', '.join(parts)}"
    found = WORDS.get(origin or hint, getattr(hint, "__name__", str(hint)))
    return f"{found} of {words(parts[0])}" if origin is Sequence and parts[0] is not object else found
