"""What a user gives as an environment or a wrapper: how it travels, and the name by which it is found again."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle
import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.wrappers import RecordEpisodeStatistics, TimeLimit

from millrace.protocol.env_spec import AllowedCode, EnvSpec, remembered_name
from millrace.protocol.envs.found_names import found_by_others, moved, name_of
from millrace.protocol.envs.unknown_ids import ids_of_gymnasium
from millrace.protocol.envs.wrappers import read_wrapper, wrapper_name
from millrace.protocol.errors import UsageError
from tests.support.envs.toy import Countdown

MODULE = __name__


class Halved(gymnasium.RewardWrapper[Any, Any]):
    def reward(self, reward: Any) -> float:
        return float(reward) / 2


def make_countdown(k: int = 5) -> gymnasium.Env[Any, Any]:
    return Countdown(k)


class Outer:
    class Inner(Halved):
        pass


def not_an_env() -> object:
    return 3


def asks_for_an_unknown_id() -> gymnasium.Env[Any, Any]:
    return gymnasium.make("OnlyInTheScript-v0")


def many() -> object:
    return gymnasium.vector.SyncVectorEnv([make_countdown])


@pytest.fixture
def registry() -> Iterator[None]:
    """The registry of gymnasium is as before afterwards."""
    before = dict(gymnasium.registry)
    yield
    gymnasium.registry.clear()
    gymnasium.registry.update(before)


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Stands in for the module of a script."""
    module = ModuleType("__main__")
    exec("import gymnasium\nclass Mine(gymnasium.Env): pass\ndef make(): return Mine()", module.__dict__)
    monkeypatch.setitem(sys.modules, "__main__", module)
    return module


def first_reward(spec: EnvSpec) -> float:
    env = spec.make()
    env.reset(seed=1)
    reward = float(env.step(env.action_space.sample())[1])
    env.close()
    return reward


# ------------------------------------------------------------------------------------------------------------- names


def test_names_say_who_finds_what_they_name(script: ModuleType) -> None:
    def inside() -> None: ...

    assert name_of(Halved) == f"{MODULE}:Halved"
    assert name_of(Outer.Inner) == f"{MODULE}:Outer.Inner"
    assert name_of(script.make) == "__main__:make"
    assert name_of(inside) == "<inside>"
    assert name_of(lambda: None) == "<lambda>"
    assert name_of(Halved(gymnasium.make("CartPole-v1"))) == "<Halved>"
    names = [f"{MODULE}:Halved", "__main__:make", "<inside>", "CartPole-v1"]
    assert [found_by_others(name) for name in names] == [True, False, False, True]


def test_a_class_that_another_took_the_name_of_is_found_by_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    before = Halved
    monkeypatch.setattr(sys.modules[MODULE], "Halved", Outer)
    assert name_of(before) == "<Halved>"


def test_a_program_that_runs_as_a_module_is_found_under_its_name(script: ModuleType) -> None:
    script.__spec__ = type("Spec", (), {"name": "package.mine"})()
    assert name_of(script.make) == "package.mine:make"
    script.__spec__ = type("Spec", (), {"name": "package.__main__"})()
    assert name_of(script.make) == "__main__:make"


@pytest.mark.parametrize(
    ("before", "now", "same"),
    [
        ("<Clip>", "mine:Clip", True),
        ("__main__:Clip", "mine:Clip", True),
        ("__main__:My-v0", "mine:My-v0", True),
        ("__main__:space/My-v0", "mine:space/My-v0", True),
        ("Mine-v0", "mine:Mine-v0", True),  # as an id of a script was remembered before
        ("mine:Clip", "mine:Clip", True),
        ("<Clip>", "mine:Clap", False),
        ("mine:Clip", "other:Clip", False),
        ("mine:Clip", "<Clip>", False),
        ("CartPole-v1", "CartPole-v0", False),
    ],
)
def test_what_had_no_module_may_have_moved_into_one(before: str, now: str, same: bool) -> None:
    assert moved(before, now) is same


# ------------------------------------------------------------------------------------------------------ environments


