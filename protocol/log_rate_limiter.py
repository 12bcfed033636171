"""A lid on the log: about one thing at most a line in a while, and about few things at once. Pure: `now` is an argument.

The law: whoever causes the lines cannot make many of them, nor make this table grow.
"""

from __future__ import annotations


class LogRateLimiter:
    """Says whether a line is due."""

    def __init__(self, every_s: float = 60.0, most: int = 20) -> None:
        """A line about one key in `every_s`; about at most `most` keys in that time."""
        self.every_s, self.most = every_s, most
        self._said: dict[str, tuple[float, int]] = {}  # when, and how many lines were kept back since

    def due(self, key: str, now: float) -> int | None:
        """None: keep this line back. Else how many about this key were kept back since the last one that was said."""
        said = self._said.get(key)
        if said is not None and now - said[0] < self.every_s:
            self._said[key] = (said[0], said[1] + 1)
            return None
        if said is None and len(self._said) >= self.most:
            self._said = {key: said for key, said in self._said.items() if now - said[0] < self.every_s}
            if len(self._said) >= self.most:
                return None
        self._said[key] = (now, 0)
        return said[1] if said is not None else 0


def suppressed_note(kept_back: int) -> str:
    """What to put behind a line that is due."""
    return f" ({kept_back} more like this since the last line)" if kept_back else ""
