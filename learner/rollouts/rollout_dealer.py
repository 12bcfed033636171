"""The tickets for rollouts: which rounds are open, which worker collects what, and what has arrived. Pure.

Rule: a ticket permits one rollout, of one lane, in one round, with one version of the weights. `lag_rule.py` says which
rounds are open, and each lane gets a ticket for each of them. If a ticket is lost, a new ticket is dealt for the same round,
with the same version, and the worker that gets it continues the lane where the lane's last rollout ended. Every ticket and
every transition is counted in the ledger.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from millrace.learner.members.member import Member, SentTicket
from millrace.learner.members.membership import Gone, Outgoing
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.lane_history import LaneHistories
from millrace.learner.rollouts.lanes import TakenRollouts, Ticket, TicketedLane
from millrace.learner.rollouts.ledger import Ledger
from millrace.learner.rollouts.opponent_pool import OpponentPool
from millrace.learner.rollouts.sent_weights import SentWeights
from millrace.protocol.arrays import Bools
from millrace.protocol.errors import BadRollout
from millrace.protocol.messages import Collect, LanePast, Permit, Received, Rollout


@dataclass(frozen=True, slots=True)
class AcceptedRollout:
    """A rollout that was accepted, with facts about it that its message doesn't contain."""

    rollout: Rollout
    incarnation: int
    """The incarnation of the lane when the ticket was dealt. Each incarnation has new env copies."""
    fresh: Bools | bool = True
    """[N] True for env copies that don't continue the previous rollout taken from the lane, because the copy has started
    afresh or a rollout in between was rejected. A single value applies to all copies.
    """
    from_past: bool = False
    """Whether the worker was told to continue the lane's past in this rollout."""


