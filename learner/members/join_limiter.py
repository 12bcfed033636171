"""Limits how many `Hello` messages are answered. Pure: `now` is an argument.

Rule: all workers with the same key may start at once, and after that join at a limited rate; workers without keys share one
limit. A `Hello` beyond the limit is not answered; an honest worker repeats it until it gets an answer. A peer that joins
again and again therefore costs the learner little time, and doesn't keep out workers with other keys.
"""

from __future__ import annotations

from millrace.protocol.token_bucket import TokenBucket

AT_ONCE = 10_000  # how many Hellos from workers with the same key are answered at once
PER_S = 100.0  # how many of these are answered per second after that


class JoinLimiter:
    """Decides which `Hello` messages are answered."""

    def __init__(self) -> None:
        self._buckets: dict[str, TokenBucket] = {}  # by the key's name, so there are only as many buckets as keys

    def admits(self, source: str, now: float) -> bool:
        """Whether to answer a `Hello` from this source: the name of the sender's key, or an empty string without keys."""
        bucket = self._buckets.setdefault(source, TokenBucket(AT_ONCE, PER_S))
        admitted = bucket.holds(1, now)
        if admitted:
            bucket.spend(1)
        return admitted
