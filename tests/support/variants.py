"""Cases of one fact: those of the default run, and variants, which only `make test-rest` runs."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def variants(cases: Iterable[Any], *, default: Collection[Any]) -> list[Any]:
    """The values of a parameter, or tuples of the values of several. Those that are not in `default` are marked `rest`."""
    found = list(cases)
    assert all(case in found for case in default), f"{default}: expected some of {found}"
    return [case if case in default else _in_rest(case) for case in found]


def _in_rest(case: Any) -> Any:
    values = case if isinstance(case, tuple) else (case,)
    return pytest.param(*values, marks=pytest.mark.rest)
