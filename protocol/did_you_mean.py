"""Suggestions for misspelled names. Pure."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str], prefix: str = "") -> str:
    """`; did you mean NAME?` if a known name is similar, else an empty string. `prefix` is put before the suggestion."""
    similar = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean {prefix}{similar[0]}?" if similar else ""
