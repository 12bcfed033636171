"""The ledger counts what became of every ticket, and of every transition that reached the learner.

    tickets       issued   = used + outstanding + lost
    transitions   received = used + waiting + duplicate + late + invalid

Both equations hold at every moment. An `outstanding` ticket is either held by a worker, or its rollout waits to be used. The
transitions of such a rollout are `waiting`.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from millrace.protocol.bounds import LARGEST

Past = Annotated[int, Meta(ge=0, le=LARGEST >> 2)]
"""A count that a resumed run reads from a file and continues. It is limited so that it still fits into messages later."""


class Ledger(msgspec.Struct, kw_only=True):
    """The counts since the run began. Checkpoints save them."""

    issued: Past = 0
    used: Past = 0
    """tickets whose rollout was used by an update"""
    lost: Past = 0
    """tickets whose worker was lost, left or sent an unusable rollout (a new ticket was dealt)"""

    transitions_received: Past = 0
    transitions_used: Past = 0
    transitions_duplicate: Past = 0
    """transitions of rollouts that arrived a second time"""
    transitions_late: Past = 0
    """transitions of rollouts from a session that had ended"""
    transitions_invalid: Past = 0
    """transitions of rollouts that broke the row format or did not fit the run"""

    messages_bad: Past = 0
    """messages that could not be read"""
    late_actions: Past = 0
    """actions that reached a program with its own loop too late, so it chose an action itself"""

    @property
    def outstanding(self) -> int:
        """Tickets that are neither used nor lost."""
        return self.issued - self.used - self.lost

    @property
    def transitions_waiting(self) -> int:
        """Transitions that have arrived and are neither used nor dropped."""
        dropped = self.transitions_duplicate + self.transitions_late + self.transitions_invalid
        return self.transitions_received - self.transitions_used - dropped

    def end_outstanding(self) -> None:
        """Count the outstanding tickets, and rollouts not yet used, as lost, because the learner that dealt them is gone.

        Raises `ValueError` for impossible counts from a file.
        """
        if min(self.outstanding, self.transitions_waiting) < 0:
            raise ValueError("ledger: expected at least as many tickets and transitions as were used or lost, got fewer")
        self.lost += self.outstanding
        self.transitions_late += self.transitions_waiting

    def copy(self) -> Ledger:
        """An independent copy."""
        return msgspec.structs.replace(self)

    def counts(self) -> dict[str, int]:
        """All counts by name, including the two that are derived from others."""
        stored = {name: int(getattr(self, name)) for name in self.__struct_fields__}
        return stored | {"outstanding": self.outstanding, "transitions_waiting": self.transitions_waiting}
