"""The names of algorithms: a short name for a built-in one, and `module:Class` for your own.

Rules: your module is imported when its algorithm's settings are first needed. If the class lacks something, a one-line error
says so at that point, before a worker is started or a run folder is created. If you pass a class in Python that can't be
imported, because it is defined in a notebook or a function, only this process finds it.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import cache
from inspect import isdatadescriptor
from typing import Any

import msgspec
import tomli_w

from millrace.learner.config.config import Config
from millrace.learner.config.hyperparameters import HYPERPARAMETERS, AlgorithmConfig
from millrace.learner.config.resume_rules import declared
from millrace.protocol.bounds import one_line
from millrace.protocol.envs.found_names import attribute, importable, last_part
from millrace.protocol.errors import UsageError, did_you_mean, first_line, safe_repr
from millrace.protocol.own_module import import_own, is_name

ALGORITHMS = {
    name: f"millrace.learner.algorithms.{name}:{record.__name__.removesuffix('Config')}"
    for name, record in HYPERPARAMETERS.items()
}
"""The `module:Class` of each built-in algorithm, named like its record. It is imported when it is used."""

NEEDED = (
    "__init__", "policy_spec", "update", "weights", "is_finite", "state_dict", "load_state_dict", "remember", "roll_back",
)  # fmt: skip
"""The methods that every algorithm needs; `millrace.learner.algorithms.Algorithm` describes them."""

FOR_PRIOR = ("add_prior", "learn_from_prior")
"""The additional methods that an algorithm needs in a run with prior data."""

NOT_SETTINGS = {"config", "preset", "resume", "log_json", "debug", "progress"}
"""Flags and arguments of `millrace train` and `millrace.train` that are not settings."""

ASKED = {name for name, value in vars(AlgorithmConfig).items() if not isdatadescriptor(value)}
"""Names of what millrace asks of every record of settings, which no setting may have."""

_given: dict[str, type] = {}
"""The classes that were passed in Python and can't be imported, by name. A newer class replaces one with the same name."""


def is_own(algo: str) -> bool:
    """Whether this is the name of a user-defined algorithm."""
    return ":" in algo


def settings_record(algo: str) -> type[AlgorithmConfig]:
    """The class of an algorithm's settings. Raises `UsageError`, with a one-line message, if the algorithm doesn't exist."""
    if algo in HYPERPARAMETERS:
        return HYPERPARAMETERS[algo]
    if not is_own(algo):
        hint = did_you_mean(algo, HYPERPARAMETERS) or "; one of your own is named as module:Class"
        raise UsageError(f"algo {algo}: expected one of {', '.join(HYPERPARAMETERS)}{hint}")
    record: type[AlgorithmConfig] = own_class(algo).Config
    return record


def own_class(name: str) -> Any:
    """The user-defined class of this name. Imports its module. Raises `UsageError` if it isn't found or lacks something."""
    return _checked(name, _given[name] if name in _given else _found(name))


def name_of(algorithm: type) -> str:
    """The name of a class, for `Config.algo`. It identifies the class in this process, and in processes that can import it.

    Raises `UsageError` if the class lacks something.
    """
    module = algorithm.__module__
    qualname = algorithm.__qualname__
    for short, name in ALGORITHMS.items():
        if name == f"{module}:{qualname}":
            return short
    main = sys.modules["__main__"]
    spec = getattr(main, "__spec__", None)
    in_main = module == "__main__" and attribute(main, qualname) is algorithm
    name = (
        f"{spec.name if spec is not None and in_main else module}:{qualname}"  # after `python -m mine`, others import mine
    )
    _given.pop(name, None)
    if module == "__main__" or attribute(sys.modules.get(module), qualname) is not algorithm or not importable(module):
        _given[name] = algorithm
    _checked(name, algorithm)
    return name


def moved(before: str, now: str) -> bool:
    """Whether a run of algorithm `before` may continue with `now`, because `now` is the same class, moved to a module."""
    module, _, qualname = before.partition(":")
    return (module == "__main__" or "<locals>" in qualname) and is_own(now) and last_part(before) == last_part(now)


