"""What a misspelt name was perhaps meant to be. Pure."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def nearest(name: str, known: Iterable[str], prefix: str = "") -> str:
    """`; did you mean …?` if something known is close to the name, else nothing. `prefix` is put before the guess."""
    found = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean {prefix}{found[0]}?" if found else ""
