"""The reference pages are complete: every setting, public name, metric, exit code and file of a run folder is there."""

from __future__ import annotations

import json
import re
import tempfile
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

import millrace
from millrace.cli.commands import COMMANDS
from millrace.extras.monitoring.metric_names import METRICS
from millrace.learner.config.command_line import RunFlags
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.run_folder import run_folder
from millrace.protocol import errors
from millrace.protocol.errors import UserFacingError
from millrace.protocol.specs import SessionTerms
from tests.extras.datasets.test_cloning import CONTINUOUS, DISCRETE, cloned, episodes_of, made
from website import commands_page, python_page, settings_page
from website.doctest_fences import with_fences
from website.pages import KEPT, ROOT

KNOWN = {name for group in METRICS.values() for name in group}
RUNS: dict[str, dict[str, Any]] = {
    "ppo": {"algo": "ppo", "info_keys": ("distance",)},
    "ppo, Box actions": {"env": "Pendulum-v1", "algo": "ppo"},
    "a2c": {"algo": "a2c", "eval_workers": 1},
    "impala": {"algo": "impala"},
    "reinforce": {"algo": "reinforce", "rollout_steps": 501, "steps": 2_100},
    "dqn": {"algo": "dqn", "learning_starts": 0, "gradient_steps": 1},
    "sac": {"env": "Pendulum-v1", "algo": "sac", "learning_starts": 0, "batch_size": 8, "net": (8,)},
    "self-play": {"env": "tests.support.users_code.seat_envs:RockPaperScissors", "algo": "ppo", "self_play": 1},
    "xqc": {"env": "Pendulum-v1", "algo": "xqc", "learning_starts": 0, "batch_size": 8, "net": (8,), "policy_delay": 1},
    "td3": {"env": "Pendulum-v1", "algo": "td3", "learning_starts": 0, "batch_size": 8, "net": (8,)},
}
OF_MONITORING = ("dashboard.Dashboard", "wandb.WandbCallback", "mlflow.MlflowCallback")
"""What users import of that extra"""


def general(name: str) -> str:
    """A name in which the user's own part is NAME."""
    group, _, last = name.partition("/")
    for own in ("distance", "own_number", "score_missing"):
        last = last.replace(own, own.replace(own.removesuffix("_missing"), "NAME"))
    return f"{group}/{last}"


@cache
def logged(which: str) -> tuple[set[str], set[str]]:
    """The names that a small run logs, and the names of the files in its folder."""

    class Log(millrace.Callback):
        def on_update(self, progress: millrace.Progress) -> None:
            progress.log("own_number", 1)

    sizes = {
        "envs": 2,
        "lanes": 1,
        "rollout_steps": 8,
        "eval_episodes": 1,
        "eval_every": 100,
        "workers": 1,
    }
    chosen: dict[str, Any] = {
        "env": "CartPole-v1",
        "steps": 200,
        "preset": "none",
        "transport": "inproc",
        **sizes,
        **RUNS[which],
    }
    terms = SessionTerms(heartbeat_s=0.05)  # the figures of workers come with heartbeats
    often = mock.patch.object(RolloutConfig, "terms", return_value=terms)
    with tempfile.TemporaryDirectory() as folder, often:
        run = millrace.train(**chosen, run_dir=folder, progress=False, callbacks=[Log()])
        rows = [json.loads(line) for line in (run.path / "metrics.jsonl").read_text().splitlines()]
        return {name for row in rows for name in row}, {path.name for path in run.path.iterdir()}


@pytest.mark.parametrize("which", RUNS)
def test_every_metric_of_a_run_has_a_meaning(which: str) -> None:
    names, _ = logged(which)
    assert {general(name) for name in names} <= KNOWN
    assert "custom/own_number" in names


def test_every_meaning_is_of_a_metric() -> None:
    found = {"train/NAME"}  # of an algorithm of the user's own
    for action in (DISCRETE, CONTINUOUS):
        found |= {*cloned(made("ppo", action), episodes_of(action))}
    for which in RUNS:
        names, _ = logged(which)
        found |= {general(name) for name in names}
    assert found == KNOWN


