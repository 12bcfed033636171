"""Limits the time that the dicts of a value or a file take because of their keys. Pure.

Rule: anybody can choose keys so that each collides with all others in its dict, so the time that a dict takes can grow with
the square of the number of its keys. Therefore, the squares of all dicts are added up, and their sum has a limit. Text
doesn't count, because Python's hashes of text are secret. Each value has a limit of its own: whether the info of an env copy
can be sent depends on nothing that is in the same message.
"""

from __future__ import annotations

from millrace.protocol.bounds import MOST_KEYS_SQUARED, MOST_OTHER_KEYS


class KeyLimit:
    """Counts the keys of all dicts in some values, or in a file. A key counts unless it is text."""

    def __init__(self, values: int = 1) -> None:
        """Allows as many keys as this number of values may have together."""
        self._left = values * MOST_KEYS_SQUARED

    def allows(self, keys: int, before: int = 0) -> bool:
        """Whether a dict may have this number of keys. If so, they count from now on, instead of those it had before."""
        squares = keys**2 - before**2
        if keys > MOST_OTHER_KEYS or squares > self._left:
            return False
        self._left -= squares
        return True
