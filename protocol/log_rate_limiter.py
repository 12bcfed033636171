"""Limits how often a log line is repeated. Pure: `now` is an argument.

Rule: a peer that causes log lines can neither cause many of them nor make this table grow.
"""

from __future__ import annotations


class LogRateLimiter:
    """Says whether a line may be logged now."""

    def __init__(self, every_s: float = 60.0, most: int = 20) -> None:
        """Allow one line for each key in `every_s` seconds, for at most `most` keys in that time."""
        self.every_s, self.most = every_s, most
        self._last_lines: dict[str, tuple[float, int]] = {}  # time of the last line, and how many were suppressed since

    def due(self, key: str, now: float) -> int | None:
        """None: do not log this line. Else the number of lines of this key that were suppressed since the last one."""
        last = self._last_lines.get(key)
        if last is not None and now - last[0] < self.every_s:
            self._last_lines[key] = (last[0], last[1] + 1)
            return None
        if last is None and len(self._last_lines) >= self.most:
            self._last_lines = {key: last for key, last in self._last_lines.items() if now - last[0] < self.every_s}
            if len(self._last_lines) >= self.most:
                return None
        self._last_lines[key] = (now, 0)
        return last[1] if last is not None else 0


def suppressed_note(suppressed: int) -> str:
    """Text to append to a line: how many lines like it were suppressed."""
    return f" ({suppressed} more like this since the last line)" if suppressed else ""
