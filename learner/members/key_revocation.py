"""Finds the members whose key was revoked. ZeroMQ checks a key only at the handshake, so the learner must check again."""

from __future__ import annotations

from collections.abc import Iterable

from millrace.protocol.keys.keys import ClientList
from millrace.protocol.wire.learner_link import LearnerLink


class KeyRevocation:
    """Checks the members' keys each time the list of allowed keys has changed."""

    def __init__(self, link: LearnerLink) -> None:
        self._link = link
        self._checked_against: ClientList | None = None

    def revoked(self, members: Iterable[bytes]) -> list[tuple[bytes, str]]:
        """The peers whose key was revoked, and why. Members are checked once against each list of allowed keys."""
        keyring = self._link.keyring
        if keyring is None or keyring.allowed is self._checked_against:
            return []
        self._checked_against = keyring.allowed  # noted before the check, because the list may be replaced during it
        return [(peer, why) for peer in members if (why := self._link.rejection_reason(peer))]