def test_an_id_that_everyone_knows_travels_by_name() -> None:
    for env in ("CartPole-v1", gymnasium.spec("CartPole-v1"), gymnasium.make("CartPole-v1").spec):
        assert env is not None
        assert EnvSpec.of(env) == EnvSpec("CartPole-v1")
    assert EnvSpec.of("millrace/CartDoublePendulum-v0").factory is None


def test_a_name_of_a_function_or_a_class_makes_an_environment() -> None:
    assert first_reward(EnvSpec.of(f"{MODULE}:make_countdown", {"k": 3})) == first_reward(EnvSpec.of(Countdown, {"k": 3}))
    assert isinstance(EnvSpec(f"{Countdown.__module__}:Countdown").make(), Countdown)
    with pytest.raises(
        UsageError, match=r"not_an_env: expected it to return an environment of gymnasium or PettingZoo, got int$"
    ) as why:
        EnvSpec(f"{MODULE}:not_an_env").make()
    assert not why.value.detail, "nothing has raised: a traceback says nothing more"
    with pytest.raises(UsageError, match=r"got SyncVectorEnv; it is a vector environment: return one copy"):
        EnvSpec(f"{MODULE}:many").make()
    with pytest.raises(
        UsageError, match=r"neither registers make_countdwn nor .* class or function; did you mean .*:make_countdown\?$"
    ):
        EnvSpec(f"{MODULE}:make_countdwn").make()


def test_a_callable_travels_pickled_and_is_remembered_by_its_name() -> None:
    spec = EnvSpec.of(make_countdown, {"k": 3})
    assert (spec.id, spec.factory is None) == (f"{MODULE}:make_countdown", False)
    again = EnvSpec.of(spec.id, spec.kwargs)
    assert again.factory is None
    assert first_reward(again) == first_reward(spec)
    assert EnvSpec.of(lambda: Countdown()).id == "<lambda>"


def test_an_id_that_only_this_process_registered_travels_pickled(registry: None, script: ModuleType) -> None:
    gymnasium.register("Own-v3", script.Mine, max_episode_steps=7)
    gymnasium.register("ByText-v3", "__main__:Mine", max_episode_steps=8)
    assert remembered_name("Own-v3") == remembered_name(gymnasium.spec("Own-v3")) == "__main__:Own-v3"
    for env, limit in (("Own-v3", 7), ("__main__:Own-v3", 7), ("ByText-v3", 8), (gymnasium.spec("ByText-v3"), 8)):
        spec = EnvSpec.of(env)
        assert spec.factory is not None
        registered = dict(gymnasium.registry)
        gymnasium.registry.clear()  # as in a worker
        made = spec.make()
        gymnasium.registry.update(registered)
        assert type(made.unwrapped).__name__ == "Mine"
        assert made.spec is not None
        assert made.spec.max_episode_steps == limit


def made_elsewhere(spec: EnvSpec) -> gymnasium.Env[Any, Any]:
    """The environment as a process makes it in which none of these tests has registered an id."""
    for env_id in set(gymnasium.registry) - ids_of_gymnasium():
        del gymnasium.registry[env_id]
    return spec.make()


@pytest.mark.parametrize("entry_point", ["gymnasium.envs.classic_control:CartPoleEnv", CartPoleEnv])
def test_an_id_of_one_s_own_for_a_class_of_gymnasium_travels_pickled(registry: None, entry_point: Any) -> None:
    gymnasium.register("Short-v0", entry_point, max_episode_steps=7)
    assert remembered_name("Short-v0") == "__main__:Short-v0"
    made = made_elsewhere(EnvSpec.of("Short-v0"))
    assert made.spec is not None
    assert (made.spec.id, made.spec.max_episode_steps) == ("Short-v0", 7)


