"""An algorithm of the user's own: its name is found, what it lacks is named, its settings are flags, keys and keywords."""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Annotated, Any

import msgspec
import pytest

from millrace.learner.algorithms import ALGORITHMS, Algorithm, algorithm_class
from millrace.learner.config.algorithm_names import FOR_PRIOR, NEEDED, NOT_SETTINGS, name_of, settings_record
from millrace.learner.config.command_line import RunFlags, read_config
from millrace.learner.config.config import Config
from millrace.learner.config.hyperparameters import HYPERPARAMETERS, AlgorithmConfig
from millrace.learner.config.layers import config_from_toml, config_of_run, resolve
from millrace.learner.config.resume_rules import Free, OnResume, declared
from millrace.learner.config.validation import unused_setting
from millrace.learner.resume_checks import check_settings
from millrace.learner.run_folder.newest_run import newest_run
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.learner.run_lines import algorithm_label
from millrace.protocol.errors import UsageError

SOURCE = '''
"""Algorithms of a user's own, which learn nothing."""
from typing import Literal

from millrace.learner.algorithms import Algorithm
from millrace.learner.config.hyperparameters import AlgorithmConfig
from millrace.learner.config.resume_rules import Free


class Base(Algorithm):
    def __init__(self, config, policy, *, total_steps, seed, device="cpu"): ...
    def update(self, batch, pulse): ...
    def weights(self): ...
    def state_dict(self): ...
    def load_state_dict(self, state): ...


class Mine(Base):
    class Config(AlgorithmConfig, frozen=True):
        """Settings."""

        penalty: float = 0.1
        """Weight of the penalty."""
        kind: Literal["soft", "hard"] = "soft"
        """How it is
        computed."""
        cutoff: float | None = None
        heads: int = 2
        steps_back: Free[int] = 3
        """How far."""
        batch_size: float = 0.5
        """Has the name of a setting of ppo, and another type."""
        rollout_steps: int = 16


not_a_class = 3


class Unfinished(Algorithm):
    def update(self, batch, pulse): ...


class Bare:
    pass


class NoConfig(Base):
    Config = dict


class Shadowing(Base):
    class Config(AlgorithmConfig, frozen=True):
        eval_every: int = 3


class Misleading(Base):
    class Config(AlgorithmConfig, frozen=True):
        check: float = 0.5


class Replaying(Base):
    class Config(AlgorithmConfig, frozen=True):
        replays = True
        replay_size: int = 200
        learning_starts: int = 1000
        core: str = "mine"


class Required(Base):
    class Config(AlgorithmConfig, frozen=True):
        needed: int


class BadDefault(Base):
    class Config(AlgorithmConfig, frozen=True):
        level: int = "high"


class NotPlain(Base):
    class Config(AlgorithmConfig, frozen=True):
        what: object = object()


class Untyped(Base):
    class Config(AlgorithmConfig, frozen=True):
        what: "Nowhere" = 3
'''


