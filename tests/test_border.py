"""The border between the core and the extras: the core imports no extra. An extra may import the core, never another extra.

So an extra can be added, changed or left out without touching the core. The core names what it takes of an extra, and which
command an extra gives, as text (`learner/extras.py`, `millrace/cli/commands.py`, `protocol/envs/kinds_of_copies.py`).
"""

from __future__ import annotations

from functools import cache

import pytest

from tests.test_architecture import PACKAGES, module, modules_imported, sources

FOLDER = "millrace/extras/"
EXTRAS = ("conformance", "datasets", "envs", "launchers", "monitoring")


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


def test_these_are_the_extras() -> None:
    assert {*extra_of_each_module().values()} == {*EXTRAS, "__init__"}


def test_the_core_imports_no_extra() -> None:
    core = [source for source in sources(*PACKAGES) if extra_of(source) is None]
    assert {source: extras for source in core if (extras := extras_imported(source))} == {}


@pytest.mark.parametrize("extra", EXTRAS)
def test_no_extra_imports_another(extra: str) -> None:
    for source in sources(f"{FOLDER}{extra}"):
        assert extras_imported(source) <= {extra}, source