class RolloutDealer:
    """Deals tickets for rollouts, accepts rollouts, and keeps the records of lanes, rounds and the ledger."""

    def __init__(
        self,
        lanes: int,
        rounds: Rounds,
        ledger: Ledger | None = None,
        incarnations: Sequence[int] = (),
        opponents: OpponentPool | None = None,
        histories: LaneHistories | None = None,
    ) -> None:
        """`ledger` and `incarnations` (the first incarnation of each lane) are from a checkpoint.

        There may be more or fewer incarnations than lanes. `opponents` is the pool of a run with teams. If `histories` is
        None, no lane continues.
        """
        self.opponents = opponents
        self.histories = histories or LaneHistories()
        self.lanes = [
            TicketedLane(
                n,
                incarnations[n] if n < len(incarnations) else 0,
                taken=TakenRollouts(history=self.histories.of(n)),
            )
            for n in range(lanes)
        ]
        self.ledger = ledger or Ledger()
        self.held: dict[int, Ticket] = {}
        """the tickets that workers hold, by number"""
        self.ready: dict[int, dict[int, AcceptedRollout]] = {}
        """the rollouts that have arrived and were not taken, by round and by lane"""
        self.rounds = rounds
        self.weights = SentWeights()
        """the weights that act in open rounds, and all others that workers need"""
        self._first_round = rounds.next
        self._steps_before = self.ledger.transitions_used  # before the run was resumed
        self._absent = list(incarnations[lanes:])  # incarnations of lanes that the run had earlier, and may have again
        self._absent_pasts = [past for past in self.histories.pasts if past.lane >= lanes]
        self._to_deal = set[int]()  # lanes that lack a ticket for an open round

    # ---------------------------------------------------------------- the learner's side

    def begin_update(self, version: int) -> None:
        """Begin the next update, unless it has begun. `version` is the newest version. `deal` then deals the new rounds."""
        for number in self.rounds.begin(version):
            for lane in self.lanes:
                lane.due.append(number)
        self._to_deal |= {lane.number for lane in self.lanes if lane.due}

    def take(self) -> list[AcceptedRollout] | None:
        """Take the rollouts of the next update, in lane order. Returns None while some are missing."""
        if len(self.ready.get(self.rounds.next, ())) < len(self.lanes):
            return None
        taken = [rollout for _, rollout in sorted(self.ready.pop(self.rounds.next).items())]
        self.rounds.end()
        self.ledger.used += len(taken)
        self.ledger.transitions_used += sum(arrived.rollout.env_steps for arrived in taken)
        attributes = self._attributes_of(taken[0].rollout)  # made once, because the histories of all lanes refer to them
        return [self._marked(arrived, attributes) for arrived in taken]

    def not_used(self, taken: list[AcceptedRollout]) -> None:
        """Put back the rollouts that `take` returned last, because their update was undone.

        This restores the state before `take`: the rollouts wait again, and the next update uses their round.
        """
        self.rounds.reopen(taken[0].rollout.version)
        self.ready[self.rounds.next] = {arrived.rollout.lane: arrived for arrived in taken}
        for lane in self.lanes:
            lane.put_back()
        self.ledger.used -= len(taken)
        self.ledger.transitions_used -= sum(arrived.rollout.env_steps for arrived in taken)

    def awaited(self) -> list[Ticket]:
        """The tickets for the next update that workers hold."""
        return [ticket for ticket in self.held.values() if ticket.permit.round == self.rounds.next]

    def collected(self) -> int:
        """The env steps of the next update's rollouts that have arrived."""
        return sum(arrived.rollout.env_steps for arrived in self.ready.get(self.rounds.next, {}).values())

    def waiting(self) -> int:
        """The number of rollouts that have arrived and were not taken."""
        return sum(map(len, self.ready.values()))

    def incarnations(self) -> list[int]:
        """For a checkpoint, the next incarnation of each lane. An incarnation that got a ticket is never used again."""
        return [*(lane.incarnation + (lane.dealt > 0) for lane in self.lanes), *self._absent]

    def pasts(self) -> list[LanePast]:
        """For a checkpoint, the past from which each lane continues after the last round that was taken."""
        here = [lane.history.past(lane.number) for lane in self.lanes if lane.history is not None]
        return [*here, *self._absent_pasts]

    # ---------------------------------------------------------------- out

    def deal(self, members: Mapping[bytes, Member]) -> list[Outgoing]:
        """For each lane that has an owner, deal a ticket for every open round without one."""
        dealt: dict[bytes, list[int]] = {}
        for lane in [self.lanes[number] for number in sorted(self._to_deal)]:
            if lane.owner is None or lane.moving:
                continue
            if not lane.dealt and lane.due:
                self._drop_after(lane, lane.due[0])
            for round_number in lane.due:
                version = self.rounds.version(round_number)
                opponent = None if self.opponents is None else self.opponents.of(lane.number, round_number, version)
                continues = not lane.dealt and members[lane.owner].hello.continues
                past = self._past(lane, round_number) if continues else None
                number = self.ledger.issued
                self.held[number] = lane.deal(number, round_number, version, opponent, past)
                dealt.setdefault(lane.owner, []).append(number)
                self.ledger.issued += 1
            lane.due.clear()
            self._to_deal.remove(lane.number)
        return [order for peer, numbers in dealt.items() for order in self.send(members[peer], numbers)]

    def send(self, member: Member, tickets: Iterable[int]) -> list[Outgoing]:
        """Make the orders for the rollout tickets among these: one order for each version that the tickets name.

        A ticket that includes a lane's past gets its own order, because a past is long.
        """
        chosen = {number: self.held[number] for number in tickets if number in self.held}
        member.tickets |= {number: SentTicket(member.replies, ticket.versions) for number, ticket in chosen.items()}
        out: list[Outgoing] = []
        for version in sorted({ticket.version for ticket in chosen.values()}):
            of_version = [ticket.permit for ticket in chosen.values() if ticket.version == version]
            together = tuple(each for each in of_version if each.past is None)
            alone = [(each,) for each in of_version if each.past is not None]
            orders = [*alone, together] if together else alone
            received = self.received(member)
            out += [(member.peer, Collect(member.session, version, permits, received, keep=())) for permits in orders]
        return out

    def received(self, member: Member) -> tuple[Received, ...]:
        """The lanes of this worker, and which of their rollouts have arrived."""
        mine = [self.lanes[number] for number in member.lanes]
        return tuple(Received(lane.number, lane.incarnation, lane.next_sequence, tuple(lane.out_of_order)) for lane in mine)

    # ---------------------------------------------------------------- in

    def take_in(self, member: Member, rollout: Rollout) -> bool:
        """Accept a rollout that has arrived. Returns False if it had arrived before.

        Raises `BadRollout` if it doesn't fit its ticket; then call `reject`, which counts it.
        """
        ticket = self.held.get(rollout.ticket)
        if ticket is None:
            self.ledger.transitions_received += rollout.env_steps
            self.ledger.transitions_duplicate += rollout.env_steps
            return False
        permit = ticket.permit
        expected = ticket.peer, permit.lane, ticket.version, permit.sequence
        if (member.peer, rollout.lane, rollout.version, rollout.sequence) != expected:  # rule WRONG_ROLLOUT
            expects = f"lane {permit.lane}, version {ticket.version}, sequence {permit.sequence}"
            got = f"lane {rollout.lane}, version {rollout.version}, sequence {rollout.sequence}"
            raise BadRollout(f"numbers: expected {expects}, got {got}")
        self.ledger.transitions_received += rollout.env_steps
        self._end(member, permit).arrived(rollout.sequence)
        member.has_stepped()
        self.lanes[permit.lane].went_on()
        accepted = AcceptedRollout(rollout, permit.incarnation, from_past=permit.past is not None)
        self.ready.setdefault(permit.round, {})[permit.lane] = accepted
        return True

    def longest_episode(self, number: int, rollout_steps: int) -> int:
        """The largest number of steps that an episode can have by the end of this ticket's rollout of `rollout_steps`.

        Rollouts before a resume may have been longer, and only their total number of env steps is known.
        """
        ticket = self.held.get(number)
        last = self.rounds.next + self.rounds.max_lag if ticket is None else ticket.permit.round
        before = max(self._steps_before, self._first_round * rollout_steps)
        return before + (last + 1 - self._first_round) * rollout_steps

    def worker_lost(self, member: Member, gone: Gone) -> None:
        """Count the failures and losses of a lost member's lanes. Lanes that fail too often aren't replayed."""
        for number in member.lanes:
            lane = self.lanes[number]
            failed = number == gone.failed_lane or (gone.hung and lane.busy > 0)
            if failed or lane.busy:
                lane.lost(failed=failed)

    def late(self, rollout: Rollout) -> None:
        """Count a rollout from a session that has ended, without checking it."""
        self.ledger.transitions_received += rollout.env_steps
        self.ledger.transitions_late += rollout.env_steps

    def reject(self, member: Member, rollout: Rollout) -> None:
        """Count a rollout that can't be used. If this member holds its ticket, the ticket is lost."""
        number = rollout.ticket
        steps = rollout.env_steps if rollout.valid.dtype == bool else 0
        self.ledger.transitions_received += steps
        self.ledger.transitions_invalid += steps
        if number in self.held and number in member.tickets:
            permit = self.held[number].permit
            self.lanes[permit.lane].arrived(permit.sequence)  # so that the worker stops sending it
            self.lose(member, number)

    def lose(self, member: Member, number: int) -> None:
        """Record that this member's ticket is lost, so that a new ticket is dealt for its round."""
        permit = self.held[number].permit
        insort(self._end(member, permit).due, permit.round)
        self._to_deal.add(permit.lane)
        self.ledger.lost += 1

    # ---------------------------------------------------------------- inside

    def _end(self, member: Member, permit: Permit) -> TicketedLane:
        """Remove a ticket that has ended. Returns its lane."""
        del self.held[permit.ticket], member.tickets[permit.ticket]
        return self.lanes[permit.lane]

    def _past(self, lane: TicketedLane, first: int) -> LanePast | None:
        """The past that the lane's new owner continues. `first` is the first round that it collects."""
        come = [self.ready[number][lane.number] for number in range(self.rounds.next, first)]
        waiting = [(each.incarnation, each.rollout, self._attributes_of(each.rollout)) for each in come]
        return lane.past(self.histories, waiting)

    def _drop_after(self, lane: TicketedLane, first: int) -> None:
        """Drop the lane's rollouts after the lost round `first`, because they don't continue its replacement."""
        for number in [number for number in self.ready if number > first and lane.number in self.ready[number]]:
            dropped = self.ready[number].pop(lane.number)
            self.ledger.lost += 1
            self.ledger.transitions_late += dropped.rollout.env_steps
            insort(lane.due, number)

    def _attributes_of(self, rollout: Rollout) -> bytes:
        """The attributes, packed, that were set on the rollout's env copies."""
        attributes = self.weights.kept[rollout.version].env_attributes
        return b"" if attributes is None else attributes.tobytes()

    def _marked(self, arrived: AcceptedRollout, attributes: bytes) -> AcceptedRollout:
        """A rollout that the next update uses, with `fresh` set."""
        rollout = arrived.rollout
        fresh = self.lanes[rollout.lane].take(
            arrived.incarnation,
            rollout,
            attributes,
            self.histories,
            from_past=arrived.from_past,
        )
        return replace(arrived, fresh=fresh)
