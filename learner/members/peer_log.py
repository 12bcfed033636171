"""What the learner's shells, of a run and of a vector environment, do alike: a lid on the lines that others cause, and keys
that were revoked.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable

from learner.members.events import Event, Told
from protocol.keys.keys import ClientList
from protocol.log_rate_limiter import LogRateLimiter, suppressed_note
from protocol.wire.learner_link import LearnerLink

log = logging.getLogger("millrace.learner")


class Lid:
    """On the log."""

    def __init__(self, link: LearnerLink, clock: Callable[[], float]) -> None:
        self._link, self._clock = link, clock
        self._rarely = LogRateLimiter()

    def complain(self, peer: bytes, line: str) -> None:
        """A line about what a peer sent, unless there was one a short while ago."""
        if (kept_back := self._rarely.due(self._link.speaker(peer), self._clock())) is not None:
            log.warning("%s%s", line, suppressed_note(kept_back))

    def tell(self, level: int, event: Event, line: str) -> None:
        """A line about what has happened.

        What was said while nobody listened comes all at once; so does a stranger's flood.
        """
        kept_back = self._rarely.due(f"told {event.worker}", self._clock()) if isinstance(event, Told) else 0
        if kept_back is not None:
            log.log(level, "%s%s", line, suppressed_note(kept_back), extra={"event": event})


class Doorkeeper:
    """Who was let in and may stay no more: ZeroMQ asks about a key at the handshake alone."""

    def __init__(self, link: LearnerLink) -> None:
        self._link = link
        self._judged_by: ClientList | None = None

    def shut_out(self, members: Iterable[bytes]) -> list[tuple[bytes, str]]:
        """Those whose key was revoked, and why. Everybody is looked at once for each state of the list, not each time."""
        keyring = self._link.keyring
        if keyring is None or keyring.allowed is self._judged_by:
            return []
        self._judged_by = keyring.allowed  # before anybody is judged: the list may be replaced meanwhile
        return [(peer, why) for peer in members if (why := self._link.why_not(peer))]
