"""Imports the object that a setting names as `module:name`: an algorithm, a callback, a policy, an encoder, a wrapper.

Rule: each error is one line that quotes the setting. If user code raised, the error's `detail` is the traceback; an error
about a missing package needs none.
"""

from __future__ import annotations

import importlib
import logging
import site
import sys
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

from millrace.protocol.bounds import one_line
from millrace.protocol.envs.advice.files_as_modules import module_of_file
from millrace.protocol.envs.advice.missing_modules import what_to_install
from millrace.protocol.envs.found_names import attribute, names_a_module
from millrace.protocol.errors import UsageError, did_you_mean, first_line

log = logging.getLogger("millrace.own_module")


def is_name(text: str) -> bool:
    """Whether this is `module:name`, with or without dots in either part."""
    module, _, name = text.partition(":")
    return all(part.isidentifier() for each in (module, name) for part in each.split("."))


def own_callable(name: str, what: str, example: str) -> Callable[..., Any]:
    """Import `module:name`, a function or class.

    Raises `UsageError` if that fails. In the error, `what` quotes the setting, for example `callback mine:Stop`, and
    `example` shows a valid name.
    """
    if not is_name(name):
        raise UsageError(f"{what}: {module_of_file(name, 'NAME') or f'expected module:factory, as in {example}'}")
    module_name, _, qualname = name.partition(":")
    return callable_of(import_own(module_name, what), qualname, what)


def import_own(module: str, what: str) -> ModuleType:
    """Import a module. Raises `UsageError` if that fails. For `what`, see `own_callable`."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{module}.".startswith(f"{error.name}."):
            instead = module_of_file(module, "NAME") or "is it installed, or its folder on PYTHONPATH?"
            raise UsageError(f"{what}: no module named {error.name}; {instead}") from error
        raise UsageError(f"{what}: the import of {module} failed: {_why(error)}; {what_to_install(error.name)}") from error
    except (Exception, SystemExit) as error:
        raise own_code_failed(f"{what}: the import of {module}", error) from error


def refuse_modules_in(folder: Path, names: Iterable[str]) -> None:
    """Ensure that no module is ever imported from a run folder, because it may come from a stranger.

    Removes the folder, and all that is inside it, from the search path, which the workers of this process inherit: besides
    the modules that the folder's files name, an environment's id can make gymnasium's plugins be imported. Python's own
    libraries stay on the path, because the run folder may be a project's folder that contains a virtual environment. Raises
    `UsageError` if one of these names, `module:name` or `package.module_v1`, leads from a folder above into the run folder.
    """
    inside = folder.resolve()
    installations = [each for each in _installations() if each.is_relative_to(inside)]
    for searched in sys.path.copy():
        path = Path(searched).resolve()
        if path.is_relative_to(inside) and not any(each in path.parents for each in installations):
            sys.path.remove(searched)
            log.warning("run %s: nothing is imported from a run folder, so %s is taken off the search path", folder, path)
    above = [entry for each in sys.path if inside.is_relative_to(entry := Path(each).resolve())]
    for name in names:
        module, colon, _ = name.partition(":")
        imported = bool(colon and module) or names_a_module(name)
        if imported and any(entry.joinpath(*module.split(".")).is_relative_to(inside) for entry in above):
            raise UsageError(
                f"run {folder}: {one_line(name, 200)} would be imported from the run folder, which is refused; if you "
                "trust that module, put it into a folder of your own"
            )


def _installations() -> set[Path]:
    """The folders below which this Python finds installed libraries: its virtual environment, its own, and the user's."""
    prefixes = {sys.prefix, sys.exec_prefix, sys.base_prefix, sys.base_exec_prefix}
    if site.ENABLE_USER_SITE:
        prefixes.add(site.getuserbase())
    return {Path(each).resolve() for each in prefixes}


def callable_of(module: ModuleType, qualname: str, what: str) -> Callable[..., Any]:
    """The function or class with this name in a module. Raises `UsageError` if there is none.

    For `what`, see `own_callable`.
    """
    named = attribute(module, qualname)
    if named is None:
        known = [name for name, value in vars(module).items() if callable(value) and not name.startswith("_")]
        hint = did_you_mean(qualname, known, f"{module.__name__}:")
        raise UsageError(f"{what}: module {module.__name__} has no {qualname}{hint}")
    if not callable(named):
        raise UsageError(f"{what}: expected a function or class to call, got {type(named).__name__}")
    return named


def own_code_failed(what: str, error: BaseException) -> UsageError:
    """The error for an exception that user code raised; its `detail` is the traceback."""
    return UsageError(f"{what} failed: {_why(error)}", "".join(traceback.format_exception(error)))


def _why(error: BaseException) -> str:
    return one_line(f"{type(error).__name__}: {first_line(error)}")
