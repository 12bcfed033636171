"""What words an error never raises, whatever objects of the user's or of other packages it looks at."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import metadata
from types import ModuleType, SimpleNamespace
from typing import Any, cast

import gymnasium
import numpy as np
import pytest

from millrace.learner.run_folder.last_line import last_line
from millrace.protocol.env_spec import EnvSpec, check_arguments
from millrace.protocol.envs.advice.old_gym import INSTALL, instead_of_id, instead_of_object, is_of_old_gym
from millrace.protocol.envs.advice.space_advice import observation_advice
from millrace.protocol.envs.found_names import attribute, importable, name_of
from millrace.protocol.envs.make_env import why_not_made
from millrace.protocol.envs.unknown_ids import load_plugins, what_to_write
from millrace.protocol.envs.wrappers import wrap
from millrace.protocol.errors import UsageError, first_line, joined, safe_repr, words_an_error, worker_exception
from millrace.workers.copies.env_errors import CopyFailed, environment_failed
from millrace.workers.copies.episode_facts import facts_of_info
from millrace.workers.copies.mask_reader import _shown
from millrace.workers.copies.row_writers import missing_leaf, one_number


class Raises:
    """Whatever one asks it raises."""

    def __getattr__(self, name: str) -> object:
        raise RuntimeError(f"no {name}")

    def __repr__(self) -> str:
        raise RuntimeError("no repr")

    __str__ = __repr__


class RaisesOften(Raises):
    """Also what every object has."""

    @property
    def __module__(self) -> str:  # type: ignore[override]
        raise ValueError("no module")

    @property
    def __dict__(self) -> dict[str, object]:  # type: ignore[override]
        raise ValueError("no dict")

    def __len__(self) -> int:
        raise ValueError("no len")

    def __bool__(self) -> bool:
        raise ValueError("no truth")

    def __eq__(self, other: object) -> bool:
        raise ValueError("not comparable")

    __hash__ = None  # type: ignore[assignment]


class OddModule:
    """The class of it says that it stands in no module with a name."""


OddModule.__module__ = 3  # type: ignore[assignment]


class OddError(Exception):
    """An exception whose text raises."""

    def __str__(self) -> str:
        raise RuntimeError("no text")

    __repr__ = __str__


class OddMissing(ModuleNotFoundError, OddError):
    """A missing module without a name."""


def a_cycle() -> list[Any]:
    cycle: list[Any] = []
    cycle.append(cycle)
    return cycle


ODD: dict[str, Any] = {
    "none": None,
    "raises": Raises(),
    "raises often": RaisesOften(),
    "odd module": OddModule(),
    "a class": Raises,
    "text": "a\x1b[2J\ud800",
    "an array": np.zeros(3),
    "a cycle": a_cycle(),
}
ERRORS: dict[str, Exception] = {
    "no text": OddError(),
    "missing": OddMissing(),
    "missing, without a name": ModuleNotFoundError("gone", name=None),
    "of an argument": TypeError("missing 1 required positional argument", Raises()),
    "unknown id": gymnasium.error.UnregisteredEnv("unknown"),
    "no args": KeyError(),
    "a group": ExceptionGroup("two", [OddError(), ValueError()]),
}
odd = pytest.mark.parametrize("value", list(ODD), indirect=True)


@pytest.fixture
def value(request: pytest.FixtureRequest) -> Any:
    """An odd object. Its name is the parameter, because pytest asks parameters for their names."""
    return ODD[request.param]


odd_error = pytest.mark.parametrize("error", ERRORS.values(), ids=list(ERRORS))


# -------------------------------------------------------------------------------------------- the helpers


@odd
def test_a_value_is_quoted_or_said_to_raise(value: Any) -> None:
    text = safe_repr(value)
    assert text == "<Raises, whose repr raised RuntimeError>" or "raised" in text or text == repr(value)


@odd_error
def test_every_error_has_a_first_line(error: Exception) -> None:
    assert "\n" not in first_line(error)
    assert last_line("millrace", error, "millrace train").startswith("millrace: internal error: ")


def test_notes_that_are_no_text_are_left_out() -> None:
    error = ValueError("no")
    error.__notes__ = [3, "text"]  # type: ignore[list-item]
    assert last_line("millrace", error, "").endswith("ValueError: no; text")


def test_advice_that_raises_is_no_advice() -> None:
    def words(known: bool) -> str:
        if not known:
            raise LookupError
        return "try this"

    assert joined("it failed", words_an_error(words)(True)) == "it failed; try this"
    assert joined("it failed", words_an_error(words)(known=False)) == "it failed"


@pytest.mark.parametrize("text", ["ExceptionGroup: x", "UnicodeDecodeError: x", "OSError", "type: x", "a\nb: c", ":"])
def test_every_traceback_becomes_an_exception(text: str) -> None:
    assert isinstance(worker_exception(text), Exception)


# -------------------------------------------------------------------------------------------- names and advice


@odd
def test_everything_has_a_name(value: Any) -> None:
    assert isinstance(name_of(value), str)
    assert attribute(value, "no_such.thing") is None


def test_a_module_in_a_broken_package_cannot_be_imported(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken_package").mkdir()
    (tmp_path / "broken_package" / "__init__.py").write_text("raise RuntimeError")
    monkeypatch.syspath_prepend(tmp_path)
    assert not importable("broken_package.module")


@odd
def test_advice_about_old_gym_looks_at_anything(value: Any) -> None:
    assert isinstance(is_of_old_gym(value), bool)
    assert isinstance(instead_of_object(value), str)


class OfGym:
    """An environment of gym 0.9."""

    def reset(self) -> None: ...

    def seed(self, seed: int) -> None: ...


SPECS: dict[str, tuple[Any, str]] = {
    "a class": (SimpleNamespace(entry_point=OfGym), "V21"),
    "of gym 0.9": (SimpleNamespace(_entry_point=f"{__name__}:OfGym"), "V21"),
    "nothing": (SimpleNamespace(_entry_point=None), "V26"),
    "no module": (SimpleNamespace(entry_point="no_such_module:Env"), "V26"),
    "no name": (SimpleNamespace(entry_point="::"), "V26"),
    "a number": (SimpleNamespace(entry_point=3), "V26"),
    **{f"odd: {name}": (each, "V26") for name, each in ODD.items() if each is not None},
}


@pytest.mark.parametrize("name", SPECS)
def test_advice_about_an_id_of_old_gym_looks_at_any_specification(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    spec, version = SPECS[name]
    gym = ModuleType("gym")
    gym.envs = SimpleNamespace(registration=SimpleNamespace(registry=SimpleNamespace(env_specs={"Old-v0": spec})))  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gym", gym)
    expected = f"`{INSTALL}`, then write shimmy:Gym{version}Environment-v0 --env-kwargs env_id old:Old-v0"
    assert instead_of_id("old:Old-v0") == expected
    line = why_not_made("old:Old-v0", gymnasium.error.UnregisteredEnv("no"))
    assert line == f"environment old:Old-v0 is of the old package gym; {expected}"


@odd
def test_advice_about_spaces_looks_at_anything(value: Any) -> None:
    assert isinstance(observation_advice(value), str)
    env = SimpleNamespace(unwrapped=value, observation_space=gymnasium.spaces.Dict({"a": gymnasium.spaces.Text(3)}))
    env.observation_space.spaces["odd"] = value
    assert isinstance(observation_advice(cast(Any, env)), str)


@odd_error
@pytest.mark.parametrize("env_id", ["Odd-v0", "odd:Odd-v0", "ALE/Odd-v5", "odd:make", "", ":", "a.b_v0"])
def test_why_an_environment_was_not_made_is_one_line(error: Exception, env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "odd", RaisesOften())

    def why_not(meant: str) -> str:
        raise OddError

    line = why_not_made(env_id, error, why_not=why_not)
    assert line.startswith("environment ")
    assert "\n" not in line


@odd
def test_what_is_no_environment_is_refused_in_one_line(value: Any) -> None:
    with pytest.raises(UsageError, match=r"^env"):
        EnvSpec.of(lambda: value).make()
    with pytest.raises(UsageError, match=r"^wrapper"):
        wrap(gymnasium.make("CartPole-v1"), lambda env: value)


@odd
def test_an_argument_that_no_message_can_carry_is_refused_in_one_line(value: Any) -> None:
    if value is not None:
        with pytest.raises(UsageError, match="argument a: expected a number"):
            check_arguments({"a": value}, "environment")


# -------------------------------------------------------------------------------------------- installed packages


def test_a_plugin_that_is_damaged_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    entry_points = metadata.EntryPoints([metadata.EntryPoint("odd", "", "gymnasium.envs")])
    monkeypatch.setattr(metadata, "entry_points", lambda: entry_points)
    assert load_plugins("Odd-v0") == []
    monkeypatch.setattr(gymnasium, "registry", 3)
    assert what_to_write("Odd-v0", lambda env_id: "") == ""


# -------------------------------------------------------------------------------------------- what an env copy returned


def told(call: Callable[[], object]) -> str:
    """What is said of the value; empty if nothing is."""
    try:
        call()
    except CopyFailed as error:
        return environment_failed(3, error).args[0]  # type: ignore[no-any-return]
    return ""


@odd
def test_what_an_env_copy_returned_is_quoted(value: Any) -> None:
    assert "lane 3, copy 1, reset: reward: expected a number, got " in told(lambda: one_number("reward", 1, value))
    assert told(lambda: facts_of_info(["a"], {"a": value}, 1)) or value is None
    assert _shown(value, None).startswith(type(value).__name__)
    line = environment_failed(3, missing_leaf(1, {"a": 1, ("odd", 2): value}, OddError())).args[0]
    assert "expected the structure of its space, got a dict of 'a', " in line


@odd_error
def test_what_an_env_copy_raised_is_one_line(error: Exception) -> None:
    failed = CopyFailed(1)
    failed.__cause__ = error
    line = environment_failed(3, failed).args[0]
    assert line.startswith(f"lane 3, copy 1, reset: its environment raised {type(error).__name__}: ")
    assert "\n" not in line
