"""What others call our settings: each that is named exists and takes the value that is shown."""

from __future__ import annotations

import ast

import pytest

from millrace.learner.config.config import Config
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.learner.config.layers import resolve
from millrace.learner.config.other_names import OTHERWISE, SAME_VALUE, SAYS, SETTING, in_place_of, written
from millrace.protocol.flags.fields import fields_of
from millrace.protocol.flags.values import read_value, read_words

FIELDS = {name: field for kind in (Config, *HYPERPARAMETERS.values()) for name, field in fields_of(kind).items()}


def test_what_is_named_in_place_of_another_name_exists() -> None:
    assert {match[1] for says in SAYS.values() for match in SETTING.finditer(says)} <= FIELDS.keys()
    assert not SAYS.keys() & Config.__struct_fields__, "it is a setting"
    others = [other for names in SAME_VALUE.values() for other in names.split()] + [*OTHERWISE]
    assert len(set(others)) == len(others), "a name has one meaning"


def test_what_is_shown_to_be_written_can_be_written() -> None:
    shown = {match.groups() for says in SAYS.values() for match in SETTING.finditer(says) if match[2]}
    assert shown
    for name, value in shown:
        algo = next(algo for algo, kind in HYPERPARAMETERS.items() if name in (*kind.__struct_fields__, "device"))
        assert resolve("CartPole-v1", algo=algo, **{name: ast.literal_eval(value)})
        flag, *words = written(name, value, flag=True).split()
        assert flag == f"--{name.replace('_', '-')}"
        assert read_words(FIELDS[name], words) == read_value(FIELDS[name], ast.literal_eval(value))


@pytest.mark.parametrize(
    ("name", "value", "flag", "says"),
    [
        ("n_envs", "8", True, "; millrace calls it --envs 8"),
        ("n_envs", 8, False, "; millrace calls it envs=8"),
        ("total_timesteps", None, True, "; millrace calls it --steps"),
        ("env_config", {"a long key": "a value that is too long to be shown"}, False, "; millrace calls it env_kwargs"),
        ("buffer_size", "9", True, "; millrace calls it --replay-size 9; it is one of dqn, sac, td3 alone"),
        ("gradient_steps", "1", True, "; it is one of dqn alone"),
        ("train_batch_size", 4000, False, "; a batch has envs times rollout_steps env steps"),
        ("policy_kwargs", {}, False, "; millrace calls what is in it net=(64, 64), activation='relu', encoder"),
        ("stepz", "8", True, ""),
    ],
)
def test_the_line_says_what_to_write(name: str, value: object, flag: bool, says: str) -> None:
    known = {*Config.__struct_fields__, *HYPERPARAMETERS["ppo"].__struct_fields__}
    assert in_place_of(name, value, known, flag=flag) == says


def test_a_setting_of_another_algorithm_is_ours_unless_this_one_has_what_stands_for_it() -> None:
    sac = {*Config.__struct_fields__, *HYPERPARAMETERS["sac"].__struct_fields__}
    assert in_place_of("gradient_steps", 1, sac).endswith("for each env step: updates_per_step=1")
