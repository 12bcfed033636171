"""The ledger: what became of every ticket, and of every transition that reached the learner. Plain counts.

    tickets       issued   = used + outstanding + lost
    transitions   received = used + waiting + duplicate + late + invalid

Both equations hold at every moment. `outstanding` tickets are with a worker, or their rollouts wait to be used (`waiting`).
"""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from millrace.protocol.bounds import LARGEST

Past = Annotated[int, Meta(ge=0, le=LARGEST >> 2)]
"""A count from a file that a run continues from: small enough that it still fits into messages later."""


class Ledger(msgspec.Struct, kw_only=True):
    """Counts since the run began; a checkpoint carries them."""

    issued: Past = 0
    used: Past = 0
    """tickets whose rollout an update used"""
    lost: Past = 0
    """tickets whose worker was lost, left or sent an unusable rollout (a new ticket was dealt), or whose update failed"""

    transitions_received: Past = 0
    transitions_used: Past = 0
    transitions_duplicate: Past = 0
    """transitions of rollouts that arrived a second time"""
    transitions_late: Past = 0
    """transitions of rollouts of a session that had ended, or of an update that failed"""
    transitions_invalid: Past = 0
    """transitions of rollouts that broke the row format or did not fit the run"""

    messages_bad: Past = 0
    """messages that could not be read"""
    late_actions: Past = 0
    """actions that arrived too late at a program that owns its loop, so that it chose its own action"""

    @property
    def outstanding(self) -> int:
        """Tickets that are neither used nor given up."""
        return self.issued - self.used - self.lost

    @property
    def transitions_waiting(self) -> int:
        """Transitions that have arrived and are neither used nor dropped."""
        dropped = self.transitions_duplicate + self.transitions_late + self.transitions_invalid
        return self.transitions_received - self.transitions_used - dropped

    def end_outstanding(self) -> None:
        """The learner that dealt the outstanding tickets is gone: count them, and rollouts not yet used, as lost.

        Raises `ValueError` for counts from a file that no run can have.
        """
        if min(self.outstanding, self.transitions_waiting) < 0:
            raise ValueError("ledger: expected at least as many tickets and transitions as were used or lost, got fewer")
        self.lost += self.outstanding
        self.transitions_late += self.transitions_waiting

    def copy(self) -> Ledger:
        """A copy that doesn't change with the original."""
        return msgspec.structs.replace(self)

    def counts(self) -> dict[str, int]:
        """All counts by name, including the two derived ones."""
        stored = {name: int(getattr(self, name)) for name in self.__struct_fields__}
        return stored | {"outstanding": self.outstanding, "transitions_waiting": self.transitions_waiting}
