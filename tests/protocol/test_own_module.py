"""What is wrong with a name of the user's code is the same line, whichever setting names it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from gymnasium.spaces import Box, Discrete

from millrace.learner.callbacks.named import named_callback
from millrace.learner.config.layers import resolve
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import PolicyFailed, UserFacingError
from millrace.protocol.own_module import own_callable
from millrace.protocol.policy.called_policy import CalledPolicy
from millrace.protocol.policy.own_encoder import describe_encoder
from millrace.protocol.specs import OwnPolicySpec, PolicySpec

OBSERVATION, ACTION = observation_leaves(Box(-1, 1, (4,))), action_spec(Discrete(2))


def policy(name: str) -> object:
    return CalledPolicy(PolicySpec(OBSERVATION, ACTION, own=OwnPolicySpec(name, ())), ())


USES: dict[str, Callable[[str], object]] = {
    "algo": lambda name: resolve("CartPole-v1", algo=name),
    "callback": named_callback,
    "encoder": lambda name: describe_encoder(name, OBSERVATION, ACTION),
    "policy": policy,
    "wrapper": lambda name: EnvSpec("CartPole-v1", wrappers=(name,)).make(),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "of_own_module.py").write_text("number = 3\ndef Stop(): ...\ndef _Stpp(): ...\n")
    (tmp_path / "raises_at_import.py").write_text("int('two\\nlines')\n")
    (tmp_path / "leaves_at_import.py").write_text("import sys; sys.exit(3)\n")
    (tmp_path / "needs_a_package.py").write_text("import not_installed_here\n")
    return tmp_path


def failure(setting: str, name: str) -> UserFacingError:
    with pytest.raises(UserFacingError) as raised:
        USES[setting](name)
    assert isinstance(raised.value, PolicyFailed) == (setting == "policy"), "in a worker, a policy fails as a policy"
    assert str(raised.value).startswith(f"{setting} {name}: ")
    return raised.value


@pytest.mark.parametrize("setting", USES)
@pytest.mark.parametrize(
    ("name", "says", "detail"),
    [
        ("nowhere_to_find:Mine", "no module named nowhere_to_find; is it installed, or its folder on PYTHONPATH?", ""),
        (
            "of_own_module.py:Stop",
            "no module named of_own_module.py; a file is named as a module, without .py: write of_own_module:NAME",
            "",
        ),
        ("nowhere_to.find:Mine", "no module named nowhere_to; is it installed, or its folder on PYTHONPATH?", ""),
        (
            "needs_a_package:Mine",
            "the import of needs_a_package failed: ModuleNotFoundError: No module named 'not_installed_here'; pip "
            "install it, then try again",
            "",
        ),
        (
            "raises_at_import:Mine",
            r"the import of raises_at_import failed: ValueError: invalid literal for int() with base 10: 'two\nlines'",
            "raises_at_import.py",
        ),
        ("leaves_at_import:Mine", "the import of leaves_at_import failed: SystemExit: 3", "leaves_at_import.py"),
    ],
)
def test_what_cannot_be_imported_is_the_same_line_for_every_setting(
    setting: str, name: str, says: str, detail: str, folder: Path
) -> None:
    error = failure(setting, name)
    assert str(error) == f"{setting} {name}: {says}"
    assert (detail in error.detail, bool(error.detail)) == (True, bool(detail)), (
        "the traceback, where the user's code raised"
    )


@pytest.mark.parametrize("setting", sorted(USES.keys() - {"algo"}))  # a class is looked for: its line names the file, too
def test_what_a_module_lacks_is_the_same_line_for_every_setting(setting: str, folder: Path) -> None:
    line = str(failure(setting, "of_own_module:Stp"))
    assert line.endswith(": module of_own_module has no Stp; did you mean of_own_module:Stop?")
    assert str(failure(setting, "of_own_module:quite_another")).endswith(" has no quite_another")
    assert str(failure(setting, "of_own_module:number")).endswith(": expected a function or class to call, got int")


@pytest.mark.parametrize("setting", ["callback", "encoder", "policy"])
@pytest.mark.parametrize("name", ["Mine", ":Mine", "mine:", "mi ne:Mine", "a:b:c"])
def test_what_is_no_name_is_refused_before_anything_is_imported(setting: str, name: str) -> None:
    assert ": expected module:factory, as in " in str(failure(setting, name))


def test_what_it_names_may_stand_in_another(folder: Path) -> None:
    (folder / "nested_of_mine.py").write_text("class Outer:\n    class Inner: ...\n")
    assert own_callable("nested_of_mine:Outer.Inner", "callback", "a:b").__qualname__ == "Outer.Inner"
