"""The tables of what settings start of the extras, and of the packages that they need."""

from __future__ import annotations

import re
import shlex
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

import millrace
from millrace.learner.extras import NEEDED_BY, STARTED_BY, started_by
from millrace.protocol.errors import UsageError

ROOT = Path(__file__).parents[2]
ASKS_FOR: dict[str, Any] = {
    "metrics_bind": "127.0.0.1:*",
    "prior": "ns/data-v0",
    "record": "ns/data-v0",
    "tensorboard": True,
}


@pytest.mark.parametrize("setting", STARTED_BY)
def test_what_a_setting_starts_is_there(setting: str) -> None:
    assert callable(started_by(setting))


@pytest.mark.parametrize("setting", NEEDED_BY)
def test_a_setting_without_its_package_is_refused_before_a_run_folder_is_made(
    setting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in NEEDED_BY[setting].modules:
        with monkeypatch.context() as patch, pytest.raises(UsageError) as refused:
            patch.setitem(sys.modules, module, None)
            runs = str(tmp_path / "runs")
            millrace.train("CartPole-v1", algo="dqn", run_dir=runs, steps=8, **{setting: ASKS_FOR[setting]})
        flag = setting.replace("_", "-")
        assert str(refused.value).startswith(f"--{flag} needs {module}, which is not installed; pip install ")
        assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("setting", NEEDED_BY)
def test_what_a_refusal_tells_to_install_is_a_pip_extra(setting: str) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    packages = [[re.split("[<>=]", line)[0] for line in lines] for lines in extras.values()]
    assert shlex.split(NEEDED_BY[setting].install) in packages


def test_a_setting_that_is_off_needs_no_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for needed in NEEDED_BY.values():
        for module in needed.modules:
            monkeypatch.setitem(sys.modules, module, None)
    run = millrace.train(
        "CartPole-v1", run_dir=str(tmp_path), steps=400, rollout_steps=50, n_epochs=1, transport="inproc", progress=False
    )
    assert run.plot(tmp_path / "curves.svg").svg
