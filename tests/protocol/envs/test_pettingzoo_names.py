"""Environments of PettingZoo by the name of a module, and what is said of names and wrappers that don't fit."""

from __future__ import annotations

from pathlib import Path

import pytest

from millrace.protocol.env_spec import AllowedCode, EnvSpec
from millrace.protocol.envs.seats import ParallelSeats, TurnSeats
from millrace.protocol.errors import UsageError

GAMES = "tests.support.users_code.seat_envs"


@pytest.fixture
def zoo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package `a_zoo` with two modules that are named as PettingZoo's."""
    (tmp_path / "a_zoo").mkdir()
    (tmp_path / "a_zoo" / "__init__.py").touch()
    (tmp_path / "a_zoo" / "turns_v3.py").write_text(f"from {GAMES} import RandomGame as env\n")
    (tmp_path / "a_zoo" / "crowd_v12.py").write_text(f"from {GAMES} import RandomGame as env, RandomCrowd as parallel_env\n")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.usefixtures("zoo")
def test_a_module_with_a_version_has_a_parallel_environment_or_one_with_turns() -> None:
    assert isinstance(EnvSpec("a_zoo.crowd_v12").make(), ParallelSeats)
    assert isinstance(EnvSpec("a_zoo.turns_v3").make(), TurnSeats)
    assert isinstance(EnvSpec("a_zoo.crowd_v12:env").make(), TurnSeats)
    assert EnvSpec("a_zoo.crowd_v12").rejection_reason(AllowedCode.MODULES), "its function is called"


@pytest.mark.usefixtures("zoo")
@pytest.mark.parametrize(
    ("name", "says"),
    [
        (
            "a_zoo.crowd_v10",
            r"^environment a_zoo.crowd_v10: No module named 'a_zoo.crowd_v10'; did you mean a_zoo.crowd_v12\?$",
        ),
        ("a_zoo.other_v1", r"^environment a_zoo.other_v1: No module named 'a_zoo.other_v1'$"),
        ("no_zoo.crowd_v12", r"a package it needs is missing \(No module named 'no_zoo'\); pip install it, then try again$"),
    ],
)
def test_a_module_that_is_not_there_is_one_line(name: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        EnvSpec(name).make()


def test_gymnasium_s_wrappers_are_for_one_agent() -> None:
    with pytest.raises(UsageError, match=r"^wrapper gymnasium.wrappers:FlattenObs.*expected one of PettingZoo's or super"):
        EnvSpec(f"{GAMES}:RandomCrowd", wrappers=("gymnasium.wrappers:FlattenObservation",)).make()
