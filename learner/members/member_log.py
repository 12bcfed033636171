"""A rate-limited log of what workers send and of what happens among them."""

from __future__ import annotations

import logging
from collections.abc import Callable

from learner.members.events import Event, RejoinRequested
from protocol.log_rate_limiter import LogRateLimiter, suppressed_note
from protocol.wire.learner_link import LearnerLink

log = logging.getLogger("millrace.learner")


class MemberLog:
    """Log lines that workers cause: few for each worker, however much it sends."""

    def __init__(self, link: LearnerLink, clock: Callable[[], float]) -> None:
        self._link, self._clock = link, clock
        self._limit = LogRateLimiter()

    def warn_limited(self, peer: bytes, line: str) -> None:
        """Warn about what a peer sent, unless there was a line about it a short while ago."""
        if (kept_back := self._limit.due(self._link.name_for_log(peer), self._clock())) is not None:
            log.warning("%s%s", line, suppressed_note(kept_back))

    def log_event(self, level: int, event: Event, line: str) -> None:
        """Log an event. Requests to join again are limited: after a restart of the learner they come in floods."""
        kept_back: int | None = 0
        if isinstance(event, RejoinRequested):
            kept_back = self._limit.due(f"told {event.worker}", self._clock())
        if kept_back is not None:
            log.log(level, "%s%s", line, suppressed_note(kept_back), extra={"event": event})
