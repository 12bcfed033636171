"""Holds callbacks' requests until the run takes them: numbers to log, and attributes to set on env copies.

Rule: a request is checked when it is made, so that the traceback shows the line in the user's code.
"""

from __future__ import annotations

import math
from typing import Any

from millrace.learner.run_folder.env_attributes import EnvAttributes
from millrace.protocol.bounds import one_line
from millrace.protocol.errors import UsageError, safe_repr

MOST_LOGGED = 1_000  # limit on the numbers that callbacks may log in one row
LONGEST_NAME = 200  # limit on the characters in a number's name


class Requests:
    """The requests that have not been taken yet."""

    def __init__(self, attributes: EnvAttributes | None = None) -> None:
        self.attributes = attributes or EnvAttributes()
        """the attributes that were set on env copies"""
        self.closed = ""
        """why no attribute may be set now; empty if attributes may be set"""
        self._logged: dict[str, float | None] = {}

    def log(self, name: str, value: Any) -> None:
        """Log a number with the row of the current update. Raises `UsageError` for anything but a name and a number."""
        if not isinstance(name, str) or not name or name != one_line(name, LONGEST_NAME):
            raise UsageError(f"log: expected a name of 1 to {LONGEST_NAME} characters in one line, got {_shown(name)}")
        try:
            number = float("text" if isinstance(value, str | bytes) else value)
        except (TypeError, ValueError, OverflowError, RuntimeError):  # torch raises RuntimeError
            raise UsageError(f"log {name}: expected a number, got {_shown(value)}") from None
        name = name if "/" in name else f"custom/{name}"
        if name not in self._logged and len(self._logged) >= MOST_LOGGED:
            raise UsageError(f"log {name}: expected at most {MOST_LOGGED} names in one row")
        self._logged[name] = number if math.isfinite(number) else None

    def logged(self) -> dict[str, float | None]:
        """The numbers that were logged since the last call of `take_logged`."""
        return dict(self._logged)

    def set_env_attr(self, name: str, value: Any) -> None:
        """Set an attribute of every env copy from the next weights on. Raises `UsageError` if it cannot be sent."""
        if self.closed:
            raise UsageError(f"set_env_attr {one_line(str(name), 80)}: {self.closed}")
        self.attributes.set(name, value)

    def take_logged(self) -> dict[str, float | None]:
        """Take the numbers that were logged since the last call."""
        taken = self._logged
        self._logged = {}
        return taken


def _shown(value: object) -> str:
    return one_line(f"{type(value).__name__} {safe_repr(value)}", 80)
