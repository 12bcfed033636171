"""What others call our settings: the names that an error answers, and the table of all names in the manual."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from millrace.learner.config.config import Config
from millrace.learner.config.hyperparameters import HYPERPARAMETERS, algorithms_with
from millrace.learner.config.layers import resolve
from millrace.learner.config.other_names import INSTEAD, OUR_NAME, in_place_of

OF_ANY_RUN = {*Config.__struct_fields__}
SETTINGS = OF_ANY_RUN.union(*(record.__struct_fields__ for record in HYPERPARAMETERS.values()))
PAGE = Path(__file__).parents[3] / "docs/how-to/moving_from.md"
NAME = re.compile(r"`(\w+)`")
SETTING = re.compile(r"`(\w+)(?:=([^`]*))?`")
ONLY_IN_PYTHON = {"progress"}


def table() -> list[tuple[list[str], dict[str, str]]]:
    """The rows of the table of all names: the others' names, and our settings with the values that are shown."""
    section = PAGE.read_text().partition("## Every name")[2]
    rows = [line.strip("|").split(" | ") for line in section.splitlines() if line.startswith("| `")]
    return [(NAME.findall(others), dict(SETTING.findall(ours))) for others, ours in rows]


def test_the_names_that_an_error_gives_are_settings() -> None:
    assert {*OUR_NAME.values()} <= SETTINGS
    assert not (OUR_NAME.keys() | INSTEAD.keys()) & SETTINGS
    assert {flag.replace("-", "_") for line in INSTEAD.values() for flag in re.findall("--([a-z-]+)", line)} <= SETTINGS


def test_the_manual_has_every_name_once_and_only_our_settings_in_their_place() -> None:
    others = [other for names, _ in table() for other in names]
    assert len(set(others)) == len(others) > 100
    assert not set(others) & OF_ANY_RUN, "it is a setting"
    assert {name for _, ours in table() for name in ours} - SETTINGS == ONLY_IN_PYTHON


def test_an_error_and_the_manual_say_the_same() -> None:
    in_manual = {other: ours for others, ours in table() for other in others}
    assert {other: [*in_manual[other]] for other in OUR_NAME} == {other: [ours] for other, ours in OUR_NAME.items()}


def test_the_values_that_the_manual_shows_can_be_written() -> None:
    shown = {(name, value) for _, ours in table() for name, value in ours.items() if value and name not in ONLY_IN_PYTHON}
    assert shown
    for name, value in shown:
        has_it = (algo for algo, record in HYPERPARAMETERS.items() if name in (*OF_ANY_RUN, *record.__struct_fields__))
        assert resolve("CartPole-v1", algo=next(has_it), **{name: ast.literal_eval(value)})


@pytest.mark.parametrize(
    ("name", "flag", "says"),
    [
        ("n_envs", True, "; millrace calls it --envs"),
        ("n_steps", True, "; millrace calls it --rollout-steps"),
        ("n_steps", False, "; millrace calls it rollout_steps"),
        ("buffer_size", True, f"; millrace calls it --replay-size{algorithms_with('replay_size')}"),
        ("gradient_steps", True, "; it is one of dqn, rainbow alone"),
        ("stepz", True, ""),
        ("frame_stack", True, '; to stack images, take --wrappers "millrace:StackImages(n=4)"'),
        ("policy", False, "; the network follows from the environment's spaces, and --net sets its layers"),
    ],
)
def test_the_line_says_what_to_write(name: str, flag: bool, says: str) -> None:
    known = {*OF_ANY_RUN, *HYPERPARAMETERS["ppo"].__struct_fields__}
    assert in_place_of(name, known, flag=flag) == says