def test_every_setting_is_on_the_page() -> None:
    expected = {field for field in RunFlags.__struct_fields__ if field != "algorithm"}
    expected |= {f"{algo}.{field}" for algo, record in HYPERPARAMETERS.items() for field in record.__struct_fields__}
    assert set(settings_page.shown_names()) == expected
    page = settings_page.page()
    assert [name for name in expected if f'<span id="{name}">' not in page] == []
    assert "| int ≥ 1 |" in page
    assert "| `auto`, `cpu`, `cuda` |" in page


@pytest.mark.parametrize(
    ("hint", "words"),
    [
        (Path | None, "path or none"),
        (tuple[int, ...], "list of int"),
        (float | None, "float or none"),
        (dict[str, int], "table"),
    ],
)
def test_a_type_is_said_in_words(hint: object, words: str) -> None:
    assert settings_page.values(hint) == words


def test_a_type_that_nobody_knows_is_an_error() -> None:
    with pytest.raises(TypeError, match="expected a type that it can describe"):
        settings_page.values(set[int])


def test_every_public_name_is_on_one_python_page() -> None:
    pytest.importorskip("stable_baselines3", reason="the page of the Python names has those of millrace.sb3")
    modules = {"algorithms", "testing"}
    public = {f"millrace.{name}" for name in set(millrace.__all__) - modules - {"__version__"}}
    for module in modules:
        public |= {f"millrace.{module}.{name}" for name in getattr(millrace, module).__all__}
    public |= {f"millrace.extras.monitoring.{name}" for name in OF_MONITORING}
    text = "".join(make() for make in python_page.pages().values())
    shown = re.findall(r"^::: (\S+)$", text, re.MULTILINE)
    assert {name for name in shown if not name.startswith("millrace.sb3.")} == public
    assert len(set(shown)) == len(shown)
    assert "millrace.sb3.make_vec_env" in shown
    assert all(f'<span id="{name}">' in text for name in shown), "the list of all names has their anchors"


def test_every_command_is_on_its_page() -> None:
    page = commands_page.page()
    for name in COMMANDS:
        assert f"### millrace {name}\n" in page
    for line in ("keys revoke", "launch slurm", "train --algo dqn", "bench"):
        assert f"$ millrace {line} --help\n" in page
    assert "--replay-size" in page


def test_every_exit_code_of_an_error_is_on_its_page() -> None:
    page = (ROOT / "docs/how-to/troubleshooting.md").read_text()
    for name in millrace.__all__:
        error = getattr(errors, name, None)
        if isinstance(error, type) and issubclass(error, UserFacingError) and error is not UserFacingError:
            (row,) = [row for row in page.splitlines() if row.startswith("|") and f"`{name}`" in row]
            assert row.endswith(f"| {error.exit_code} |")


def test_every_file_of_a_run_folder_is_on_its_page() -> None:
    page = (ROOT / "docs/reference/run_folder.md").read_text()
    listed = {name.rstrip("/") for name in re.findall(r"^\| `([\w./]+)` \|", page, re.MULTILINE)}
    in_code = {name.rstrip("/") for name in re.findall(r"^      ([\w.]+/?) {2,}", run_folder.__doc__ or "", re.MULTILINE)}
    _, there = logged("ppo")
    assert there <= listed
    assert in_code <= listed
    assert len(in_code) >= 10


def test_examples_in_docstrings_become_code() -> None:
    text = "About.\n\n>>> x = 1\n>>> x\n1\n\nMore.\n\n    >>> y"
    assert with_fences(text) == ("About.\n\n```pycon\n>>> x = 1\n>>> x\n1\n```\n\nMore.\n\n    ```pycon\n    >>> y\n    ```")


@pytest.mark.parametrize("page", KEPT)
def test_a_page_that_is_kept_is_that_of_the_code(page: str) -> None:
    assert (ROOT / "docs" / page).read_text("utf-8") == KEPT[page](), "write it by `make docs`"
