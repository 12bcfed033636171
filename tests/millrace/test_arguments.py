"""Arguments of any kind: a public function takes them, or says in one line what is wrong before anything starts."""

from __future__ import annotations

import errno
import inspect
import random
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from enum import IntEnum, StrEnum
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import millrace
from millrace.arguments import plain
from millrace.launch import policy_workers, rollouts, training, vector
from millrace.launch.private_address import private_address
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.learner.members.bound import bind
from tests.support.users_code import own_policies

CALLS = 500
Door = tuple[Callable[..., Any], set[str], dict[str, Any]]
"""A public function, the names of its arguments, and arguments that it takes."""


class Started(BaseException):
    """All arguments were taken: the address for the workers would be opened now."""


@pytest.fixture(autouse=True)
def nothing_starts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def started(*arguments: object) -> None:
        raise Started

    for module in (training, policy_workers, rollouts, vector):
        monkeypatch.setattr(module, "open_worker_pool", started)
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> millrace.Run:
    small: dict[str, Any] = {"steps": 32, "envs": 2, "lanes": 1, "rollout_steps": 16, "eval_episodes": 1}
    folder = str(tmp_path_factory.mktemp("runs"))
    return millrace.train("CartPole-v1", run_dir=folder, transport="inproc", progress=False, **small)


class TwoLines:
    """What no function expects, and is hard to show."""

    def __repr__(self) -> str:
        return "two\nlines"


ODD_VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 3.5, 2.0, 10**30, -(10**30), 2**53, 2**63, 2**64, float("nan"), float("inf"), 1e300, 1j,
    "", "x", "2", "none", "auto", "\ud800", "CartPole-v1\udfff", "a\nb", "a\0b", "\x1b[2J", "x" * 10_000, b"x",
    np.int64(2), np.int8(-1), np.uint64(2**64 - 1), np.float32(0.5), np.float64("nan"), np.bool_(True), np.str_("x"),
    np.str_("\ud800"), np.array(2), np.array([1, 2]), np.array(["a"]), np.datetime64("2020"), [], [1], ["x"], ["\ud800"],
    [None], (), (64, 64), (np.int64(8),), (True,), {}, {"a": 1}, {1: 2}, {"a": 10**30}, {"a": "\ud800"}, {"\ud800": 1},
    {"a": np.int64(1)}, {"a": None}, {1}, object(), TwoLines(), int, len, lambda: None, Path("x"), Path("\udc80"), range(2),
    iter(()), gymnasium.spec("CartPole-v1"), Ellipsis, ValueError("x"), slice(2),
)  # fmt: skip


def doors(run: millrace.Run) -> list[Door]:
    policy = millrace.load(run)
    cartpole = policy.spec.observation, policy.spec.action
    env: dict[str, Any] = {"env": "CartPole-v1"}
    dataset: dict[str, Any] = {"out": "cartpole/fuzz-v0"}

    def names(function: Callable[..., Any]) -> set[str]:
        kinds = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
        return {name for name, each in inspect.signature(function).parameters.items() if each.kind not in kinds}

    def mlp(width: object = 64, **keywords: Any) -> object:
        return millrace.MLP(width, **keywords).spec(*cartpole)  # type: ignore[arg-type]

    def recurrent(width: object = 64, **keywords: Any) -> object:
        return millrace.Recurrent(width, **keywords).spec(*cartpole)  # type: ignore[arg-type]

    def own(factory: Any = own_policies.__name__, arrays: Any = None, **keywords: Any) -> object:
        return millrace.OwnPolicy(factory, arrays, **keywords).spec(*cartpole)

    quiet = {"progress": False}
    return [
        (millrace.train, names(millrace.train), env | quiet),
        (run.resume, names(run.resume), {"steps": 64} | quiet),
        (millrace.RolloutService, names(millrace.RolloutService), env),
        (millrace.make_vec, names(millrace.make_vec) | {"an_argument"}, env),
        (millrace.evaluate, names(millrace.evaluate), {"run": run} | quiet),
        (run.evaluate, names(run.evaluate), quiet),
        (millrace.record, names(millrace.record), {"run": run} | dataset | quiet),
        (run.record, names(run.record), dataset | quiet),
        (run.plot, {"out"}, {}),
        (millrace.Run, {"path"}, {}),
        (millrace.load, names(millrace.load), {"run": run}),
        (policy.reset, {"copies", "seed"}, {}),
        (millrace.PolicyParameters(policy.spec).initial, {"seed"}, {}),
        (mlp, {"width", "activation", "normalize_observations"}, {}),
        (recurrent, {"width", "core", "core_size"}, {}),
        (own, {"factory", "arrays", "extras", "state_size", "kwargs"}, {"arrays": {"w": (4, 2)}}),
    ]


