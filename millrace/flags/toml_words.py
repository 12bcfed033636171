"""Turns a word in `NAME VALUE ...` into a value, and a value into such a word.

Rule: a word that is a value in TOML is that value, as in a config file. Any other word is text, unless it is a value in
another language (`None`, `True`, `.5`). Such a word is refused, because nobody means it as text. (The text "False" would
count as true.)
"""

from __future__ import annotations

import ast
import json
import shlex
import tomllib

from millrace.protocol.bounds import one_line
from millrace.protocol.errors import UsageError

IN_TOML = {
    "true": "true", "yes": "true", "on": "true", "false": "false", "no": "false", "off": "false", "nan": "nan",
}  # fmt: skip
"""What to write in TOML for a word of another language. The keys are in lower case."""
NOTHING = ("none", "null", "nil", "undefined")


def read_word(word: str) -> object:
    """The value of a word. If it is a value in another language, raises `UsageError`, which says what to write instead."""
    try:
        # The word is in a one-line table, so that it can begin neither a comment nor another key.
        table = tomllib.loads(f"one = {{value = {word}}}")
    except (ValueError, RecursionError):
        table = {}
    match table:
        case {"one": {"value": value} as one} if len(one) == len(table) == 1:
            return value
    if what := _what_to_write(word):
        raise UsageError(f"expected a value as in TOML, got {one_line(word, 60)}; {what}, or {as_text(word)} for this text")
    return word


def as_text(word: str) -> str:
    """What to type in a shell to give this word as text, even if it is a value in TOML."""
    return one_line(shlex.quote(_in_toml(word)), 60)


def written(value: object) -> str:
    """The word that `read_word` reads as this value. A command line doesn't take the word for a flag."""
    try:
        if isinstance(value, str) and not value.startswith("-") and read_word(value) == value:
            return value
    except UsageError:
        pass
    return _in_toml(value)


def _in_toml(value: object) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case _:
            return str(value)


def _what_to_write(word: str) -> str:
    """What to write in TOML for a word that is a value in another language; empty for any other word."""
    if word.lower() in IN_TOML:
        return f"write {IN_TOML[word.lower()]}"
    if word.lower() in NOTHING:
        return "leave the argument out"
    for number in (int, float):
        try:
            return f"write {number(word)!r}"
        except ValueError:
            pass
    if word[:1] in ("'", '"'):
        return "write the quotes as in TOML"
    try:
        ast.literal_eval(word)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return ""
    return "write a number, text, true or false"
