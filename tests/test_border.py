"""The border between the core and the extras: the core imports no extra. An extra may import the core, never another extra.

So an extra can be added, changed or left out without touching the core, apart from the tables in which the core names, as
text, what it takes of an extra (`NAMED_IN`). What an extra takes of the core is counted (`TAKEN`).
"""

from __future__ import annotations

from functools import cache

import pytest

import millrace
from tests.test_architecture import PACKAGES, ROOT, module, modules_imported, sources

NAMED_IN = {
    "learner/extras.py": "what a setting or a public function starts",
    "millrace/cli/commands.py": "commands",
    "protocol/env_spec.py": "the environments that come with millrace",
    "protocol/envs/kinds_of_copies.py": "kinds of env copies",
}
"""Where the core names extras, as `module:name` or as a module, and what for."""
FOLDER = "millrace/extras/"
OF_EXTRAS = "millrace.extras."
DOOR = "millrace.door"
TAKEN = {"conformance": 83, "datasets": 73, "envs": 34, "launchers": 20, "monitoring": 76}
"""How many names of the core each extra imports, besides the public names of `millrace` and those of `millrace.door`.

A number may only become smaller: the fewer names an extra takes, the fewer changes of the core can break it.
"""


def extra_of(source: str) -> str | None:
    """The extra that a file belongs to; None if it belongs to the core."""
    return source.removeprefix(FOLDER).split("/")[0].removesuffix(".py") if source.startswith(FOLDER) else None


@cache
def extra_of_each_module() -> dict[str, str]:
    return {module(source): extra for source in sources(*PACKAGES) if (extra := extra_of(source)) is not None}


def extras_imported(source: str) -> set[str]:
    """The extras that a file imports anything of."""
    extras = extra_of_each_module()
    owners = {owner for name in modules_imported(source) for owner in (name, name.rpartition(".")[0])}
    return {extras[owner] for owner in owners & extras.keys()}


def taken_of_the_core(extra: str) -> set[str]:
    """The names of the core that an extra imports, besides the public names and those of the door, each as `module.name`."""
    imported = {name for source in sources(f"{FOLDER}{extra}") for name in modules_imported(source)}
    public = {f"millrace.{name}" for name in millrace.__all__}
    of_the_core = {name for name in imported - public if name.startswith("millrace.")}
    return {name for name in of_the_core if not name.startswith((OF_EXTRAS, DOOR))}


def test_these_are_the_extras() -> None:
    assert {*extra_of_each_module().values()} == {*TAKEN, "__init__"}


def test_the_core_imports_no_extra() -> None:
    core = [source for source in sources(*PACKAGES) if extra_of(source) is None]
    assert {source: extras for source in core if (extras := extras_imported(source))} == {}


def test_the_core_names_extras_only_in_its_tables() -> None:
    naming = {
        source for source in sources(*PACKAGES) if extra_of(source) is None and OF_EXTRAS in (ROOT / source).read_text()
    }
    assert naming == NAMED_IN.keys()


@pytest.mark.parametrize("extra", TAKEN)
def test_no_extra_imports_another(extra: str) -> None:
    for source in sources(f"{FOLDER}{extra}"):
        assert extras_imported(source) <= {extra}, source


@pytest.mark.parametrize("extra", TAKEN)
def test_an_extra_takes_no_more_of_the_core_than_it_did(extra: str) -> None:
    taken = taken_of_the_core(extra)
    assert len(taken) == TAKEN[extra], "\n".join(sorted(taken))