def outcome(function: Callable[..., Any], given: dict[str, Any]) -> str:
    """Started, returned, refused in one line, or what was raised."""
    try:
        function(**given)
    except Started:
        return "started"
    except millrace.UserFacingError as error:
        return "refused" if str(error).isprintable() and len(str(error)) < 1100 else f"not one short line: {error!r}"
    except Exception as error:
        return repr(error)
    return "returned"


def test_any_argument_is_taken_or_refused_in_one_line(run: millrace.Run) -> None:
    generator, all_doors = random.Random(1), doors(run)
    raw = []
    for _ in range(CALLS):
        function, names, taken = generator.choice(all_doors)
        chosen = generator.sample(sorted(names), k=min(len(names), generator.choice([1, 1, 2])))
        odd = {name: generator.choice(ODD_VALUES) for name in chosen}
        found = outcome(function, taken | odd)
        if found not in ("started", "returned", "refused"):
            raw.append(f"{function.__name__}({odd!a:.200}): {found:.200}")
    assert not raw, f"{len(raw)} of {CALLS}:\n" + "\n".join(raw)


NUMPY = {"workers": np.int64(1), "lanes": np.int32(2)}


@pytest.mark.parametrize(
    ("function", "given"),
    [
        (millrace.train, {"env": np.str_("CartPole-v1"), "envs": np.int64(4), "learning_rate": np.float32(0.5), **NUMPY}),
        (millrace.train, {"env": "CartPole-v1", "net": (np.int64(8),), "normalize_rewards": np.bool_(True)}),
        (
            millrace.RolloutService,
            {"env": np.str_("CartPole-v1"), "rollout_steps": np.int64(8), "envs": np.uint8(4), **NUMPY},
        ),
        (
            millrace.RolloutService,
            {"env": "CartPole-v1", "policy": millrace.MLP(8), "env_kwargs": {"a": np.int64(1)}},
        ),
        (millrace.make_vec, {"env": np.str_("CartPole-v1"), "num_envs": np.int64(4), "timeout": np.float64(5), **NUMPY}),
        (millrace.make_vec, {"env": [np.str_("CartPole-v1")] * 2, "sutton_barto_reward": np.bool_(True)}),
    ],
)
def test_numpys_scalars_are_numbers_and_text(function: Callable[..., Any], given: dict[str, Any]) -> None:
    assert outcome(function, given) == "started"


class Word(StrEnum):
    CARTPOLE = "CartPole-v1"
    RELU = "relu"


class Number(IntEnum):
    TWO = 2


def test_members_of_enums_and_subclasses_arrive_as_pythons() -> None:
    class Text(str):
        __slots__ = ()

    given = [Word.CARTPOLE, (Number.TWO, {Text("a"): True}), type("Real", (float,), {})(0.5)]
    assert repr(plain(given)) == "['CartPole-v1', (2, {'a': True}), 0.5]"
    assert repr(millrace.MLP(Number.TWO, activation=Word.RELU).net) == "(2,)"  # type: ignore[arg-type]


def test_numpys_scalars_arrive_as_pythons(run: millrace.Run) -> None:
    policy = millrace.MLP(np.int64(8), activation=np.str_("relu"))  # type: ignore[arg-type]
    assert [type(each) for each in (policy.net[0], policy.activation)] == [int, str]
    shapes: Any = {"w": (np.int64(4), 2)}
    own = millrace.OwnPolicy("m:f", shapes, state_size=np.int64(3))  # type: ignore[arg-type]
    assert [type(each) for each in (own.arrays["w"][0], own.state_size)] == [int, int]
    assert outcome(run.evaluate, {"episodes": np.int64(2), "seed": np.int64(1), "best": np.bool_(False)}) == "started"


SURROGATE = "CartPole-v1\ud800"


