"""Turns words of a command line, or a keyword argument, into the value of a field, and values into a record.

Rules: a whole number may be written as 1e6 or 1_000_000, and several as 64 64 or 64,64. The values in a table are written as
in TOML (toml_words.py). The values of any other field are parsed by the field's type. Values from Python and TOML aren't
parsed: there, the text "2.5" isn't a number.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import msgspec

from millrace.flags.fields import FlagField, choices, fields_of, is_choice
from millrace.flags.toml_words import as_text, read_word
from millrace.protocol.bounds import MAX_NAME, one_line
from millrace.protocol.errors import UsageError, safe_repr

RecordT = TypeVar("RecordT", bound=msgspec.Struct)


def read_words(field: FlagField, words: Sequence[str]) -> Any:
    """Parse these words as the value of this field. Raises `UsageError` if they aren't one."""
    if field.optional and list(words) in (["none"], ["None"]):
        return None
    match get_origin(field.kind):
        case origin if origin is dict:
            if wrong := [name for name in words[::2] if "=" in name]:
                name, _, right = wrong[0].partition("=")
                looks_like_a_flag = right.startswith("-") and not right[1:2].isdigit()
                apart = f"{name} {as_text(right) if looks_like_a_flag else right}"
                raise UsageError(
                    f"{field.written}: expected NAME VALUE, got {wrong[0]}; write them apart: {one_line(apart)}"
                )
            if len(words) % 2:
                hint = f"; a text that begins with a dash is written in quotes: {shlex.quote(words[-1])} '\"-x\"'"
                raise UsageError(f"{field.written}: expected NAME VALUE NAME VALUE ..., got {shlex.join(words)}{hint}")
            return {name: _entry(field, name, word) for name, word in zip(words[::2], words[1::2], strict=True)}
        case origin if origin in (tuple, list):
            value: object = list(words)
        case _:
            (value,) = words
    value = with_whole_numbers(field, value)
    try:
        return msgspec.convert(value, field.hint, strict=False, dec_hook=_path)
    except msgspec.ValidationError as error:
        expected = what_was_expected(str(error), field.hint)
    except UnicodeEncodeError:  # a word, such as a file's name, may contain any bytes
        expected = "expected text in UTF-8"
    raise UsageError(f"{field.written}: {expected}, got {shlex.join(words)}")


def with_whole_numbers(field: FlagField, value: Any) -> Any:
    """Return the value. If the field takes whole numbers, text and floats such as 1e6 are converted to int."""
    if not field.whole:
        return value
    if not field.many:
        return _whole(value)
    if isinstance(value, str):
        value = [value]
    return [one for each in value for one in _several(each)] if isinstance(value, list | tuple) else value


def _several(value: Any) -> list[Any]:
    return list(map(_whole, value.strip("()[], ").split(","))) if isinstance(value, str) else [_whole(value)]


def _whole(value: Any) -> Any:
    for number in (int, float) if isinstance(value, str) else ():
        try:
            value = number(value)
            break
        except ValueError:
            pass
    return int(value) if isinstance(value, float) and value.is_integer() else value


def convert(values: Mapping[str, Any], record: type[RecordT], origins: Mapping[str, str]) -> RecordT:
    """Make a record from these values, which come from Python or TOML. Raises `UsageError` if one has a wrong type.

    `origins`: how an error refers to each value, such as `--max-lag` or `my.toml: max_lag`, by the value's name.
    """
    try:
        return msgspec.convert(values, record, dec_hook=_path)
    except msgspec.ValidationError as error:
        name = re.split(r"[.\[`]", str(error).partition(" - at `$.")[2])[0]
        given = list(values[name]) if isinstance(values[name], tuple) else values[name]
        expected = what_was_expected(str(error), fields_of(record)[name].hint)
        raise UsageError(f"{origins[name]}: {expected}, got {one_line(safe_repr(given), MAX_NAME)}") from error


def _path(kind: Any, value: object) -> Path:
    """Convert text to a path, for msgspec. `kind` is always `Path`, the only field type that msgspec doesn't know."""
    if not isinstance(value, str | os.PathLike):
        raise TypeError("Expected `text or a path`")
    return Path(value)


def what_was_expected(message: str, hint: Any) -> str:
    """The part `expected …` of an error line, made from msgspec's message and the type of the field."""
    if message.startswith("Invalid enum value") or (hint is not None and is_choice(hint)):
        return f"expected one of {', '.join(choices(hint))}"
    text = message.partition(" - at ")[0].replace(" | null", ' or "none"').replace("`object`", "table")
    text = text.replace("bool | int | float | str", "a number, text, true or false")
    text = text.replace("`str", "`text").replace("`array", "`a list")
    return re.sub(", got .*", "", text).replace("`", "").replace("Expected", "expected", 1)


def _entry(field: FlagField, name: str, word: str) -> Any:
    """The value of an entry in a table. Raises `UsageError` if the word isn't one."""
    try:
        value = read_word(word)
        return msgspec.convert(value, get_args(field.kind)[1])
    except UsageError as error:
        raise UsageError(f"{field.written}: {name}: {error}") from None
    except msgspec.ValidationError as error:
        expected = what_was_expected(str(error), None)
        raise UsageError(
            f"{field.written}: {name}: {expected}, got {one_line(word, 60)}; write {as_text(word)} for this text"
        ) from None
