"""The kinds of env copies: ours, those that packages install, and what is refused."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

import pytest

from millrace.learner.config.layers import resolve
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.kinds_of_copies import GROUP, KINDS, CopiesKind, check_kind, copies_kind
from millrace.protocol.errors import UsageError
from millrace.protocol.messages import Describe
from millrace.workers.described_copy import describe
from tests.support.in_process.collectors import trained
from tests.support.installed_package import install_package

SOURCE = """
from gymnasium.spaces import Box, Discrete

from millrace.protocol.envs.kinds_of_copies import CopiesKind
from millrace.workers.copies.looped_kind import open_loop

LOOPED = CopiesKind(open_loop, lambda env: (Box(-1.0, 1.0, (7,)), Discrete(2)))
NOTHING = 1
"""
Install = Callable[[str], None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Installs a package whose entry points of our group are these."""

    def installed(entry_points: str) -> None:
        install_package(tmp_path, monkeypatch, module="fake_copies", source=SOURCE, group=GROUP, entry_points=entry_points)

    yield installed
    sys.modules.pop("fake_copies", None)


def test_ours_can_be_imported() -> None:
    for name in KINDS:
        assert isinstance(copies_kind(name), CopiesKind), name


def test_for_ours_no_entry_point_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(metadata, "entry_points")
    for name in KINDS:
        check_kind(name)


def test_that_of_a_package_is_imported_when_it_is_asked_for(install: Install) -> None:
    install("looped = fake_copies:LOOPED")
    check_kind("looped")
    assert "fake_copies" not in sys.modules
    assert copies_kind("looped") is sys.modules["fake_copies"].LOOPED


def test_a_run_uses_that_of_a_package(install: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install("looped = fake_copies:LOOPED")
    with pytest.raises(UsageError, match=r"vector looped: its copies have other spaces than itself, Box.*\(7,\)"):
        trained(tmp_path, "looped", 1)
    monkeypatch.setattr("fake_copies.LOOPED", copies_kind("looped")._replace(spaces=None))
    assert trained(tmp_path / "installed", "looped", 1) == trained(tmp_path / "ours", "loop", 1)


def test_a_name_that_nobody_has_is_refused_before_workers_start(install: Install) -> None:
    install("looped = fake_copies:LOOPED")
    known = "loop, native, envpool, looped"
    with pytest.raises(UsageError, match=rf"^vector sync: expected one of {known}; is the package that has it installed"):
        resolve("CartPole-v1", vector="sync")
    with pytest.raises(UsageError, match=rf"^vector envpol: expected one of {known}; did you mean envpool\?"):
        resolve("CartPole-v1", vector="envpol")


@pytest.mark.parametrize(
    ("entry_point", "why"),
    [
        ("fake_copies:NOTHING", "vector odd: expected fake_copies:NOTHING to be a CopiesKind, got int"),
        ("fake_copies:MISSING", "vector odd: expected fake_copies:MISSING to be a CopiesKind, got NoneType"),
        ("fake_missing:LOOPED", "vector odd: no module named fake_missing; is it installed, or its folder on PYTHONPATH?"),
    ],
)
def test_an_entry_point_that_is_no_kind_is_one_line(install: Install, entry_point: str, why: str) -> None:
    install(f"odd = {entry_point}")
    with pytest.raises(UsageError) as caught:
        describe(Describe(1, 1, EnvSpec("CartPole-v1"), "odd"))
    assert str(caught.value) == why
