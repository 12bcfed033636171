"""Limits what peers can write to the log: how often a line is repeated, and how much each source may log. Pure.

Rule: a peer can neither flood the log with many or long lines, nor make the tables in this file grow without limit.
"""

from __future__ import annotations

from dataclasses import dataclass

from millrace.protocol.token_bucket import TokenBucket


class LogRateLimiter:
    """Decides whether a line may be logged now."""

    def __init__(self, every_s: float = 60.0, most: int = 20) -> None:
        """Allow one line for each key in `every_s` seconds, for at most `most` keys in that time."""
        self.every_s = every_s
        self.most = most
        self._last_lines: dict[str, tuple[float, int]] = {}  # per key: time of the last line, and lines suppressed since

    def due(self, key: str, now: float) -> int | None:
        """Ask whether to log a line with this key now.

        Returns None if not; else the number of lines with this key that were suppressed since the last one.
        """
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


@dataclass(frozen=True)
class Allowance:
    """How much one source may log: `lines` and `bytes` at once, and `lines_per_s` and `bytes_per_s` in each second after
    that.
    """

    lines: int
    lines_per_s: float
    bytes: int
    bytes_per_s: float


class LogBudget:
    """What one source may still log, in lines and in bytes."""

    def __init__(self, allowance: Allowance) -> None:
        self._lines = TokenBucket(allowance.lines, allowance.lines_per_s)
        self._bytes = TokenBucket(allowance.bytes, allowance.bytes_per_s)
        self._suppressed = 0

    def covers(self, size: int, now: float) -> bool:
        """Whether a line of `size` bytes may be logged now."""
        covered = [self._lines.holds(1, now), self._bytes.holds(size, now)]
        return all(covered)

    def spend(self, size: int) -> int:
        """Count a logged line of this size. Returns the number of lines that were suppressed since the last one."""
        self._lines.spend(1)
        self._bytes.spend(size)
        suppressed = self._suppressed
        self._suppressed = 0
        return suppressed

    def suppress(self) -> None:
        """Count a line that was not logged."""
        self._suppressed += 1


def suppressed_note(suppressed: int) -> str:
    """Text to append to a line: how many lines like it were suppressed."""
    return f" ({suppressed} more like this since the last line)" if suppressed else ""
