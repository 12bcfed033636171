"""Words of `NAME VALUE ...`: TOML's values, text, and what is refused because another language reads a value in it."""

import math
import shlex
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from millrace.flags.fields import fields_of
from millrace.flags.parse import typed_flags
from millrace.flags.toml_words import as_text, read_word, written
from millrace.flags.values import read_words
from millrace.learner.config.config import Config
from millrace.learner.config.layers import resolve
from millrace.learner.config.presets import environment_name
from millrace.protocol.errors import UsageError

FIELD = fields_of(Config)["env_kwargs"]


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("true", True), ("false", False), ("3", 3), ("-3", -3), ("1_000", 1000), ("0x10", 16), ("1e6", 1e6), ("2.5", 2.5),
        ('"false"', "false"), ("'None'", "None"), ('""', ""),
        ("Pong", "Pong"), ("", ""), ("two words", "two words"), ("/data/{slot}", "/data/{slot}"),
        ("{5000 + slot}", "{5000 + slot}"), ("1.2.3", "1.2.3"), ("nobody", "nobody"), ("1}", "1}"), ("1, b = 2", "1, b = 2"),
        ("1\nx = 2", "1\nx = 2"), ("[" * 5000, "[" * 5000),
    ],
)  # fmt: skip
def test_a_word_is_the_value_that_toml_reads_in_it_and_else_text(word: str, value: Any) -> None:
    read = read_words(FIELD, ["name", word])["name"]
    assert (read, type(read)) == (value, type(value))


def test_infinity_and_nan_are_numbers() -> None:
    assert read_word("-inf") == -math.inf
    assert math.isnan(read_word("nan"))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("word", "write"),
    [
        ("True", "write true"), ("False", "write false"), ("FALSE", "write false"), ("no", "write false"),
        ("On", "write true"), ("None", "leave the argument out"), ("null", "leave the argument out"),
        ("nil", "leave the argument out"), ("NaN", "write nan"), ("Infinity", "write inf"), (".5", "write 0.5"),
        ("5.", "write 5.0"), ("007", "write 7"), ("(1, 2)", "write a number, text, true or false"),
        ("[None]", "write a number, text, true or false"), ("0,1", "write a number, text, true or false"),
        ("{'a': 1}", "write a number, text, true or false"), ("'abc", "write the quotes as in TOML"),
    ],
)  # fmt: skip
def test_a_value_of_another_language_is_refused_in_a_line_that_says_what_to_write(word: str, write: str) -> None:
    with pytest.raises(UsageError) as refused:
        read_words(FIELD, ["name", word])
    line = str(refused.value)
    assert line.startswith(f"--env-kwargs: name: expected a value as in TOML, got {word}; {write}, or ")
    (typed,) = shlex.split(line.rpartition(", or ")[2].removesuffix(" for this text"))
    assert read_words(FIELD, ["name", typed]) == {"name": word}
    if write.startswith("write ") and " " not in (value := write.removeprefix("write ")):
        assert not isinstance(read_word(value), str)


@pytest.mark.parametrize("word", ["[1, 2]", "{a = 1}", "2024-01-01", "12:00:00", "2024-01-01T00:00:00Z"])
def test_a_value_that_no_environment_can_get_is_refused(word: str) -> None:
    with pytest.raises(UsageError) as refused:
        read_words(FIELD, ["name", word])
    line = str(refused.value)
    assert (
        line
        == f"--env-kwargs: name: expected a number, text, true or false, got {word}; write {as_text(word)} for this text"
    )
    (typed,) = shlex.split(as_text(word))
    assert read_words(FIELD, ["name", typed]) == {"name": word}


@pytest.mark.parametrize("value", ["2024-01-01", "12:00:00", "2024-01-01T00:00:00Z", "[1]"])
def test_so_it_is_in_a_file(value: str, tmp_path: Any) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(f'env = "CartPole-v1"\n[env_kwargs]\nx = {value}\n')
    with pytest.raises(
        UsageError, match="env_kwargs: argument x: expected a number of at most 64 bits, text, True or False"
    ):
        resolve(file=file)


@given(st.one_of(st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), st.text(max_size=20)))
def test_what_is_written_is_read_again(value: object) -> None:
    read = read_word(written(value))
    assert (read, type(read)) == (value, type(value))


@pytest.mark.parametrize("value", ["-x", "--help", "--debug", "--", "-", "-1", "-inf", -1, -0.5, -math.inf])
def test_what_is_written_is_no_flag_even_if_it_begins_with_a_dash(value: object) -> None:
    (_, flag) = typed_flags(["--env-kwargs", "a", written(value)])
    assert read_words(FIELD, flag.words) == {"a": value}


def test_a_text_and_the_value_that_it_looks_like_name_two_environments() -> None:
    names = [environment_name("E-v0", {"x": value}, "ppo") for value in (True, "true", 1, "1", "Pong", 0.5)]
    assert names == ["E-v0 x true", "E-v0 x '\"true\"'", "E-v0 x 1", "E-v0 x '\"1\"'", "E-v0 x Pong", "E-v0 x 0.5"]
