"""The coordinator's records of lanes and tickets. Pure.

Rule: a lane has one owner at a time. A new owner has new env copies for it, so the incarnation rises, and rollouts are
counted from 0 again. The new owner continues the lane's past, unless the environment has failed or `MOST_ATTEMPTS` workers
were lost since the lane's last rollout arrived. In these cases the copies start afresh, so that they don't fail in the same
way forever.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from millrace.learner.members.lane_placement import PlacedLane
from millrace.learner.rollouts.lane_history import LaneHistories, LaneHistory
from millrace.protocol.arrays import Bools
from millrace.protocol.messages import LanePast, Permit, versions_of
from millrace.protocol.rollout import Rollout

MOST_ATTEMPTS = 3  # copies start afresh once this many attempts to continue their lane have each lost a worker


@dataclass(frozen=True)
class TakenRollouts:
    """What the learner remembers of a lane's rollouts: a fold over them, in the order of their rounds. Never changed."""

    newest: tuple[int, int] | None = None
    """Incarnation and sequence number of the newest rollout; None if none was taken since the learner began."""
    history: LaneHistory | None = None
    """History of the rollouts; None if none was taken since the run began. Copy it before you change it."""

    def after(
        self, incarnation: int, rollout: Rollout, attributes: bytes, histories: LaneHistories
    ) -> tuple[TakenRollouts, Bools]:
        """These rollouts and the next one. Also returns [N], True for env copies that had started afresh when it began."""
        history = histories.begin() if self.history is None else self.history.copy()
        misses_one = rollout.sequence > 0 and self.newest != (incarnation, rollout.sequence - 1)
        if misses_one:  # the rollout between was rejected, so nothing is known to continue
            history.forget()
        anew = history.add(rollout, attributes)
        taken = TakenRollouts((incarnation, rollout.sequence), history)
        return taken, np.ones_like(anew) if misses_one else anew


@dataclass
class TicketedLane(PlacedLane):
    """A lane on which workers collect rollouts."""

    due: list[int] = field(default_factory=list)
    """Open rounds without a ticket, in order."""
    dealt: int = 0
    """The number of tickets that were dealt to this incarnation, which is the sequence number of the next rollout."""
    next_sequence: int = 0
    """The smallest sequence number of this incarnation whose rollout has not arrived."""
    out_of_order: set[int] = field(default_factory=set)
    """Larger sequence numbers whose rollouts have arrived."""
    taken: TakenRollouts = TakenRollouts()
    """The rollouts that updates took."""
    before: TakenRollouts = TakenRollouts()
    """`taken` without the newest rollout, in case its update is undone."""
    failures: int = 0
    """How many times its environment has failed since its last rollout arrived."""
    continued_in_vain: bool = False
    """Whether, since the lane's last rollout arrived, a worker was lost in an attempt to continue the lane. In this attempt,
    copies that couldn't be continued have used the next start number.
    """
    losses: int = 0
    """How many times its worker was lost while collecting, since its last rollout arrived."""

    @property
    def history(self) -> LaneHistory | None:
        """History of the rollouts that were taken; None if none was taken since the run began."""
        return self.taken.history

    @property
    def busy(self) -> int:
        """The number of the lane's tickets that its worker holds.

        All others that were dealt to this incarnation have ended, each with a rollout that was accepted or rejected, because
        the loss of the worker ends the incarnation.
        """
        return self.dealt - self.next_sequence - len(self.out_of_order)

    def restart(self) -> None:
        """Record that the lane left its worker. The incarnation rises only if a ticket was dealt to it."""
        super().restart()
        if self.dealt:
            self.incarnation += 1
            self.dealt = 0
            self.next_sequence = 0
            self.out_of_order = set()

    def deal(
        self, number: int, round_number: int, version: int, opponent: int | None, past: LanePast | None = None
    ) -> Ticket:
        """Make a ticket for the next rollout, for the lane's owner. `past` goes with the first ticket of an incarnation."""
        assert self.owner is not None
        permit = Permit(number, self.number, self.incarnation, self.dealt, round_number, opponent, past)
        self.dealt += 1
        return Ticket(permit, version, self.owner)

    def past(self, histories: LaneHistories, waiting: Iterable[tuple[int, Rollout, bytes]]) -> LanePast | None:
        """The past that a new owner continues; None if the lane has not begun.

        `waiting` has the rollouts that follow the history, in order. Each entry consists of the incarnation, the rollout,
        and the attributes of the env copies.
        """
        taken = self.taken
        for incarnation, rollout, attributes in waiting:
            taken, _ = taken.after(incarnation, rollout, attributes, histories)
        history = taken.history
        if attempts := self._attempts:
            history = histories.begin() if history is None else history.copy()
            history.start_anew(attempts, from_past=self.continued_in_vain)
        return None if history is None else history.past(self.number)

    def take(
        self, incarnation: int, rollout: Rollout, attributes: bytes, histories: LaneHistories, *, from_past: bool
    ) -> Bools:
        """Take the rollout of the next round. Returns [N], True for env copies that don't continue the previous rollout.

        `from_past` says whether the rollout's worker was told to continue the lane's past.
        """
        self.before = self.taken
        self.taken, anew = self.taken.after(incarnation, rollout, attributes, histories)
        begins = rollout.sequence == 0 and not (from_past and rollout.memory)
        return np.ones_like(anew) if begins else anew

    def put_back(self) -> None:
        """Undo the newest `take`."""
        self.taken = self.before

    def lost(self, *, failed: bool) -> None:
        """Record that the lane's worker was lost while collecting or, if `failed`, because its environment failed."""
        if not self._attempts and not self.next_sequence:
            self.continued_in_vain = True
        self.losses += not failed
        self.failures += failed

    def went_on(self) -> None:
        """Forget failures and losses, because a rollout was accepted."""
        self.failures = 0
        self.losses = 0
        self.continued_in_vain = False

    @property
    def _attempts(self) -> int:
        """The number of lost attempts because of which copies start afresh; 0 as long as a new owner continues the lane."""
        return self.failures + self.losses // MOST_ATTEMPTS

    def arrived(self, sequence: int) -> None:
        """Record that the rollout with this sequence number has arrived."""
        self.out_of_order.add(sequence)
        while self.next_sequence in self.out_of_order:
            self.out_of_order.remove(self.next_sequence)
            self.next_sequence += 1


@dataclass(frozen=True)
class Ticket:
    """A ticket that a worker holds."""

    permit: Permit
    """The ticket in the form that is sent."""
    version: int
    """Version of the weights that act."""
    peer: bytes

    @property
    def versions(self) -> set[int]:
        """The versions of all weights that its rollout needs."""
        return versions_of(self.version, [self.permit.opponent])