@pytest.fixture(autouse=True)
def _module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_module.py").write_text(SOURCE)
    (tmp_path / "breaks.py").write_text("import json\njson.loads('')\n")
    (tmp_path / "needs.py").write_text("import no_such_package\n")
    (tmp_path / "leaves.py").write_text("import sys\nsys.exit(3)\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("own_module", "breaks", "needs", "leaves"):
        monkeypatch.delitem(sys.modules, name, raising=False)


def refusal(call: Callable[[], object]) -> str:
    with pytest.raises(UsageError) as caught:
        call()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_needed_methods_are_those_of_the_interface() -> None:
    own = {name for name, value in vars(Algorithm).items() if isinstance(value, FunctionType | staticmethod)}
    assert own == {*NEEDED, *FOR_PRIOR, "start_from"}


def test_flags_that_are_no_settings_are_known() -> None:
    import inspect

    import millrace
    from millrace.keywords import TrainKeywords

    arguments = {*inspect.signature(millrace.train).parameters} - {*TrainKeywords.__annotations__}
    assert {*RunFlags.__struct_fields__, *arguments} - {*Config.__struct_fields__} <= NOT_SETTINGS


def test_each_algorithm_of_ours_has_the_record_of_its_settings_as_a_user_s_has() -> None:
    for name in ALGORITHMS:
        assert algorithm_class(name).Config is HYPERPARAMETERS[name]
        assert name_of(algorithm_class(name)) == name
        assert settings_record(name) is HYPERPARAMETERS[name]


def test_what_it_can_do_is_asked_of_its_record_whose_base_does_not_matter() -> None:
    replaying = partial(resolve, "CartPole-v1", algo="own_module:Replaying", preset="none")
    assert refusal(partial(replaying, envs=8)).startswith("replay_size 200: a rollout takes up to 258; take")
    assert refusal(partial(replaying, envs=4, shards=2)).startswith("shards 2: own_module:Replaying learns in one process")
    assert refusal(partial(replaying, envs=4, prior="a/b-v0")).startswith("prior a/b-v0: expected core none")
    assert unused_setting(replaying(envs=4, steps=1000)).startswith("learning_starts 1,000: nothing is learned")
    others = resolve("CartPole-v1", algo="own_module:Mine", preset="none", envs=4, prior="a/b-v0", shards=2)
    assert others.algorithm.minibatch_rows(others.envs) == 4 * 16
    assert not unused_setting(others)


def test_its_settings_are_flags_keys_and_keywords(tmp_path: Path) -> None:
    by_keyword = resolve("CartPole-v1", algo="own_module:Mine", penalty=0.3, kind="hard", cutoff=2.0)
    flags = ["--algo", "own_module:Mine", "--penalty", "0.3", "--kind", "hard", "--cutoff", "2", "CartPole-v1"]
    assert read_config("train", flags) == (by_keyword, None)
    file = tmp_path / "my.toml"
    file.write_text(
        'env = "CartPole-v1"\nalgo = "own_module:Mine"\n["own_module:Mine"]\npenalty = 0.3\nkind = "hard"\ncutoff = 2.0\n'
        '["other:One"]\nwhatever = 1\n[ppo]\nclip_range = 0.1\n'
    )
    assert resolve(file=file) == by_keyword
    assert read_config("train", ["--config", str(file)]) == (by_keyword, None)
    assert (
        resolve(file=file, cutoff="none").algorithm
        == resolve(algo="own_module:Mine", env="E", penalty=0.3, kind="hard").algorithm
    )
    off, _ = read_config("train", ["--config", str(file), "--cutoff", "none", "--batch-size", "0.25"])
    assert (off.algorithm.cutoff, off.algorithm.batch_size) == (None, 0.25)  # type: ignore[attr-defined]


def test_config_toml_has_all_of_them(tmp_path: Path) -> None:
    config = resolve("CartPole-v1", algo="own_module:Mine", penalty=0.3)
    table = tomllib.loads(config.to_toml())
    assert table["own_module:Mine"]["penalty"] == 0.3
    assert config_from_toml(config.to_toml()) == config


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"penalty": "much"}, "penalty: expected float, got 'much'"),
        ({"kind": "rigid"}, "kind: expected one of soft, hard, got 'rigid'"),
        ({"penatly": 0.1}, "train: unknown setting penatly; did you mean penalty?"),
        ({"clip_range": 0.1}, "train: unknown setting clip_range; it is one of ppo alone"),
    ],
)
def test_a_wrong_setting_is_refused_as_ours_are(settings: dict[str, Any], says: str) -> None:
    assert refusal(lambda: resolve("E", algo="own_module:Mine", **settings)).endswith(says)


def test_a_setting_in_the_wrong_table_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    file.write_text('algo = "own_module:Mine"\npenalty = 0.3\n')
    line = refusal(lambda: resolve("E", file=file))
    assert line.endswith('penalty is a setting of the algorithm; put it in the table ["own_module:Mine"]')


@pytest.mark.parametrize(
    ("tables", "says"),
    [
        ("[ppo]", 'settings of own_module:Mine in the table ["own_module:Mine"], got only [ppo]; rename that table'),
        ("[dqn]\n[ppo]", 'in the table ["own_module:Mine"], got only [dqn], [ppo]; rename that table, or add an empty one'),
        ("[Mine]", 'unknown table [Mine]; the settings of own_module:Mine are in the table ["own_module:Mine"]'),
    ],
)
def test_settings_in_the_table_of_another_algorithm_are_not_silently_ignored(tmp_path: Path, tables: str, says: str) -> None:
    file = tmp_path / "my.toml"
    file.write_text(f'algo = "own_module:Mine"\n{tables}\npenalty = 0.3\n')
    assert says in refusal(lambda: resolve("E", file=file))
    file.write_text(f"{tables}\npenalty = 0.3\n")
    assert says in refusal(lambda: resolve("E", algo="own_module:Mine", file=file))