@pytest.mark.parametrize("wrappers", [[], [Halved]], ids=["alone", "in a wrapper"])
def test_a_callable_may_make_an_id_that_only_this_process_registered(
    registry: None, script: ModuleType, wrappers: list[Any]
) -> None:
    gymnasium.register("Own-v3", script.Mine, max_episode_steps=7)
    gymnasium.register("ByText-v3", "__main__:Mine", max_episode_steps=8)
    for env_id, limit in ("Own-v3", 7), ("ByText-v3", 8):
        spec = EnvSpec.of(partial(gymnasium.make, env_id, disable_env_checker=True), wrappers=wrappers)
        registered = dict(gymnasium.registry)
        made = made_elsewhere(spec)
        gymnasium.registry.update(registered)
        assert type(made.unwrapped).__name__ == "Mine"
        assert made.spec is not None
        assert made.spec.max_episode_steps == limit


def test_a_callable_needs_no_module_of_an_id_that_it_does_not_make(
    registry: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "only_here.py").write_text("import gymnasium\nclass Mine(gymnasium.Env): pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    only_here = importlib.import_module("only_here")
    gymnasium.register("Other-v0", only_here.Mine)
    gymnasium.register("Another-v0", lambda **_: only_here.Mine())
    spec = EnvSpec.of(make_countdown)
    monkeypatch.undo()  # as on another machine
    del sys.modules["only_here"]
    assert isinstance(made_elsewhere(spec), Countdown)


def test_an_id_that_cannot_be_sent_spoils_no_callable(registry: None) -> None:
    lock = __import__("threading").Lock()
    gymnasium.register("Locked-v0", lambda **_: lock)
    assert isinstance(made_elsewhere(EnvSpec.of(make_countdown)), Countdown)


def test_a_spec_that_is_not_the_registered_one_has_no_name(registry: None) -> None:
    shorter = gymnasium.make("CartPole-v1", max_episode_steps=3).spec
    assert shorter is not None
    spec = EnvSpec.of(shorter)
    assert spec.id == "<CartPole-v1>"
    made = spec.make()
    assert made.spec is not None
    assert made.spec.max_episode_steps == 3


@pytest.mark.parametrize(
    "spec",
    [
        EnvSpec.of(asks_for_an_unknown_id),
        EnvSpec.of(asks_for_an_unknown_id, wrappers=[lambda env: env]),
        EnvSpec(f"{MODULE}:asks_for_an_unknown_id"),
    ],
    ids=["pickled", "pickled with its wrapper", "by name"],
)
def test_a_callable_that_makes_an_id_of_the_script_alone_is_one_line_that_says_what_to_pass(spec: EnvSpec) -> None:
    with pytest.raises(UsageError, match="asks gymnasium for an id that is not registered in the worker") as raised:
        spec.make()
    line = str(raised.value)
    assert line.startswith(f"environment {MODULE}:asks_for_an_unknown_id: ")
    assert "`OnlyInTheScript` doesn't exist" in line
    assert "pass the id itself or gymnasium.spec(id)" in line
    assert "module:id" in line
    assert (raised.value.detail, "\n" in line) == ("", False)


def test_an_id_is_remembered_with_its_module_if_it_is_given_with_it(
    registry: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "arcade_of_mine.py").write_text(
        "import gymnasium\nfrom tests.support.envs.toy import Countdown\nclass Game(Countdown): pass\n"
        'gymnasium.register(id="Game-v0", entry_point="arcade_of_mine:Game")\n'
    )
    monkeypatch.syspath_prepend(tmp_path)
    __import__("arcade_of_mine")
    assert remembered_name("arcade_of_mine:Game-v0") == "arcade_of_mine:Game-v0"
    assert remembered_name("Game-v0") == "__main__:Game-v0", "which module has registered it is not known"
    assert type(made_elsewhere(EnvSpec.of("Game-v0")).unwrapped).__name__ == "Game"


@pytest.mark.process
def test_gymnasiums_own_ids_are_those_of_a_process_that_has_imported_nothing_else() -> None:
    ask = "import gymnasium; print(*gymnasium.registry)"
    fresh = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, timeout=60, check=True)
    assert ids_of_gymnasium() == set(fresh.stdout.split())


@pytest.mark.parametrize("name", ["__main__:nowhere", "<inside>", "<lambda>", "__main__:Nowhere-v0"])
def test_what_cannot_be_found_again_is_one_line_that_says_what_to_pass(name: str) -> None:
    with pytest.raises(UsageError, match=r"was made in a script, a notebook or a function.*my_module:\S+ \(train") as why:
        EnvSpec.of(name)
    assert "\n" not in str(why.value)


