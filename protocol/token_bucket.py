"""A token bucket: limits a rate, and allows a burst. Pure: `now` is an argument.

Rule: at most `most` tokens can be spent at once, and `per_s` more in each second after that.
"""

from __future__ import annotations


class TokenBucket:
    """A bucket that is full at first, and is refilled at a steady rate."""

    def __init__(self, most: float, per_s: float) -> None:
        self._most = most
        self._per_s = per_s
        self._tokens = most
        self._filled_s: float | None = None

    def holds(self, tokens: float, now: float) -> bool:
        """Whether this many tokens can be spent at `now`, in seconds of a clock that never goes back."""
        if self._filled_s is not None:
            self._tokens = min(self._most, self._tokens + (now - self._filled_s) * self._per_s)
        self._filled_s = now
        return self._tokens >= tokens

    def spend(self, tokens: float) -> None:
        """Spend this many tokens. Ask `holds` first."""
        self._tokens -= tokens
