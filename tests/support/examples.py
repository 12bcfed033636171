"""How many examples a property is tried with: all in `make test-all`, a fifth in `make test` (`tests/conftest.py`)."""

from __future__ import annotations

from hypothesis import settings

ALL = 100
"""Examples in the profile of `make test-all`. It is hypothesis's own default."""
FEW = 20
"""Examples in the profile of `make test`."""


def examples(number: int) -> settings:
    """Decorate a property with the number of its examples in `make test-all`. It has no deadline: machines may be busy."""
    return settings(max_examples=max(1, number * settings().max_examples // ALL), deadline=None)