def test_what_cannot_be_pickled_is_one_line() -> None:
    lock = __import__("threading").Lock()
    with pytest.raises(UsageError, match=r"<make>: its callable cannot be sent to workers: TypeError: .*; let it make"):

        def make() -> object:
            return lock

        EnvSpec.of(make)
    with pytest.raises(UsageError, match="expected an id, a gymnasium EnvSpec or a callable that returns one, got 3"):
        EnvSpec.of(3)  # type: ignore[arg-type]


# ---------------------------------------------------------------------------------------------------------- wrappers


def test_wrappers_are_applied_in_their_order() -> None:
    spec = EnvSpec.of("CartPole-v1", {}, [Halved, "gymnasium.wrappers:TimeLimit(max_episode_steps=2)"])
    assert spec.factory is None
    made = spec.make()
    assert isinstance(made, TimeLimit)
    assert isinstance(made.env, Halved)
    assert first_reward(spec) == 0.5


def test_a_wrapper_without_a_name_travels_pickled_with_all_others() -> None:
    kwargs: dict[str, bool | int | float | str] = {"k": 4}
    spec = EnvSpec.of(make_countdown, kwargs, [Halved, lambda env: TimeLimit(env, 2), RecordEpisodeStatistics])
    assert spec.factory is not None
    assert spec.wrappers == (f"{MODULE}:Halved", "<lambda>", "gymnasium.wrappers.common:RecordEpisodeStatistics")
    made = spec.make()
    kinds = []
    while isinstance(made, gymnasium.Wrapper):
        kinds.append(type(made).__name__)
        made = made.env
    assert kinds == ["RecordEpisodeStatistics", "TimeLimit", "Halved"], "each of them once"
    assert EnvSpec.of("CartPole-v1", {"render_mode": "rgb_array"}, [lambda env: env]).make().render_mode == "rgb_array"
    with pytest.raises(UsageError, match=r"<lambda> was made in a script.*wrappers=\[my_wrapper\] there"):
        EnvSpec.of(spec.id, kwargs, spec.wrappers)


def test_plain_arguments_stand_in_the_name_and_others_do_not() -> None:
    assert (
        wrapper_name(partial(TimeLimit, max_episode_steps=9)) == "gymnasium.wrappers.common:TimeLimit(max_episode_steps=9)"
    )
    given: Any = np.int64(9), np.arange(3)
    assert wrapper_name(partial(TimeLimit, max_episode_steps=given[0])) == "<TimeLimit>"
    assert wrapper_name(partial(Halved, given[1])) == "<Halved>"
    read = read_wrapper("a.b:C.D([1, 2], x={'k': None}, y=-1.5)")
    assert read == ("a.b", "C.D", ([1, 2],), {"x": {"k": None}, "y": -1.5})


@pytest.mark.parametrize(
    "text",
    ["", "Clip", "mine:", ":Clip", "mine:Clip(", "mine:Clip)", "mine:Clip(f())", "mine:Clip(x=y)", "mine:Clip(**{})",
     "mine:Clip(1)(2)", "mine:Cl ip", "mine:Clip(1) + 1", "mine:" + "C" * 2000, "mi\nne:Clip", "mine:Clip(" + "[" * 300],
)  # fmt: skip
def test_what_is_no_name_of_a_wrapper_is_one_line(text: str) -> None:
    with pytest.raises(UsageError, match=r"^wrapper .*: expected .*, as in gymnasium.wrappers:F") as why:
        wrapper_name(text)
    assert "\n" not in str(why.value)
    assert len(str(why.value)) < 500


