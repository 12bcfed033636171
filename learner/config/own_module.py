"""Imports a module of the user's own, which a setting names.

Rule: whatever is wrong is one line that quotes the setting. What the user's code raised has its traceback as detail.
"""

from __future__ import annotations

import importlib
import traceback
from types import ModuleType

from protocol.bounds import one_line
from protocol.errors import UsageError, first_line


def import_own(module: str, what: str) -> ModuleType:
    """Import it. `what` quotes the setting, as `algo mine:ClippedPlus`. Raises `UsageError`."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{module}.".startswith(f"{error.name}."):
            raise UsageError(
                f"{what}: no module {error.name}; expected one in the current folder, on PYTHONPATH or installed"
            ) from error
        raise own_code_failed(f"{what}: the import of {module}", error) from error
    except (Exception, SystemExit) as error:
        raise own_code_failed(f"{what}: the import of {module}", error) from error


def own_code_failed(what: str, error: BaseException) -> UsageError:
    """The error for what the user's code raised."""
    why = one_line(f"{type(error).__name__}: {first_line(error)}")
    return UsageError(f"{what} failed: {why}", "".join(traceback.format_exception(error)))


def is_name(text: str) -> bool:
    """Whether this is `module:name`, with or without dots in either part."""
    module, _, name = text.partition(":")
    return all(part.isidentifier() for each in (module, name) for part in each.split("."))
