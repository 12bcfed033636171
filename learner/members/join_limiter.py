"""Limits how many `Hello` messages are answered. Pure: `now` is an argument.

Rule: the workers of one key may all start at once, and after that join at a steady rate; workers without keys share one
limit. A `Hello` beyond the limit is not answered: an honest worker repeats it until it gets an answer. So a peer that joins
again and again costs the learner little, and does not keep the workers of another key out.
"""

from __future__ import annotations

from millrace.protocol.token_bucket import TokenBucket

AT_ONCE = 10_000  # Hellos of one key
PER_S = 100.0  # Hellos of one key


class JoinLimiter:
    """Decides which `Hello` messages are answered."""

    def __init__(self) -> None:
        self._buckets: dict[str, TokenBucket] = {}  # by the key's name: as many as there are keys

    def admits(self, source: str, now: float) -> bool:
        """Whether to answer a `Hello` of this source: the name of its key, or an empty text without keys."""
        bucket = self._buckets.setdefault(source, TokenBucket(AT_ONCE, PER_S))
        admitted = bucket.holds(1, now)
        if admitted:
            bucket.spend(1)
        return admitted
