"""Which env copy is being made, and the arguments and factories that depend on it.

Rule: results may depend on every field of an `EnvCopy` except its slot, because all the others are the same in every run,
on every machine and after a resume.
"""

from __future__ import annotations

import ast
import inspect
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

from millrace.protocol.errors import UsageError

_EXPRESSION = re.compile(r"\{([\w\s()+*/%-]{1,100})\}")
_OPERATORS: dict[type[ast.operator], Callable[[int, int], int]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
}  # fmt: skip


@dataclass(frozen=True)
class EnvCopy:
    """One copy of the environment: its numbers in the run, and its slot on its machine.

    It is passed to a factory that takes one argument, and returned by `millrace.env_copy()`. String keyword arguments of the
    environment can refer to its integer fields, as in `{5000 + slot}`.

    >>> import gymnasium, millrace
    >>> def make_env(copy: millrace.EnvCopy) -> gymnasium.Env:
    ...     return gymnasium.make("Pendulum-v1", g=[8.0, 10.0][copy.number % 2])
    >>> make_env(millrace.EnvCopy(number=3)).unwrapped.g
    10.0
    """

    number: int = 0
    """The copy's index among all copies of the run, from 0: `lane` times the copies per lane, plus `copy`. For an evaluation
    copy, its index among the `--eval-copies`; for a copy that is made only to be described, 0.
    """
    lane: int = 0
    """The lane to which the copy belongs; 0 for an evaluation copy."""
    copy: int = 0
    """The copy's index within the lane, from 0; for an evaluation copy, its `number`."""
    evaluation: bool = False
    """Whether the copy plays evaluations or recordings."""
    slot: int = 0
    """The lowest number, from 0, that no other live copy on this machine has; use it for ports, folders and displays. It may
    differ after a resume, and is free again when the copy is closed or its process has ended.
    """


FIRST_COPY = EnvCopy()
"""Stands for the first copy of a run, and for a copy that is made only to describe the environment. It holds no slot on the
machine.
"""


@dataclass
class Making:
    """A copy that is being made."""

    copy: EnvCopy
    asked: bool = False
    """Whether the environment has asked which copy it is. If it hasn't, all copies are made in the same way."""


_making: ContextVar[Making | None] = ContextVar("making", default=None)


@contextmanager
def making(copy: EnvCopy) -> Iterator[Making]:
    """A context in which this thread makes this copy, so that `being_made` returns it."""
    under_way = Making(copy)
    token = _making.set(under_way)
    try:
        yield under_way
    finally:
        _making.reset(token)


def being_made() -> EnvCopy | None:
    """The copy that this thread is making now; None if it is making none. Marks the copy as `asked`."""
    under_way = _making.get()
    if under_way is None:
        return None
    under_way.asked = True
    return under_way.copy


def filled(kwargs: Mapping[str, Any], env: str) -> dict[str, Any]:
    """The keyword arguments for the copy that is being made, with the expressions in braces evaluated.

    A string that consists of one expression becomes an integer. An expression contains only integers, `+ - * // %` and at
    least one of the names; braces around anything else stay as they are. `env` names the environment in the `UsageError` for
    a division by zero.
    """

    def in_braces(match: re.Match[str]) -> str:
        try:
            tree = ast.parse(match[1].strip(), mode="eval").body
        except SyntaxError:
            return match[0]
        if not any(isinstance(node, ast.Name) for node in ast.walk(tree)):
            return match[0]
        copy = being_made() or FIRST_COPY
        try:
            return str(_value(tree, {"number": copy.number, "lane": copy.lane, "copy": copy.copy, "slot": copy.slot}))
        except LookupError:
            return match[0]
        except ZeroDivisionError as error:
            raise UsageError(f"environment {env}: argument {match[0]}: it divides by zero for {copy}") from error

    def of_copy(value: Any) -> Any:
        if not isinstance(value, str):
            return value
        text = _EXPRESSION.sub(in_braces, value)
        return int(text) if text != value and _EXPRESSION.fullmatch(value) else text

    return {name: of_copy(value) for name, value in kwargs.items()}


def _value(node: ast.expr, names: Mapping[str, int]) -> int:
    """The value of an expression. Raises `LookupError` if it contains names or operators that `filled` doesn't allow."""
    match node:
        case ast.Name(name):
            return names[name]
        case ast.Constant(int(value)):
            return int(value)
        case ast.UnaryOp(ast.USub(), operand):
            return -_value(operand, names)
        case ast.BinOp(left, sign, right):
            return _OPERATORS[type(sign)](_value(left, names), _value(right, names))
    raise LookupError(ast.unparse(node))


def takes_copy(factory: Callable[..., object], kwargs: Mapping[str, Any]) -> str:
    """The name of the factory's parameter that gets the copy: the first one, if it is required and `kwargs` has all other
    required ones. Empty if there is no such parameter.
    """
    try:
        parameters = list(inspect.signature(factory).parameters.values())
    except (TypeError, ValueError):  # a callable that has no signature
        return ""
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    needed = [each for each in parameters if each.default is each.empty and each.kind not in variable]
    match [each for each in needed if each.name not in kwargs]:
        case [only] if only is parameters[0] and only.kind is not only.KEYWORD_ONLY and only.name != "render_mode":
            return only.name
    return ""
