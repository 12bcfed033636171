"""A command line is made of a record: which words are flags, which are values, and what a value becomes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest
from msgspec import Meta

from millrace.flags.fields import Flag, fields_of
from millrace.flags.help import help_text
from millrace.flags.parse import first_words, parse_flags, typed_flags
from millrace.protocol.errors import UsageError


class Base(msgspec.Struct, frozen=True, kw_only=True):
    """Flags of several commands."""

    name: Annotated[str, Flag(positional=True)] = ""
    """who"""
    rate: float = 1.0
    """how fast"""


class Flags(Base, frozen=True, kw_only=True):
    """Do it."""

    rate: Annotated[float, Meta(gt=-5)] = 2.0
    """how much faster"""
    sizes: tuple[Annotated[int, Meta(ge=1)], ...] = (8,)
    """how large"""
    table: dict[str, bool | int | float | str] = {}
    """names and values"""
    level: Literal[1, 2] | None = 1
    """how high"""
    path: Annotated[Path | None, Flag("PATH", alias="to")] = None
    """where"""
    gentle: bool = False
    """do it gently"""
    maybe: bool | None = None
    """perhaps"""
    inner: Annotated[int, Flag(hidden=True)] = 0
    """of another process"""


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("", {}),
        ("me --rate 3", {"name": "me", "rate": 3.0}),
        ("--rate 3 me", {"name": "me", "rate": 3.0}),
        ("--rate -1e-3", {"rate": -1e-3}),
        ("--rate 1 --rate 4", {"rate": 4.0}),
        ("--name=x --sizes 3 4 --gentle me", None),
        ("--sizes 3 4 --gentle me", {"sizes": (3, 4), "gentle": True, "name": "me"}),
        ("--sizes", {"sizes": ()}),
        ("--sizes 3,4", {"sizes": (3, 4)}),
        ("--sizes 1e1 1_000", {"sizes": (10, 1000)}),
        ("--inner 1e6", {"inner": 1_000_000}),
        ("--inner 9007199254740993", {"inner": 2**53 + 1}),
        ("--to 1e6", {"path": Path("1e6")}),
        ("--table a true b 2 c 2.5 d text", {"table": {"a": True, "b": 2, "c": 2.5, "d": "text"}}),
        ("--level 2", {"level": 2}),
        ("--level none", {"level": None}),
        ("--to a/b", {"path": Path("a/b")}),
        ("--path none", {"path": None}),
        ("--gentle --no_gentle", {"gentle": False}),
        ("--maybe True", {"maybe": True}),
        ("--inner 3 --debug", {"inner": 3}),
    ],
)
def test_words_become_values(words: str, expected: dict[str, Any] | None) -> None:
    if expected is None:
        with pytest.raises(UsageError, match="do: NAME has no flag; expected it as in: millrace do NAME"):
            parse_flags(Flags, words.split(), "do")
    else:
        assert parse_flags(Flags, words.split(), "do") == Flags(**expected)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("--rat 3", "do: unknown flag --rat; did you mean --rate?"),
        ("--no-gentl", "do: unknown flag --no-gentl; did you mean --no-gentle?"),
        ("-x", "do: unknown flag -x"),
        ("--rate --gentle", "do: expected --rate FLOAT, got no value; millrace do --help tells more"),
        ("--rate -5", "--rate: expected float > -5.0, got -5"),
        ("--inner 1.5", "--inner: expected int, got 1.5"),
        ("--sizes 3,x", "--sizes: expected int, got 3,x"),
        ("--sizes 3 0", "--sizes: expected int >= 1, got 3 0"),
        ("--level 3", "--level: expected one of 1, 2, none, got 3"),
        (
            "--table a",
            "--table: expected NAME VALUE NAME VALUE ..., got a; "
            "a text that begins with a dash is written in quotes: a '\"-x\"'",
        ),
        ("--table a=1", "--table: expected NAME VALUE, got a=1; write them apart: a 1"),
        ("--table a=-x", "--table: expected NAME VALUE, got a=-x; write them apart: a '\"-x\"'"),
        ("--table a=-3", "--table: expected NAME VALUE, got a=-3; write them apart: a -3"),
        ("--table a 1 b=2 c=3", "--table: expected NAME VALUE, got b=2; write them apart: b 2"),
        ("--inner \udce9", "--inner: expected text in UTF-8, got '\\udce9'"),
        ("--sizes 3 \udce9", "--sizes: expected text in UTF-8, got 3 '\\udce9'"),
        ("--gentle=yes", "do: --gentle=yes: expected --gentle or --no-gentle"),
        ("a b", "do: unexpected argument b"),
    ],
)
def test_what_is_wrong_is_one_line(words: str, why: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_flags(Flags, words.split(), "do")
    assert str(caught.value) == why


def test_flags_are_read_ahead_whatever_the_others_are() -> None:
    words = ["--unknown", "--algo", "a", "E", "--file=b", "--algo", "c", "--empty"]
    assert first_words(typed_flags(words), "algo", "file", "empty") == {"algo": "c", "file": "b"}


def test_a_redefined_field_keeps_its_place_and_the_help_hides_what_is_not_for_the_user() -> None:
    assert list(fields_of(Flags))[:3] == ["name", "rate", "sizes"]
    text = help_text("do", "Do it.", {"flags": (Flags, list(fields_of(Flags)))})
    assert "how much faster (default: 2.0)" in text
    assert "--to, --path PATH" in text
    assert "  --gentle  " in text
    assert "--no-gentle" in help_text("do", "Do it.", {"flags": (Flags(), ["gentle"])}), "a preset may have set it"
    assert "inner" not in text
