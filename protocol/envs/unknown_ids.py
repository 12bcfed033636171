"""Environment ids that gymnasium does not know: plugins that register them, and a line that says what to write.

Rule: a plugin is an installed package that names a function in the entry points `gymnasium.envs`. gymnasium 1 does not
call them any more, so they are called here, when an id is not known otherwise. No other package is imported: which ids an
installed package would register is read from its source text.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib
import io
import re
import sys
import warnings
from collections.abc import Iterable, Iterator
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import gymnasium
from gymnasium.envs.registration import find_highest_version, parse_env_id
from gymnasium.envs.registration import namespace as _namespace

from protocol.bounds import one_line
from protocol.errors import first_line

GROUP = "gymnasium.envs"
LARGEST_FILE, LARGEST_PACKAGE = 1 << 20, 1 << 24  # bytes of source text that are read
MOST_NAMED = 3
_REGISTERED = re.compile(r"""(?:\bid\s*=|\bregister(?:_env)?\()\s*f?["']([\w./{}-]+-v\d+)["']""")
_PART = re.compile(r"{[^}]*}")  # of an f-string


class InstalledPackage(NamedTuple):
    """An installed package that needs gymnasium, and so may have environments."""

    module: str
    """the module to import"""
    ids: tuple[str, ...]
    """the ids that stand in its source text; `{…}` stands for any part of an id"""

    def registers(self, env_id: str) -> bool:
        """Whether the source text registers this id."""
        patterns = (r"[\w.-]*".join(map(re.escape, _PART.split(each))) for each in self.ids)
        return any(re.fullmatch(pattern, env_id) for pattern in patterns)

    @property
    def examples(self) -> list[str]:
        """Ids that it registers."""
        return [_PART.sub("", each) for each in self.ids]


class Plugin(NamedTuple):
    """A function that registers the environments of an installed package."""

    entry_point: metadata.EntryPoint
    namespace: str
    """the namespace of its ids; empty if there is none"""


def load_plugins(env_id: str) -> list[str]:
    """Let installed plugins register their environments until this id is known. Returns a line for each that failed."""
    failed = []
    for plugin, namespace in _plugins():
        if is_registered(env_id):
            break
        try:
            with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
                warnings.simplefilter("ignore")
                with _namespace(namespace) if namespace else contextlib.nullcontext():
                    importlib.import_module(plugin.module)  # most packages register when they are imported
                    if not is_registered(env_id):
                        plugin.load()()
        except Exception as error:  # another package's code
            failed.append(f"{plugin.module}: {type(error).__name__}: {one_line(first_line(error), 200)}")
    return failed


def plugin_modules() -> set[str]:
    """The first parts of the names of the modules whose plugins `load_plugins` calls."""
    return {plugin.entry_point.module.partition(".")[0] for plugin in _plugins()}


def registered_by_plugins(env_id: str) -> bool:
    """Whether it is a plugin that registers this id, which is registered here. Anybody may have registered it."""
    here = gymnasium.registry.pop(env_id)
    try:
        load_plugins(env_id)
        return env_id in gymnasium.registry
    finally:
        gymnasium.registry[env_id] = here


def _plugins() -> Iterator[Plugin]:
    """The plugins. The namespace is the name of the entry point, or stands in the name of its group."""
    found = metadata.entry_points()
    for entry_point in (one for group in found.groups for one in found.select(group=group)):
        if entry_point.group == GROUP or entry_point.group.startswith(f"{GROUP}."):
            namespace = entry_point.name if entry_point.group == GROUP else entry_point.group[len(GROUP) + 1 :]
            yield Plugin(entry_point, "" if namespace == "__root__" else namespace)


def is_registered(env_id: str) -> bool:
    """Whether gymnasium makes this id: it is registered, or without a version and some version is."""
    if env_id in gymnasium.registry:
        return True
    try:
        namespace, name, version = parse_env_id(env_id)
    except gymnasium.error.Error:
        return False
    return version is None and find_highest_version(namespace, name) is not None


@cache
def ids_of_gymnasium() -> frozenset[str]:
    """The ids that gymnasium itself registers, as they stand in its source text."""
    return frozenset(_ids([_source("gymnasium.envs")]))


def registers(module: str, env_id: str) -> bool:
    """Whether the source text of a module that is imported here registers this id."""
    return InstalledPackage(module, tuple(_ids([_source(module)]))).registers(env_id)


def _source(module: str) -> str:
    """The source text of a module that is imported here; empty if it has none."""
    try:
        return Path(str(getattr(sys.modules.get(module), "__file__", None))).read_text("utf-8", "replace")
    except OSError:
        return ""


def what_to_write(env_id: str) -> str:
    """What to write instead of an id that is not registered, as the end of a line."""
    packages = list(installed_packages())
    for package in packages:
        if package.registers(env_id):
            return (
                f"the installed package {package.module} registers it when it is imported; write {package.module}:{env_id}"
            )
    if (similar := most_similar(env_id, [f"{one.module}:{env}" for one in packages for env in one.examples])) is not None:
        return f"did you mean {similar}?"
    own = "one of your own is given as my_module:MyEnv-v0, one of a client in another language needs the client (--bind)"
    names = [package.module for package in packages if package.ids]
    if not names:
        return f"is the package that has it installed? {own[0].upper()}{own[1:]}"
    example = next(package.examples[0] for package in packages if package.ids)
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return (
        f"packages with environments are installed ({', '.join(names[:MOST_NAMED])}{more}): their ids are given as "
        f"{names[0]}:{example}, and {own}"
    )


def most_similar(env_id: str, names: Iterable[str] = ()) -> str | None:
    """The registered id that is most similar, or one of these `module:name`; None if none is similar."""
    known = [*gymnasium.registry, *names]
    by_name = {one.rpartition(":")[2].lower(): one for one in known}
    close = difflib.get_close_matches(env_id.lower(), by_name, n=1, cutoff=0.75)
    return by_name[close[0]] if close else None


def installed_packages() -> Iterator[InstalledPackage]:
    """Installed packages that need gymnasium, with the ids in their source text. Imports none of them."""
    for found in metadata.distributions():
        if any(re.match(r"gymnasium\b", need) and "extra ==" not in need for need in found.requires or ()):
            files = [file for file in found.files or () if file.suffix == ".py" and len(file.parts) > 1]
            module = next((file.parts[0] for file in files if file.name == "__init__.py" and len(file.parts) == 2), "")
            if module and module not in {"workers", "learner", "millrace", "protocol"}:
                texts = _texts(path for file in files if file.parts[0] == module for path in [str(file.locate())])
                yield InstalledPackage(module, tuple(dict.fromkeys(_ids(texts))))


def _texts(paths: Iterable[str]) -> Iterator[str]:
    left = LARGEST_PACKAGE
    for path in sorted(paths, key=lambda path: (path.count("/"), path)):
        try:
            with open(path, encoding="utf-8", errors="replace") as file:
                text = file.read(LARGEST_FILE)
        except OSError:
            continue
        left -= len(text)
        if left < 0:
            return
        yield text


def _ids(texts: Iterable[str]) -> Iterator[str]:
    """The ids that are registered in a package's source text."""
    for text in texts:
        if "register" in text:
            yield from _REGISTERED.findall(text)
