"""A learner's link and its clock, neither of them real: waiting moves the clock."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from millrace.protocol.errors import BadMessage
from millrace.protocol.messages import ToLearner
from millrace.protocol.wire.codec import Buffer


class FakeLink:
    """Holds what workers have said until it is asked for; waiting takes time."""

    address = "fake"

    def __init__(self) -> None:
        self.keyring: object | None = None
        self.refused = 0
        self.now = 100.0
        self.packed_bytes_limit = 0
        self.sent: list[Sequence[Buffer]] = []
        self.inbox: list[tuple[bytes, ToLearner | BadMessage]] = []

    def poll(self, timeout_s: float) -> bool:
        if not self.inbox:
            self.now += timeout_s
        return bool(self.inbox)

    def receive(self) -> Iterator[tuple[bytes, ToLearner | BadMessage]]:
        while self.inbox:
            yield self.inbox.pop(0)

    def send(self, peer: bytes, frames: Sequence[Buffer]) -> bool:
        self.sent.append(frames)
        return True

    def name_for_log(self, peer: bytes) -> str:
        return peer.decode(errors="replace")

    def source(self, peer: bytes) -> str:
        return ""

    def rejection_reason(self, peer: bytes) -> str:
        return ""
