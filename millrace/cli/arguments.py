"""Flags by argparse, for the commands that also work where only a worker's packages are installed: `status` and `keys`.

The other commands take their flags by tyro (`learner.config.flag_parser`). In both cases an error of the user is one line.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any, NoReturn

from protocol.errors import UsageError, did_you_mean, unexpected_arguments


class Arguments(argparse.ArgumentParser):
    """The arguments of `millrace COMMAND`."""

    def __init__(self, command: str, about: str) -> None:
        super().__init__(prog=f"millrace {command}", description=about, allow_abbrev=False)
        self._command = command
        self._names: list[str] = []
        self._takes_run = False
        self.flag("--debug", action="store_true", help="show the traceback of an error")

    def flag(self, name: str, **settings: Any) -> None:
        """Add an argument, as `add_argument` does."""
        self._names.append(name)
        self._takes_run |= "RUN" in settings.get("metavar", "")
        self.add_argument(name, **settings)

    def parse(self, argv: Sequence[str]) -> argparse.Namespace:
        """The values. Raises `UsageError`, or `SystemExit(0)` after `--help`."""
        values, unknown = self.parse_known_args(argv)
        if flag := next((word for word in unknown if word.startswith("-")), None):
            raise UsageError(f"{self._command}: unknown flag {flag}{did_you_mean(flag, self._names)}")
        if unknown:
            raise UsageError(f"{self._command}: {unexpected_arguments(unknown, one_run=self._takes_run)}")
        return values

    def error(self, message: str) -> NoReturn:
        """Raise `UsageError`; argparse itself would end the process."""
        raise UsageError(f"{self._command}: {message}; {self.prog} --help tells more")