def with_algorithm(table: dict[str, Any], algo: str | None) -> dict[str, Any]:
    """The settings from a config.toml, with the algorithm's current name in place of an earlier one."""
    before = str(table.get("algo"))
    if not algo or algo == before or not moved(before, algo):
        return table
    return {algo if name == before else name: value for name, value in table.items()} | {"algo": algo}


def _found(name: str) -> object:
    module_name, _, qualname = name.partition(":")
    if module_name == "__main__" or "<locals>" in qualname:
        named = attribute(sys.modules.get(module_name), qualname)
        if named is None:
            raise UsageError(
                f"algo {name}: this class is defined in a script, a notebook or a function; continue there: "
                f"millrace.train(resume=…, algo={last_part(name)}), or put it into a module: --algo module:{last_part(name)}"
            )
        return named
    if not is_name(name):
        raise UsageError(f"algo {name}: expected module:Class, as in mine:ClippedPlus")
    module = import_own(module_name, f"algo {name}")
    named = attribute(module, qualname)
    if named is None:
        classes = [key for key, value in vars(module).items() if isinstance(value, type)]
        where = getattr(module, "__file__", None) or "built-in"
        raise UsageError(f"algo {name}: module {module_name} ({where}) has no {qualname}{did_you_mean(qualname, classes)}")
    return named


def _checked(name: str, named: object) -> Any:
    """The class `named`, if the learner can use it. Otherwise raises `UsageError`, which names what is missing or wrong."""
    if not isinstance(named, type):
        raise UsageError(f"algo {name}: expected a class, got {type(named).__name__}")
    if why := _what_is_wrong(named):
        raise UsageError(f"algo {name}: {why}")
    return named


@cache
def _what_is_wrong(algorithm: type) -> str:
    """One line that says what is missing or wrong in an algorithm; empty if it can be used."""
    unwritten: frozenset[str] = getattr(algorithm, "__abstractmethods__", frozenset())
    missing = [name for name in NEEDED if name in unwritten or getattr(algorithm, name, None) in (None, object.__init__)]
    if not hasattr(algorithm, "whole_episodes"):
        missing.append("whole_episodes")
    if missing:
        return (
            f"it lacks {', '.join(missing)}; derive it from ActorCritic or Algorithm of millrace.algorithms, and write these"
        )
    record = getattr(algorithm, "Config", None)
    if not (isinstance(record, type) and issubclass(record, AlgorithmConfig)):
        expected = "a class derived from ActorCriticConfig or AlgorithmConfig of millrace.algorithms"
        return f"Config: expected {expected}, got {'none' if record is None else one_line(safe_repr(record))}"
    return _what_is_wrong_with_settings(record)


def _what_is_wrong_with_settings(record: type[AlgorithmConfig]) -> str:
    own = set(record.__struct_fields__) - set(AlgorithmConfig.__struct_fields__)
    if shadows := own & ({*Config.__struct_fields__} | NOT_SETTINGS):
        return f"its setting {min(shadows)} has the name of a setting of the run; give it another name"
    if shadows := own & ASKED:
        return f"its setting {min(shadows)} has the name of an attribute of AlgorithmConfig; give it another name"
    try:
        declared(record, by_type=True)
        required = [field.name for field in msgspec.structs.fields(record) if field.required]
    except (NameError, TypeError, AttributeError) as error:
        return f"the types of its settings cannot be read: {one_line(first_line(error))}"
    if required:
        return f"its setting {required[0]}: expected a default value, got none"
    for setting in record.__struct_fields__:
        if why := _why_not_plain(record, setting):
            return f"its setting {setting}: {why}"
    return ""


def _why_not_plain(record: type[AlgorithmConfig], setting: str) -> str:
    """Why config.toml can't hold the default of a setting, or an empty string if it can."""
    default = getattr(record(), setting)
    try:
        plain: Mapping[str, Any] = {} if default is None else {setting: msgspec.to_builtins(default)}
        tomli_w.dumps(plain)
        msgspec.convert(plain, record)
    except msgspec.ValidationError as error:
        return f"its default does not fit its type: {one_line(str(error))}"
    except (TypeError, ValueError):
        return f"expected a default of numbers, text, true or false, or lists of these, got {one_line(safe_repr(default))}"
    return ""
