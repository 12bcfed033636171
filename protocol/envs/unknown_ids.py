"""Environment ids that gymnasium does not know: which installed package registers them, and what to write if none does.

Rule: a package is imported for an id only if it says that it registers it: by the entry points `gymnasium.envs`, which
gymnasium 1 does not call any more; by the namespace of the id, which is the package's name; or in its source text, which is
read first. Packages that do not need gymnasium are never imported. A worker does all this by itself, on its own machine. An
id is suggested only if it could be made.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib
import io
import re
import sys
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
LARGEST_FILE, LARGEST_PACKAGE = 1 << 20, 1 << 24  # bytes of source text that are read
MOST_NAMED = 3
FEWEST_LETTERS = 3
_REGISTERED = re.compile(r"""(?:\bid\s*=|\bregister\()\s*f?["']([\w./{}-]+)["']|["']([\w./{}-]+-v\d+)["']""")
_PART = re.compile(r"{[^}]*}")  # of an f-string


class InstalledPackage(NamedTuple):
    """An installed package that needs gymnasium, and so may have environments."""

    module: str
    """the module to import"""
    ids: dict[str, str]
    """the ids that stand in its source text, and the module where each stands; `{…}` stands for any part of an id"""

    def registering(self, env_id: str) -> list[str]:
        """The modules to import so that this id is registered; none if the package says nothing of it."""
        named = env_id.partition("/")[0].replace("-", "_").lower() == self.module.lower()
        modules = [module for pattern, module in self.ids.items() if _matches(pattern, env_id)]
        return list(dict.fromkeys([self.module, *modules])) if named or modules else []

    @property
    def examples(self) -> list[str]:
        """Ids that it registers."""
        return [_PART.sub("", each) for each in self.ids]


class Plugin(NamedTuple):
    """A function that registers the environments of an installed package."""

    entry_point: metadata.EntryPoint
    namespace: str
    """the namespace of its ids; empty if there is none"""


def find(env_id: str) -> list[str]:
    """Let installed packages register their environments until this id is known. Returns a line for each that failed."""
    failed: list[str] = []
    for package in installed_packages():
        for module in package.registering(env_id):
            with _quietly(module, failed):
                imported = importlib.import_module(module)
                if not is_registered(env_id):  # some have a function of this name, which others would call
                    getattr(imported, "register_envs", bool)()
            if is_registered(env_id):
                return failed  # the texts of the other packages need not be read
    return failed + load_plugins(env_id)


def load_plugins(env_id: str) -> list[str]:
    """Let installed plugins register their environments until this id is known. Returns a line for each that failed."""
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
    """Within it, another package prints nothing; what it raises becomes a line of `failed`."""
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    except Exception as error:
        install = f"; {what_to_install(error.name)}" if isinstance(error, ModuleNotFoundError) else ""
        failed.append(f"{module}: {type(error).__name__}: {one_line(first_line(error), 200)}{install}")


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
        if (entry_point.group == GROUP or entry_point.group.startswith(f"{GROUP}.")) and _is_whole(entry_point):
            namespace = entry_point.name if entry_point.group == GROUP else entry_point.group[len(GROUP) + 1 :]
            yield Plugin(entry_point, "" if namespace == "__root__" else namespace)


def _is_whole(entry_point: metadata.EntryPoint) -> bool:
    """Whether it names a module, as it should."""
    try:
        return bool(entry_point.module)
    except AttributeError:
        return False


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
    return any(_matches(pattern, env_id) for pattern in _ids([_source(module)]))


def _matches(pattern: str, env_id: str) -> bool:
    return re.fullmatch(r"[\w.-]*".join(map(re.escape, _PART.split(pattern))), env_id) is not None


def _source(module: str) -> str:
    """The source text of a module that is imported here; empty if it has none."""
    try:
        return Path(str(getattr(sys.modules.get(module), "__file__", None))).read_text("utf-8", "replace")
    except OSError:
        return ""


@words_an_error
def what_to_write(env_id: str, why_not: Callable[[str], str]) -> str:
    """What to write instead of an id that is not registered, as the end of a line.

    `why_not` makes an environment, and returns the line that says why it cannot be made, or nothing.
    """
    packages = list(installed_packages())
    examples = [example for package in packages for example in package.examples]
    if (similar := most_similar(env_id, examples, why_not)) is not None:
        return similar
    own = "one of your own is given as my_module:MyEnv-v0, one of a client in another language needs the client (--bind)"
    names = list(dict.fromkeys(package.module for package in packages if package.ids))
    if not names:
        return f"is the package that has it installed? {own[0].upper()}{own[1:]}"
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return f"no installed package registers it ({', '.join(names[:MOST_NAMED])}{more} have environments), and {own}"


def most_similar(env_id: str, examples: Iterable[str], why_not: Callable[[str], str]) -> str | None:
    """Which of the registered ids and of these `examples` was perhaps meant, as the end of a line; None if none is similar.

    It can be made, or the line says what to install first.
    """
    by_name = {one.rpartition(":")[2].lower(): one for one in [*gymnasium.registry, *examples]}
    for close in difflib.get_close_matches(env_id.lower(), by_name, cutoff=0.75):
        meant = by_name[close]
        if not (line := why_not(meant)):
            return f"did you mean {meant}?"
        if "pip install" in line:
            return f"did you mean {meant}? It cannot be made yet: {line}"
    return None


def installed_packages() -> Iterator[InstalledPackage]:
    """Installed packages that need gymnasium, with the ids in their source text. Imports none of them."""
    for found in sorted(metadata.distributions(), key=_name_of):
        try:
            package = _with_environments(found)
        except Exception:  # what is left of a package that was removed, or a file of it that cannot be read
            continue
        if package is not None:
            yield package


def _name_of(found: metadata.Distribution) -> str:
    """The name of an installed package; empty if its metadata are gone."""
    try:
        return str(found.name)
    except Exception:
        return ""


def _with_environments(found: metadata.Distribution) -> InstalledPackage | None:
    """The package that this is, if it may have environments."""
    if not any(re.match(r"gymnasium\b", need) and "extra ==" not in need for need in found.requires or ()):
        return None
    files = [file for file in found.files or () if file.suffix == ".py" and len(file.parts) > 1]
    module = next((file.parts[0] for file in files if file.name == "__init__.py" and len(file.parts) == 2), "")
    if not module or module == "millrace":
        return None
    return InstalledPackage(module, dict(_ids_of_files([file for file in files if file.parts[0] == module])))


def _ids_of_files(files: Iterable[metadata.PackagePath]) -> Iterator[tuple[str, str]]:
    """The ids that stand in these files, each with the module that it stands in."""
    left = LARGEST_PACKAGE
    for file in sorted(files, key=lambda file: (len(file.parts), file)):
        try:
            with open(str(file.locate()), encoding="utf-8", errors="replace") as opened:
                text = opened.read(LARGEST_FILE)
        except OSError:
            continue
        left -= len(text)
        if left < 0:
            return
        module = ".".join(file.with_suffix("").parts).removesuffix(".__init__")
        yield from ((env_id, module) for env_id in _ids([text]))


def _ids(texts: Iterable[str]) -> Iterator[str]:
    """What may be the ids that are registered in a package's source text: at least three letters of each are known."""
    for text in texts:
        for found in _REGISTERED.findall(text) if "register" in text else ():
            each = "".join(found)
            if len(_PART.sub("", each).partition("-v")[0]) >= FEWEST_LETTERS:
                yield each