@pytest.mark.parametrize(
    ("wrapper", "says"),
    [
        (
            "nowhere_to_be_found:Clip",
            r"^wrapper nowhere_to_be_found:Clip: no module named nowhere_to_be_found; is it installed",
        ),
        ("gymnasium.wrappers:TimeLimt", r"has no TimeLimt; did you mean gymnasium.wrappers:TimeLimit\?$"),
        (
            "gymnasium.wrappers:TimeLimit",
            r"missing 1 required .*'max_episode_steps'; give its arguments, as in --wrappers \"gymnasium.wrappers:",
        ),
        (lambda env: 3, r"^wrapper <lambda>: expected it to return an environment of gymnasium or PettingZoo, got int$"),
        (lambda env: 1 / 0, r"^wrapper <lambda>: ZeroDivisionError: division by zero$"),
    ],
)
def test_what_goes_wrong_with_a_wrapper_is_one_line(wrapper: Any, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        EnvSpec.of("CartPole-v1", {}, [wrapper]).make()


@pytest.mark.parametrize("name", ["Env-v0", "make"])
def test_a_package_that_the_module_of_an_environment_needs_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / "has_a_need.py").write_text("import has_a_need_of_this\n")
    monkeypatch.syspath_prepend(tmp_path)
    needed = r"a package it needs is missing \(No module named 'has_a_need_of_this'\); pip install it, then try again$"
    with pytest.raises(UsageError, match=rf"^environment has_a_need:{name}: {needed}"):
        EnvSpec(f"has_a_need:{name}").make()
    missing = "no module named has_a_nee; is it installed, or its folder on PYTHONPATH"
    with pytest.raises(UsageError, match=rf"^environment has_a_nee:{name}: {missing}"):
        EnvSpec(f"has_a_nee:{name}").make()


@pytest.mark.parametrize(
    ("env", "write"),
    [
        ("thermostat.py", "thermostat:MyEnv"),
        ("thermostat.py:Thermostat", "thermostat:Thermostat"),
        ("./thermostat.py:Thermostat", "thermostat:Thermostat"),
        ("envs/mine/thermostat.py:Thermostat", "thermostat:Thermostat, with envs/mine on PYTHONPATH"),
        ("/envs/thermostat.py", "thermostat:MyEnv, with /envs on PYTHONPATH"),
    ],
)
def test_the_path_of_a_file_is_answered_with_the_module_to_write(env: str, write: str) -> None:
    with pytest.raises(UsageError) as why:
        EnvSpec(env).make()
    assert str(why.value) == f"environment {env}: a file is named as a module, without .py: write {write}"


def test_only_a_worker_that_knows_its_learner_calls_what_it_names() -> None:
    named, pickled = (EnvSpec.of("CartPole-v1", {}, [wrapper]) for wrapper in (Halved, lambda env: env))
    codes = [AllowedCode.REGISTERED, AllowedCode.MODULES, AllowedCode.CALLABLES]
    function = EnvSpec("subprocess:getoutput", {"cmd": "touch /tmp/never"})
    for spec, what in ((named, "a wrapper"), (pickled, "an environment factory"), (function, "an environment factory")):
        assert [bool(spec.rejection_reason(code)) for code in codes] == [True, True, False]
        assert spec.called_code == what
    by_id = EnvSpec("tests.support.envs.toy:Countdown-v0")
    assert [bool(by_id.rejection_reason(code)) for code in codes] == [True, False, False]
    assert by_id.called_code == ""
    for spec in (function, pickled):
        assert "; or register an id for it (gymnasium.register" in spec.rejection_reason(AllowedCode.MODULES)
    assert "register" not in named.rejection_reason(AllowedCode.MODULES), "an id does not help a wrapper"
    assert "an id that a package installed there registers" in by_id.rejection_reason(AllowedCode.REGISTERED)
    assert (
        cloudpickle.loads(pickled.factory.data if pickled.factory else b"").__class__.__module__
        == "millrace.protocol.env_spec"
    )


@pytest.mark.parametrize("value", [[1], None, 10**30, np.float32(1)])
def test_an_argument_that_no_message_can_carry_is_refused(value: Any) -> None:
    """A worker could not read the message, and the learner waited for a worker."""
    expected = "environment CartPole-v1: argument k: expected a number of at most 64 bits, text, True or False, got "
    with pytest.raises(UsageError, match=expected):
        EnvSpec.of("CartPole-v1", {"k": value})
    with pytest.raises(UsageError, match=expected):
        EnvSpec.of("CartPole-v1", eval_kwargs={"k": value})
