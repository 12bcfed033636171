"""Advice for environments whose constructor takes one dict, the way RLlib passes it. Pure.

Rule: this module inspects only the exception that such a constructor raised when it was called without the dict.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from traceback import extract_tb
from typing import Any

from millrace.protocol.envs.found_names import last_part
from millrace.protocol.errors import first_line, words_an_error

_READS_A_DICT = re.compile(
    r"'(NoneType|EnvCopy)' object (has no attribute '(get|items|keys|pop|setdefault|update|copy)'"
    r"|is not (subscriptable|iterable)|does not support item)|argument of type '(NoneType|EnvCopy)' is not iterable"
)


@words_an_error
def wants_a_dict(name: str, factory: Callable[..., object], kwargs: Mapping[str, Any], error: Exception) -> str:
    """What to write if the constructor of an environment failed because its first argument wasn't a dict; else empty."""
    if not _READS_A_DICT.search(first_line(error)):
        return ""
    parameters = list(inspect.signature(factory).parameters.values())
    if not parameters or parameters[0].name in kwargs or parameters[0].default not in (None, inspect.Parameter.empty):
        return ""
    raised_by = extract_tb(error.__traceback__)[-1].line or ""
    if not re.search(rf"\b({parameters[0].name}|\w*config)\b", raised_by):
        return ""  # the failing line is about another variable
    return (
        f"its argument {parameters[0].name} is a dict, as RLlib passes it; name a function of your own in place of {name}: "
        f"def make_env(**config): return {last_part(name)}(config), and give entries of the dict as --env-kwargs NAME VALUE"
    )
