"""Formats times and numbers for people: with two or three digits, because measurements aren't more precise. Pure."""

from __future__ import annotations

from collections.abc import Sequence

UNITS = ((1e-3, "µs", 1e-6), (1.0, "ms", 1e-3), (60.0, "s", 1.0), (3600.0, "min", 60.0), (48 * 3600.0, "h", 3600.0))
"""For each unit: the number of seconds below which it is used, its symbol, and its length in seconds."""
DAY_S = 86400.0


def time_in_words(seconds: float) -> str:
    """A time in its usual unit, such as 9.7 ms."""
    for below_s, unit, unit_s in UNITS:
        if seconds < below_s:
            return f"{number_in_words(seconds / unit_s)} {unit}"
    return f"{number_in_words(seconds / DAY_S)} days"


def number_in_words(number: float) -> str:
    """A number with two digits, or three if it begins with 1, such as 9.7, 17.3 or 1,730."""
    rounded = float(f"{number:.3g}" if f"{number:e}".startswith("1") else f"{number:.2g}")
    return f"{rounded:,.0f}" if rounded >= 100 or rounded == int(rounded) else f"{rounded:g}"


def counted(number: int, singular: str, plural: str = "") -> str:
    """A number and its noun, such as 1 core or 2 cores."""
    return f"{number:,} {singular if number == 1 else plural or singular + 's'}"


def enumerated(numbers: Sequence[int]) -> str:
    """The numbers in one phrase, such as 2, 3 and 4."""
    return " and ".join(filter(None, [", ".join(map(str, numbers[:-1])), *map(str, numbers[-1:])]))
