"""Environment ids that gymnasium does not know: plugins that register them, and what to write if none does.

Rule: a package is imported for an id only if it declares a plugin, an entry point `gymnasium.envs`. gymnasium 1 no longer
loads plugins; each worker does so, on its own machine. For other packages, the user names the module: `module:Id`. An id is
suggested only if its environment can be made, or could be once a package is installed.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib
import io
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import gymnasium
from gymnasium.envs.registration import find_highest_version, parse_env_id
from gymnasium.envs.registration import namespace as _namespace

from millrace.protocol.bounds import one_line
from millrace.protocol.envs.advice.missing_modules import what_to_install
from millrace.protocol.errors import first_line, words_an_error

GROUP = "gymnasium.envs"
_REGISTERED = re.compile(r'\bid="([^"]+)"')


class Plugin(NamedTuple):
    """A function that registers the environments of an installed package."""

    entry_point: metadata.EntryPoint
    namespace: str
    """the namespace of its ids; empty if there is none"""


def load_plugins(env_id: str) -> list[str]:
    """Let installed plugins register their environments, one after the other, until this id is registered.

    Returns one line for each plugin that failed.
    """
    failed: list[str] = []
    for plugin, namespace in _plugins():
        if is_registered(env_id):
            break
        with _quietly(plugin.module, failed), _namespace(namespace) if namespace else contextlib.nullcontext():
            importlib.import_module(plugin.module)  # most packages register when they are imported
            if not is_registered(env_id):
                plugin.load()()
    return failed


@contextlib.contextmanager
def _quietly(module: str, failed: list[str]) -> Iterator[None]:
    """A context in which another package's output is suppressed, and its error is appended to `failed` as a line."""
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    except Exception as error:
        install = f"; {what_to_install(error.name)}" if isinstance(error, ModuleNotFoundError) else ""
        failed.append(f"{module}: {type(error).__name__}: {one_line(first_line(error), 200)}{install}")


def plugin_modules() -> set[str]:
    """The top-level modules of the plugins that `load_plugins` calls."""
    return {plugin.entry_point.module.partition(".")[0] for plugin in _plugins()}


def registered_by_plugins(env_id: str) -> bool:
    """Whether a plugin registers this id. It is registered in this process already, but perhaps by other code."""
    here = gymnasium.registry.pop(env_id)
    try:
        load_plugins(env_id)
        return env_id in gymnasium.registry
    finally:
        gymnasium.registry[env_id] = here


def _plugins() -> Iterator[Plugin]:
    """All installed plugins. The namespace is the name of the entry point, or the part of its group's name after the dot."""
    entry_points = metadata.entry_points()
    for entry_point in (one for group in entry_points.groups for one in entry_points.select(group=group)):
        if (entry_point.group == GROUP or entry_point.group.startswith(f"{GROUP}.")) and _is_whole(entry_point):
            namespace = entry_point.name if entry_point.group == GROUP else entry_point.group[len(GROUP) + 1 :]
            yield Plugin(entry_point, "" if namespace == "__root__" else namespace)


def _is_whole(entry_point: metadata.EntryPoint) -> bool:
    """Whether the entry point names a module, as it should."""
    try:
        return bool(entry_point.module)
    except AttributeError:
        return False


def is_registered(env_id: str) -> bool:
    """Whether gymnasium can make this id: it is registered, or it has no version and one of its versions is registered."""
    if env_id in gymnasium.registry:
        return True
    try:
        namespace, name, version = parse_env_id(env_id)
    except gymnasium.error.Error:
        return False
    return version is None and find_highest_version(namespace, name) is not None


@cache
def ids_of_gymnasium() -> frozenset[str]:
    """The ids that gymnasium itself registers.

    They are read from gymnasium's source code, because its registry doesn't show who registered an id.
    """
    return frozenset(_REGISTERED.findall(Path(gymnasium.envs.__file__).read_text("utf-8")))


@words_an_error
def what_to_write(env_id: str, why_not: Callable[[str], str]) -> str:
    """What to write instead of an id that is not registered, as the end of a line.

    `why_not` tries to make the environment of an id, and returns a line that says why it can't, or an empty string.
    """
    return most_similar(env_id, (), why_not) or (
        f"write module:{env_id} with the module that registers it, as in minigrid:MiniGrid-Empty-5x5-v0; one of a client in "
        "another language needs the client (--bind)"
    )


def most_similar(env_id: str, examples: Iterable[str], why_not: Callable[[str], str]) -> str | None:
    """A suggestion of the most similar registered id, or one of `examples`, as the end of a line; None if none is similar.

    An id is suggested only if its environment can be made, or lacks only a package; the line then says how to install it.
    """
    by_name = {one.rpartition(":")[2].lower(): one for one in [*gymnasium.registry, *examples]}
    for close in difflib.get_close_matches(env_id.lower(), by_name, cutoff=0.75):
        meant = by_name[close]
        if not (line := why_not(meant)):
            return f"did you mean {meant}?"
        if "pip install" in line:
            return f"did you mean {meant}? It cannot be made yet: {line}"
    return None
