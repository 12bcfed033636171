"""A callback by its name, `module:factory`: the module is imported, and the factory (or class) is called without arguments.

Rule: whatever is wrong with the name is one line that quotes it. What the user's code raised has its traceback as detail.
"""

from __future__ import annotations

import importlib
import traceback

from learner.config.did_you_mean import did_you_mean
from protocol.bounds import one_line
from protocol.errors import UsageError, first_line


def named_callback(name: str) -> object:
    """Make the callback of this name. Raises `UsageError`."""
    module_name, _, path = name.partition(":")
    if not all(part.isidentifier() for text in (module_name, path) for part in text.split(".")):
        raise UsageError(f"callback {name}: expected module:factory, as in mine:EarlyStop")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise _failed(name, f"the import of {module_name} failed", error) from error
        raise UsageError(
            f"callback {name}: no module {error.name}; expected one in the current folder, on PYTHONPATH or installed"
        ) from error
    except (Exception, SystemExit) as error:
        raise _failed(name, f"the import of {module_name} failed", error) from error
    found: object = module
    for part in path.split("."):
        known = [attribute for attribute in dir(found) if not attribute.startswith("_")]
        found = getattr(found, part, None)
        if found is None:
            raise UsageError(f"callback {name}: module {module_name} has no {path}{did_you_mean(part, known)}")
    if not callable(found):
        raise UsageError(f"callback {name}: expected a function or class to call, got {type(found).__name__}")
    try:
        return found()
    except (Exception, SystemExit) as error:
        raise _failed(name, f"{path}() failed", error) from error


def _failed(name: str, what: str, error: BaseException) -> UsageError:
    why = one_line(f"{type(error).__name__}: {first_line(error)}")
    return UsageError(f"callback {name}: {what}: {why}", "".join(traceback.format_exception(error)))