@pytest.mark.parametrize(
    ("function", "given", "line"),
    [
        (millrace.train, {"env": SURROGATE}, r"train: env: expected text that can be encoded, got 'CartPole-v1\ud800'"),
        (millrace.train, {"env": "CartPole-v1", "workers": False}, 'train: workers: expected int or "none", got False'),
        (millrace.train, {"env": "CartPole-v1", "workers": 0}, "train: workers: expected int >= 1, got 0"),
        (millrace.train, {"env": "CartPole-v1", "run_dir": 3}, "train: run_dir: expected text, got 3"),
        (millrace.train, {"env": "CartPole-v1", "info_keys": "x"}, "train: info_keys: expected a list, got 'x'"),
        (millrace.train, {"env": "CartPole-v1", "core": 3}, "train: core: expected one of lstm, gru, none, got 3"),
        (millrace.train, {"env": "CartPole-v1", "env_kwargs": 3}, "train: env_kwargs: expected table, got 3"),
        (
            millrace.train,
            {"env": "CartPole-v1", "run_dir": "\ud800"},
            r"train: run_dir: expected text that can be encoded, got '\ud800'",
        ),
        (millrace.train, {"env": "CartPole-v1", "preset": True}, "train: preset: expected text, got True"),
        (millrace.train, {"env": "CartPole-v1", "callbacks": 2}, "train: callbacks: expected a list, got 2"),
        (
            millrace.train,
            {"env": "CartPole-v1", "callbacks": [2]},
            "callback 2: expected a function, or an object with some of the methods "
            "on_start, on_rollouts, on_update, on_evaluation, on_checkpoint, on_end",
        ),
        (
            millrace.train,
            {"env": "CartPole-v1", "algo": 2},
            f"train: algo: expected one of {', '.join(HYPERPARAMETERS)}, module:Class or a class, got 2",
        ),
        (millrace.train, {"resume": 2}, "train: resume: expected text or a path or None, got 2"),
        (millrace.load, {"run": 2}, "load: run: expected text or a path, got 2"),
        (millrace.load, {"run": "x", "best": 1}, "load: best: expected bool, got 1"),
        (millrace.Run, {"path": None}, "Run: path: expected text or a path, got None"),
        (millrace.Run, {"path": "a\nb"}, r"run a\nb: no such folder"),
        (
            millrace.RolloutService,
            {"env": "CartPole-v1", "rollout_steps": 10**30},
            f"RolloutService: rollout_steps: expected a number of at most 64 bits, got {10**30}",
        ),
        (
            millrace.RolloutService,
            {"env": "CartPole-v1", "rollout_steps": True},
            "RolloutService: rollout_steps: expected int, got True",
        ),
        (millrace.RolloutService, {"env": "CartPole-v1", "envs": 8.5}, "RolloutService: envs: expected int, got 8.5"),
        (
            millrace.RolloutService,
            {"env": "CartPole-v1", "n_steps": 32},
            "RolloutService: unknown setting n_steps; millrace calls it rollout_steps",
        ),
        (millrace.evaluate, {"run": "x", "against": 2}, "evaluate: against: expected text or a path, got 2"),
        (millrace.evaluate, {"run": "x", "copies": 0}, "evaluate: copies: expected int >= 1, got 0"),
        (
            millrace.make_vec,
            {"env": SURROGATE},
            r"make_vec: env: expected text that can be encoded, got 'CartPole-v1\ud800'",
        ),
        (millrace.make_vec, {"env": "CartPole-v1", "workers": False}, "make_vec: workers: expected int or None, got False"),
        (millrace.make_vec, {"env": "CartPole-v1", "copy": 1}, "make_vec: copy: expected bool, got 1"),
        (millrace.make_vec, {"env": "CartPole-v1", "num_envs": 2.0}, "make_vec: num_envs: expected int or None, got 2.0"),
        (millrace.make_vec, {"env": "CartPole-v1", "timeout": "5"}, "make_vec: timeout: expected float, got '5'"),
        (
            millrace.make_vec,
            {"env": "CartPole-v1", "wrappers": "m:Wrapper"},
            "make_vec: wrappers: expected a list of text or a function, got 'm:Wrapper'",
        ),
        (millrace.MLP, {"activation": "sin"}, "MLP: activation: expected one of tanh, relu, got 'sin'"),
        (millrace.Recurrent, {"core_size": True}, "Recurrent: core_size: expected int, got True"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(function: Callable[..., Any], given: dict[str, Any], line: str) -> None:
    with pytest.raises(millrace.UsageError) as caught:
        function(**given)
    assert str(caught.value) == line


def test_a_call_with_another_signature_is_a_type_error_as_of_any_function() -> None:
    with pytest.raises(TypeError, match=r"load\(\) got an unexpected keyword argument 'bset'"):
        millrace.load("x", bset=True)  # type: ignore[call-arg]


def test_a_limit_of_the_system_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def too_many_files(*arguments: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(vector, "open_worker_pool", too_many_files)
    with pytest.raises(millrace.UsageError, match=r"^make_vec: a process may have [0-9]+ files open here, which is too few"):
        millrace.make_vec("CartPole-v1", workers=8)


def test_workers_find_a_learner_whose_temporary_folder_has_a_long_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / ("x" * 90)
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    with ExitStack() as resources:
        address = private_address("ipc", resources)
        bind(address, None, resources)
        made = Path(address.removeprefix("ipc://")).parent
        assert made.stat().st_mode & 0o777 == 0o700
    assert not made.exists()
    with ExitStack() as resources, pytest.raises(millrace.UsageError, match=r": expected a path of at most 107 bytes$"):
        bind(f"ipc://{folder}/{'y' * 20}", None, resources)
