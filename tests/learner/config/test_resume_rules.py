"""Each setting says what becomes of it in a resumed run; a fixed one that differs is refused before anything is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest

from millrace.learner.config.config import Config
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.learner.config.layers import resolve
from millrace.learner.config.resume_rules import Free, OnResume, declared
from millrace.learner.env_spaces import EnvSpaces
from millrace.learner.resume_checks import Resumption, check_settings, check_spaces, unless_finished
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import UsageError

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "resume.md"
OTHER_OPTIMIZER = {
    "ppo": "rmsprop", "a2c": "adam", "impala": "adam", "reinforce": "rmsprop", "dqn": "adamw", "rainbow": "adamw",
}  # fmt: skip
RECORDS: list[type[msgspec.Struct]] = [Config, *HYPERPARAMETERS.values()]


def content(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def a_run(tmp_path: Path, **settings: Any) -> Path:
    return RunFolder.create(resolve("CartPole-v1", preset="none", run_dir=str(tmp_path), **settings)).path


def another_value(algo: str, name: str, value: Any) -> Any:
    """A value that the setting also takes."""
    match name, value:
        case "activation", _:
            return "relu" if value == "tanh" else "tanh"
        case "optimizer", _:
            return OTHER_OPTIMIZER[algo]
        case "core", _:
            return "gru"
        case "ent_coef", None:
            return 0.2
        case "encoder", _:
            return "my_package:factory"
        case _, bool():
            return not value
        case _, int():
            return value + 5
        case _, float():
            return value / 2 + 0.3
        case _, tuple():
            return (3, 3)
        case _, dict():
            return {"sutton_barto_reward": True}
    raise AssertionError(f"{name}: say here which other value it takes")


def fixed(record: type[msgspec.Struct]) -> list[str]:
    return [name for name, on_resume in declared(record).items() if on_resume is OnResume.FIXED]


@pytest.mark.parametrize("record", RECORDS)
def test_every_setting_is_declared(record: type[msgspec.Struct]) -> None:
    assert list(declared(record)) == list(record.__struct_fields__)


def test_a_setting_that_is_not_declared_once_is_noticed() -> None:
    class Undeclared(msgspec.Struct):
        plain: int = 0

    class Twice(msgspec.Struct):
        both: Free[Free[int]] = 0

    for record, got in ((Undeclared, 0), (Twice, 2)):
        with pytest.raises(TypeError, match=f"expected one of Free, Adaptable and Fixed, got {got}"):
            declared(record)


def test_what_weights_or_state_depend_on_is_fixed() -> None:
    """The settings that shape the network, its inputs, the value's meaning, the optimizer's state and the replay buffer."""
    assert {"env", "env_kwargs", "algo", "seed"} <= set(fixed(Config))
    every = {"net", "activation", "encoder", "normalize_observations", "gamma"}
    some = {"shared_net", "normalize_rewards", "core", "core_size", "optimizer", "amsgrad", "dueling"}
    some |= {"replay_size", "priority_alpha", "hindsight"}
    for record in HYPERPARAMETERS.values():
        own = every | some & set(record.__struct_fields__)
        assert own <= set(fixed(record))
    assert [name for name, how in declared(Config).items() if how is OnResume.ADAPTABLE] == ["envs", "lanes"]


@pytest.mark.parametrize(
    ("algo", "name"),
    [
        (algo, name)
        for algo, record in HYPERPARAMETERS.items()
        for name in fixed(record)
        if (algo, name) != ("rainbow", "core")  # can't be set at all
    ],
)
def test_each_fixed_setting_of_an_algorithm_is_refused_and_nothing_is_written(tmp_path: Path, algo: str, name: str) -> None:
    run = a_run(tmp_path, algo=algo)
    before = content(run)
    had = getattr(resolve(resume=run).algorithm, name)
    given = resolve(resume=run, **{name: another_value(algo, name, had)})
    with pytest.raises(UsageError, match=rf"^run {run}: {name}: expected .* as in its config.toml, got .*; a run") as why:
        unless_finished(given, run, lambda checked: pytest.fail("it was launched"))
    assert "\n" not in str(why.value)
    assert content(run) == before


def test_a_launcher_gets_the_run_and_what_is_different(tmp_path: Path) -> None:
    run, launched = a_run(tmp_path), list[Resumption | None]()

    def launch(checked: Resumption | None) -> Path:
        launched.append(checked)
        return tmp_path

    assert unless_finished(resolve("CartPole-v1"), None, launch) == tmp_path
    assert unless_finished(resolve(resume=run, lanes=2), run, launch) == tmp_path
    (line,) = check_settings(resolve(resume=run, lanes=2), run)
    assert launched == [None, Resumption(run, (line,))]


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"algo": "a2c"}, "algo: expected ppo as in its config.toml, got a2c; a run keeps this setting"),
        ({"seed": 7}, "seed: expected 1 as in its config.toml, got 7"),
        ({"env_kwargs": {"sutton_barto_reward": True}}, r"env_kwargs: expected {} .* got {'sutton_barto_reward': True}"),
        (
            {"activation": "relu", "net": [8]},
            r"net: expected \[64, 64\] .* got \[8\]; activation: expected tanh .* got relu;",
        ),
    ],
)
def test_the_refusal_names_setting_values_and_what_to_do(tmp_path: Path, changed: dict[str, Any], says: str) -> None:
    run = a_run(tmp_path)
    with pytest.raises(UsageError, match=rf"^run {run}: {says}.*resume it without the setting, or start a new run$"):
        check_settings(resolve(resume=run, **changed), run)


def test_the_rest_is_taken(tmp_path: Path) -> None:
    run = a_run(tmp_path)
    free: dict[str, Any] = {
        "steps": 9,
        "learning_rate": 1.0,
        "workers": 1,
        "transport": "tcp",
        "eval_every": 7,
        "max_lag": 2,
    }
    assert check_settings(resolve(resume=run, **free), run) == []
    lines = check_settings(resolve(resume=run, lanes=2, envs=8), run)
    assert lines == [f"run {run}: lanes: 2 now, 4 before; every lane begins new episodes"]
    lines = check_settings(resolve(resume=run, lanes=2, envs=4), run)
    assert lines == [
        f"run {run}: envs: 4 now, 8 before; its earlier lanes continue",
        f"run {run}: lanes: 2 now, 4 before; its earlier lanes continue",
    ]


def test_sequences_in_a_replay_buffer_keep_their_length(tmp_path: Path) -> None:
    run = a_run(tmp_path, algo="dqn", core="gru", rollout_steps=16)
    assert check_settings(resolve(resume=run, learning_rate=1e-4), run) == []
    with pytest.raises(UsageError, match=r"rollout_steps: expected 16, the length of the sequences .*, got 8; resume"):
        check_settings(resolve(resume=run, rollout_steps=8), run)


def test_another_replay_ratio_is_said(tmp_path: Path) -> None:
    run = a_run(tmp_path, algo="dqn", gradient_steps=64)
    *_, line = check_settings(resolve(resume=run, envs=16), run)
    assert line.endswith(
        "an update of 64 gradient steps now follows 512 env steps, 256 before; --gradient-steps 128 keeps the replay ratio"
    )
    same_ratio: list[dict[str, Any]] = [{"lanes": 2}, {"envs": 16, "rollout_steps": 16}, {"envs": 16, "gradient_steps": 128}]
    for same in same_ratio:
        assert not [one for one in check_settings(resolve(resume=run, **same), run) if "replay ratio" in one], same


def test_an_environment_with_other_spaces_is_refused() -> None:
    from gymnasium import spaces

    def of(observation: spaces.Space[Any], actions: int, *seats: str) -> EnvSpaces:
        return EnvSpaces(observation_leaves(observation), action_spec(spaces.Discrete(actions)), None, seats=seats)

    run, box = Path("runs/mine"), spaces.Box(-1, 1, (3,))
    check_spaces(run, of(box, 2), of(box, 2))
    for now, says in (
        (of(spaces.Box(-1, 1, (4,)), 2), r"observations have changed: expected .*\(3,\).*, got .*\(4,\)"),
        (of(box, 3), r"actions have changed: expected .*2.*, got .*3"),
        (of(spaces.Dict(a=box, b=box), 2), "observations have changed"),
        (of(box, 2, "a", "b"), r"agents have changed: expected \(\), got \('a', 'b'\)"),
    ):
        with pytest.raises(UsageError, match=f"^run runs/mine: the environment's {says}.*; install the version") as why:
            check_spaces(run, of(box, 2), now)
        assert "\n" not in str(why.value)


def test_the_page_says_what_each_rule_means() -> None:
    text = PAGE.read_text()
    for how in OnResume:
        assert f"| **{how.name.lower()}** | {how.value} |" in text