def test_one_file_may_have_the_tables_of_several_algorithms(tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    file.write_text('["own_module:Mine"]\n[ppo]\ngamma = 0.5\n')
    assert resolve("E", algo="own_module:Mine", file=file) == resolve("E", algo="own_module:Mine")
    assert resolve("E", algo="a2c", file=file) == resolve("E", algo="a2c")
    assert resolve("E", file=file).algorithm.gamma == 0.5
    file.write_text("[a2c]\ngamma = 0.5\n")
    says = "expected the settings of ppo in the table [ppo], got only [a2c]"
    assert says in refusal(lambda: resolve("E", file=file))


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("nowhere:Mine", r"no module named nowhere; is it installed, or its folder on PYTHONPATH\?"),
        ("nowhere.deep:Mine", r"no module named nowhere; is it installed, or its folder on PYTHONPATH\?"),
        ("own_module:Mien", r"module own_module \(.*own_module.py\) has no Mien; did you mean Mine\?"),
        ("own_module:", "expected module:Class, as in mine:ClippedPlus"),
        (":Mine", "expected module:Class, as in mine:ClippedPlus"),
        ("a/b:Mine", "expected module:Class, as in mine:ClippedPlus"),
        ("own_module:not_a_class", "expected a class, got int"),
        ("breaks:Mine", "the import of breaks failed: JSONDecodeError: Expecting value.*"),
        (
            "needs:Mine",
            r"the import of needs failed: ModuleNotFoundError: No module named 'no_such_package'; pip install it, .*",
        ),
        ("leaves:Mine", "the import of leaves failed: SystemExit: 3"),
        (
            "own_module:Unfinished",
            "it lacks __init__, weights, state_dict, load_state_dict; derive it from ActorCritic or Algorithm .*",
        ),
        (
            "own_module:Bare",
            "it lacks __init__, policy_spec, update, weights, is_finite, state_dict, load_state_dict, remember, roll_back, "
            "whole_episodes; derive it .*",
        ),
        ("own_module:NoConfig", "Config: expected a class derived from ActorCriticConfig or .*, got <class 'dict'>"),
        ("own_module:Shadowing", "its setting eval_every has the name of a setting of the run; give it another name"),
        ("own_module:Misleading", "its setting check has the name of an attribute of AlgorithmConfig; give it another name"),
        ("own_module:Required", "its setting needed: expected a default value, got none"),
        ("own_module:BadDefault", "its setting level: its default does not fit its type: Expected `int`, got `str`.*"),
        ("own_module:NotPlain", "its setting what: expected a default of numbers, text, .*, got <object .*>"),
        ("own_module:Untyped", "the types of its settings cannot be read: name 'Nowhere' is not defined"),
        ("__main__:Nothing", r"this class is defined in a script, .*: millrace.train\(resume=…, algo=Nothing\), or put .*"),
    ],
)
def test_what_is_wrong_with_it_is_said_in_one_line(name: str, says: str) -> None:
    line = refusal(lambda: resolve("CartPole-v1", algo=name))
    assert re.fullmatch(f"algo {name}: {says}", line), line
    assert refusal(lambda: read_config("train", ["CartPole-v1", "--algo", name])) == line


def test_the_traceback_of_a_module_that_breaks_is_kept() -> None:
    with pytest.raises(UsageError) as caught:
        resolve("E", algo="breaks:Mine")
    assert "breaks.py" in caught.value.detail
    assert "json.loads('')" in caught.value.detail


def test_the_module_is_imported_only_when_it_is_named() -> None:
    read_config("train", ["CartPole-v1"])
    assert "own_module" not in sys.modules
    read_config("train", ["CartPole-v1", "--algo", "own_module:Mine"])
    assert "own_module" in sys.modules


def test_the_help_shows_its_settings_with_their_texts(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    def shown() -> str:
        with pytest.raises(SystemExit) as stop:
            read_config("train", ["--algo", "own_module:Mine", "--help"])
        assert not stop.value.code
        return " ".join(capsys.readouterr().out.split())

    text = shown()
    assert " Mine: " in text
    for line in (
        "--penalty FLOAT Weight of the penalty. (default: 0.1)",
        "--kind {soft,hard} How it is computed. (default: soft)",
        "--cutoff FLOAT|none (default: none)",
        "--rollout-steps INT T, the number of steps of each env copy in a rollout. (default: 16)",
    ):
        assert line in text
    (tmp_path / "own_module.py").unlink()
    import linecache

    linecache.checkcache()
    assert "--penalty FLOAT (default: 0.1)" in shown(), "without source code there is no text, and no error"


# ------------------------------------------------------------------------------------------------------------- a class


def own(body: dict[str, Any], module: str, qualname: str = "Given") -> Any:
    """A class as if it had been written in that module."""
    from importlib import import_module

    base = import_module("own_module").Mine
    return type(base)(qualname.rpartition(".")[2], (base,), {"__module__": module, "__qualname__": qualname, **body})


def test_a_class_of_a_module_has_its_name() -> None:
    from importlib import import_module

    mine = import_module("own_module").Mine
    assert name_of(mine) == "own_module:Mine"
    assert resolve("E", algo=mine, penalty=0.5) == resolve("E", algo="own_module:Mine", penalty=0.5)


@pytest.mark.parametrize(
    ("module", "qualname"), [("__main__", "Given"), ("own_module", "make.<locals>.Given"), ("gone", "Given")]
)
def test_a_class_that_no_import_finds_is_found_in_this_process(module: str, qualname: str) -> None:
    first, second = own({}, module, qualname), own({"newer": True}, module, qualname)
    config = resolve("E", algo=first, penalty=0.5)
    assert config.algo == f"{module}:{qualname}"
    assert algorithm_class(config.algo) is first
    assert config_from_toml(config.to_toml()) == config
    name_of(second)
    assert algorithm_class(config.algo) is second, "a notebook cell that is run again makes a new class"


def test_a_class_that_lacks_something_is_refused() -> None:
    class Nothing:
        pass

    assert "it lacks __init__, policy_spec, update" in refusal(lambda: resolve("E", algo=Nothing))


def test_a_class_of_the_running_script_is_found_without_being_given(monkeypatch: pytest.MonkeyPatch) -> None:
    main = ModuleType("__main__")
    main.Here = own({}, "__main__", "Here")  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "__main__", main)
    assert algorithm_class("__main__:Here") is main.Here


