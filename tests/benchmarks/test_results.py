"""The manual and benchmarks/README.md have the tables of benchmarks/scores.json, and the commands of the scores parse."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import pytest

from benchmarks import results
from benchmarks.scores import (
    PublishedScore,
    Score,
    commands_table,
    merged,
    read_published,
    read_scores,
    returns_table,
    seeds_text,
    write_scores,
)
from millrace.cli.main import main
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.learner.config.layers import resolve
from millrace.learner.config.presets import environment_name

SCORES = read_scores()


def test_the_pages_have_the_tables_of_the_scores() -> None:
    (returns,) = results.RETURNS.findall(results.PAGE.read_text())
    assert returns == returns_table(SCORES, read_published())
    (commands,) = results.COMMANDS.findall(results.PAGE_OF_COMMANDS.read_text())
    assert commands == commands_table(SCORES)


def test_scores_are_compared_with_those_of_the_same_environment_and_algorithm() -> None:
    score = Score(env="A-v5", algo="ppo", command="", env_steps=998_915, final={1: 10.0, 3: 30.0})
    rows = (("A-v5", "ppo", 25.0, 1_000_000), ("A-v5", "sac", 99.0, 300_000), ("B-v5", "ppo", 98.0, 1))
    published = [
        PublishedScore(env=env, algo=algo, system="X", returns=value, env_steps=steps) for env, algo, value, steps in rows
    ]
    (row,) = returns_table([score], published).splitlines()[2:]
    assert row == "| A-v5 | ppo | 1M | 10.0, 30.0 (seeds 1, 3) | – | X 25.0 (1M) |"


def test_the_file_is_as_the_program_writes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.scores.SCORES", tmp_path / "scores.json")
    write_scores(SCORES)
    assert (tmp_path / "scores.json").read_bytes() == Path(results.__file__).with_name("scores.json").read_bytes()


def test_published_scores_have_algorithms_that_exist() -> None:
    published = read_published()
    assert {score.algo for score in published} <= HYPERPARAMETERS.keys()
    assert len({(score.env, score.algo, score.system) for score in published}) == len(published)


@pytest.mark.parametrize("command", [score.command for score in SCORES])
def test_each_command_parses(command: str, capfd: pytest.CaptureFixture[str]) -> None:
    words = shlex.split(command.replace("--seed S", "--seed 1"))
    assert main([*words[1:], "--steps", "none_of_this"]) == 2
    assert "steps" in capfd.readouterr().err  # nothing else is wrong with it


@pytest.mark.parametrize(
    ("env", "settings", "words"),
    [
        ("CartPole-v1", {}, ""),
        ("CartPole-v1", {"algo": "dqn", "double": False}, "--algo dqn --no-double"),
        ("CartPole-v1", {"normalize_rewards": True, "net": [8, 4]}, "--net 8 4 --normalize-rewards"),
        ("millrace/Atari-v0", {"env_kwargs": {"game": "Breakout"}}, "--env-kwargs game Breakout"),
        ("CartPole-v1", {"eval_episodes": 20}, "--eval-episodes 20"),
        (
            "CartPole-v1",
            {"wrappers": ["a:B", "c:D"]},
            "--wrappers a:B c:D",
        ),
        (
            "millrace/Atari-v0",
            {"preset": "none", "env_kwargs": {"game": "Pong"}},
            "--preset none --env-kwargs game Pong",
        ),
        ("CartPole-v1", {"workers": 1}, ""),
        ("CartPole-v1", {"workers": 1, "max_lag": 1}, "--workers 1 --max-lag 1"),
        ("Pendulum-v1", {"algo": "sac", "eval_episodes": None}, "--algo sac --eval-episodes none"),
    ],
)
def test_a_command_names_what_differs_from_the_preset_and_the_defaults(
    env: str, settings: dict[str, Any], words: str
) -> None:
    command = results.command(resolve(env, **settings))
    assert sorted(command.split()) == sorted(["millrace", "train", env, "--seed", "S", *words.split()])


def score(final: dict[int, float], **given: Any) -> Score:
    return Score(env="E", algo="ppo", command="c", env_steps=5, final=final, **given)


@pytest.mark.parametrize(
    ("env", "env_kwargs", "name"),
    [("CartPole-v1", {}, "CartPole-v1"), ("millrace/Atari-v0", {"game": "Pong"}, "millrace/Atari-v0 game Pong")],
)
def test_the_table_names_an_environment_with_the_arguments_that_its_preset_lacks(
    env: str, env_kwargs: dict[str, Any], name: str
) -> None:
    config = resolve(env, env_kwargs=env_kwargs)
    assert environment_name(config.env, config.env_kwargs, config.algo) == name


def test_a_new_run_is_added_to_the_other_seeds_of_its_row() -> None:
    old = score({1: 1.0, 3: 3.0}, best={1: 2.0}, seconds=9.0, note="masked")
    both = merged(old, score({2: 5.0, 3: 4.0}, seconds=7.0))
    assert (both.final, both.best, both.seconds, both.note) == ({1: 1.0, 2: 5.0, 3: 4.0}, {1: 2.0}, 9.0, "masked")
    assert merged(None, old) is old


@pytest.mark.parametrize(
    ("returns", "text"),
    [
        ({1: 500.0, 2: 499.6, 3: -1234.5}, "500, 500, -1,234"),
        ({1: 8.314, 2: -0.5, 3: 9.999}, "8.31, -0.50, 10.00"),
        ({2: 6967.0}, "6,967 (seed 2 only)"),
        ({1: 1.0, 3: 2.0}, "1.00, 2.00 (seeds 1, 3)"),
        ({seed: 100.0 + seed for seed in range(1, 5)}, "101, 102, 103, 104 (seeds 1, 2, 3, 4)"),
        (dict.fromkeys(range(1, 7), 500.0), "**500** [500, 500], 6 seeds"),
        ({}, "–"),
    ],
)
def test_returns_are_shown_in_the_order_of_seeds(returns: dict[int, float], text: str) -> None:
    assert seeds_text(returns) == text
