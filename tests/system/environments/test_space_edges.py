"""Whole runs with environments at the edges of what is supported: large callables, large spaces, odd texts, small images."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import millrace
from millrace.protocol import env_spec
from millrace.protocol.errors import EnvironmentFailed, UsageError
from tests.support.envs.toy import Countdown

SMALL: dict[str, Any] = {
    "steps": 64, "lanes": 1, "envs": 2, "workers": 1, "rollout_steps": 8, "batch_size": 16, "n_epochs": 1, "net": (4,),
    "eval_episodes": 1,
}  # fmt: skip


class Table(Countdown):
    """Reads its reward from a table that it was given, whose last entry must have arrived."""

    def __init__(self, table: bytes) -> None:
        super().__init__(reward=float(table[-1]))


class Shows(Countdown):
    """Shows random observations of a space."""

    def __init__(self, space: gymnasium.Space[Any]) -> None:
        super().__init__()
        self.observation_space = space

    def _observation(self) -> Any:
        return self.observation_space.sample()


class Surrogate(Countdown):
    """Raises with a text that UTF-8 cannot hold, as a file name that is not UTF-8 makes it."""

    def step(self, action: Any) -> Any:
        raise OSError("cannot read " + os.fsdecode(b"caf\xe9.png") + "\n\ud800 and more")


def updates(folder: Path) -> int:
    found: int = json.loads((folder / "summary.json").read_text())["updates"]
    return found


def train(env: Callable[[], Any], folder: Path, **settings: Any) -> Path:
    return millrace.train(env, run_dir=str(folder), **{**SMALL, **settings}).path


def test_a_callable_of_3_mb_travels_to_the_workers(tmp_path: Path) -> None:
    table = os.urandom(3_000_000) + b"\x07"

    def large() -> Any:
        return Table(table)

    assert updates(train(large, tmp_path)) == 4
    vector = millrace.make_vec(large, 2, workers=2)
    try:
        vector.reset(seed=1)
        assert vector.step(np.zeros(2, np.int64))[1].tolist() == [7.0, 7.0]
    finally:
        vector.close()


@pytest.mark.parametrize("use", ["train", "make_vec"])
def test_a_callable_above_the_limit_is_refused_with_the_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, use: str
) -> None:
    monkeypatch.setattr(env_spec, "MAX_CALLABLE_BYTES", 100_000)
    table = bytes(200_000)

    def large() -> Any:
        return Table(table)

    with pytest.raises(UsageError) as caught:
        train(large, tmp_path / "runs") if use == "train" else millrace.make_vec(large, 2)
    said = str(caught.value)
    assert said.startswith("environment <large>: expected its callable to pickle to at most 100,000 bytes, got 200,")
    assert said.endswith("; let it load its data when it is called, from a file that every worker can read")
    assert not (tmp_path / "runs").exists()


def test_an_observation_of_70_000_choices_trains(tmp_path: Path) -> None:
    assert updates(train(lambda: Shows(gymnasium.spaces.MultiDiscrete([2] * 70_000)), tmp_path)) == 4
    vector = millrace.make_vec(lambda: Shows(gymnasium.spaces.MultiDiscrete([2] * 70_000)), 2, workers=1)
    try:
        assert vector.reset(seed=1)[0].shape == (2, 70_000)
    finally:
        vector.close()


@pytest.mark.parametrize("use", ["train", "make_vec"])
def test_a_space_whose_description_is_too_large_to_send_is_refused(tmp_path: Path, use: str) -> None:
    def large() -> Any:
        return Shows(gymnasium.spaces.MultiDiscrete(np.full(600_000, 2)))

    with pytest.raises(UsageError) as caught:
        train(large, tmp_path) if use == "train" else millrace.make_vec(large, 2)
    said = str(caught.value)
    expected = "expected spaces whose description takes at most 1,048,576 bytes, got 1,200,"
    assert said.startswith(f"environment <large>: {expected}")
    assert said.endswith(
        "; wrap the environment so that its spaces have fewer entries, or so that a MultiDiscrete is a Box of integers"
    )
    assert "\n" not in said


def test_a_small_image_trains(tmp_path: Path) -> None:
    assert updates(train(lambda: Shows(gymnasium.spaces.Box(0, 255, (3, 4, 3), np.uint8)), tmp_path)) == 4


def test_an_exception_with_a_lone_surrogate_is_reported(tmp_path: Path) -> None:
    with pytest.raises(EnvironmentFailed) as caught:
        train(Surrogate, tmp_path, max_env_failures=0)
    said = f"{caught.value}\n{caught.value.detail}"
    assert r"its environment raised OSError: cannot read caf\udce9.png" in said
    assert r"\ud800 and more" in caught.value.detail
    said.encode()