# ---------------------------------------------------------------------------------------------------------- a resumed run


def a_run(tmp_path: Path, **settings: Any) -> Path:
    return RunFolder.create(resolve("CartPole-v1", run_dir=str(tmp_path / "runs"), **settings)).path


def test_settings_that_say_nothing_are_free_if_they_are_floats_and_else_fixed() -> None:
    class Settings(AlgorithmConfig, frozen=True):
        share: Annotated[float, msgspec.Meta(ge=0)] = 0.0
        limit: Annotated[float, msgspec.Meta(ge=0)] | None = None
        size: int = 0
        mixed: int | float = 0
        name: str = ""
        chosen: Free[int] = 0
        rollout_steps: int = 3
        gamma: float = 0.5

    Settings.__annotations__.update(share=Annotated[float, msgspec.Meta(ge=0)], chosen=Free[int])
    found = declared(Settings, by_type=True)
    free = {name for name, how in found.items() if how is OnResume.FREE}
    assert free == {"share", "limit", "chosen", "rollout_steps"}, "the last two keep what their base declares"
    assert found["gamma"] is OnResume.FIXED


def test_a_resumed_run_takes_free_settings_and_refuses_fixed_ones(tmp_path: Path) -> None:
    run = a_run(tmp_path, algo="own_module:Mine", penalty=0.3)
    config, resume = read_config("train", ["--resume", str(run), "--penalty", "0.4", "--steps-back", "5"])
    assert resume == run
    assert (config.algo, config.algorithm.penalty) == ("own_module:Mine", 0.4)  # type: ignore[attr-defined]
    assert check_settings(config, run) == []
    line = refusal(lambda: check_settings(resolve(resume=run, heads=3), run))
    assert "heads: expected 2 as in its config.toml, got 3; a run keeps this setting" in line
    assert newest_run(config) is None, "it has no checkpoint"


def test_resume_auto_does_not_take_a_run_of_another_algorithm(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = a_run(tmp_path, algo="own_module:Mine")
    assert "own_module-Mine" in run.name
    (run / "checkpoints").mkdir()
    (run / "checkpoints" / "000000000001.pt").touch()
    config = resolve(resume=run)
    assert newest_run(config) == run
    text = (run / "config.toml").read_text()
    assert not caplog.messages
    (run / "config.toml").write_text(text.replace('"own_module:Mine"', '"own_module.Mine"', 1))
    assert newest_run(config) is None
    assert caplog.messages == [f"no run to resume in {config.run_dir}: a new one begins"]


def test_a_run_of_a_notebook_goes_on_where_the_class_is_given_or_has_been_moved(tmp_path: Path) -> None:
    config = resolve("CartPole-v1", run_dir=str(tmp_path / "runs"), algo=own({}, "__main__", "Moved"), penalty=0.3)
    run = RunFolder.create(config).path
    assert resolve(resume=run, algo=own({}, "__main__", "Moved")) == config
    with (tmp_path / "own_module.py").open("a") as file:
        file.write("\n\nclass Moved(Mine):\n    pass\n")
    sys.modules.pop("own_module")
    moved = resolve(resume=run, algo="own_module:Moved")
    assert (moved.algo, moved.algorithm.penalty) == ("own_module:Moved", 0.3)  # type: ignore[attr-defined]
    assert check_settings(moved, run) == []
    assert config_of_run(run, "own_module:Moved") == moved
    other = resolve(resume=run, algo="own_module:Mine")
    assert "algo: expected __main__:Moved as in its config.toml, got own_module:Mine" in refusal(
        lambda: check_settings(other, run)
    )


def test_a_legend_has_the_name_of_the_class() -> None:
    assert [*map(algorithm_label, ("ppo", "mine:ClippedPlus", "__main__:f.<locals>.X"))] == [
        "PPO",
        "ClippedPlus",
        "f.<locals>.X",
    ]
