"""The learner's half of the conversation. Pure: messages and `now` in, messages out; no socket, clock, thread or torch.

Rule: a ticket is the permission for one rollout: of this lane, in this round, under this version. `rounds.py` says which
rounds are open, and each lane gets a ticket for every one of them. A lane has one owner at a time and moves only between
rollouts. Its new owner starts it afresh: its incarnation rises. When a worker is lost, its lanes go to other workers, and
the rounds of its tickets are dealt again. There is no other failure handling. Weights are sent to a worker after the first
order that names them. If a Heartbeat shows that a message was lost on the way, the message is sent again. Every ticket and
every transition is counted in the ledger.

An evaluation is of the newest version: while it is pending, no ticket for a rollout is dealt, and no weights are published.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import msgspec

from learner.members.coordinator import Coordinator
from learner.members.events import Failed, PolicyRaised
from learner.members.lane_placement import LanePlacement, is_spare
from learner.members.membership import Member, Membership, Outgoing
from learner.members.states import SentUnusable
from learner.rollouts.evaluation_tickets import EvaluationPlan, EvaluationTickets, OnRows, PlayedEpisode
from learner.rollouts.lanes import AcceptedRollout, Ticket, TicketedLane
from learner.rollouts.ledger import Ledger
from learner.rollouts.rounds import Rounds
from protocol.messages import (
    Array,
    Collect,
    EpisodeRows,
    Evaluate,
    Evaluated,
    Failure,
    Heartbeat,
    Permit,
    Received,
    Rejoin,
    Rollout,
    ToLearner,
    Weights,
    WorkerStatus,
)
from protocol.specs import RunSpec

STRIKES = 3  # rollouts or messages that could not be used, after which a worker is refused


@dataclass
class CollectingMember(Member):
    """A worker as the learner of a run sees it."""

    versions: dict[int, int] = field(default_factory=dict)
    """Versions that were sent to the worker, unless it is known to lack them; for each, `replies` when it was sent last."""
    strikes: int = 0
    """Number of the worker's rollouts and messages that could not be used."""

    def status(self, now: float) -> WorkerStatus:
        """The worker's row of `millrace status`."""
        held = () if self.heartbeat is None else self.heartbeat.versions
        return msgspec.structs.replace(super().status(now), version=max(held, default=-1), strikes=self.strikes)


class TicketCoordinator(Coordinator[CollectingMember]):
    """Members, lanes, tickets and the ledger.

    A rollout that `receive` is given must have passed `protocol.rollout.validate`; else call `reject_rollout`.
    """

    def __init__(
        self,
        run: RunSpec,
        *,
        max_lag: int,
        worker_timeout_s: float,
        first_session: int,
        ledger: Ledger | None = None,
        incarnations: Sequence[int] = (),
    ) -> None:
        """`ledger` and `incarnations` come from a checkpoint.

        `incarnations`: the first of each lane; there may be more or fewer of them than lanes.
        """
        membership = Membership(
            run, CollectingMember, self._removed, first_session, lambda member: is_spare(member, self.lanes)
        )
        super().__init__(membership, worker_timeout_s)
        self.run = run
        self.ledger = ledger or Ledger()
        self.version = -1  # until `publish`
        self.lanes = [TicketedLane(n, incarnations[n] if n < len(incarnations) else 0) for n in range(run.lanes)]
        self._absent = list(incarnations[run.lanes :])  # incarnations of lanes that the run had, and may have again
        self.tickets: dict[int, Ticket] = {}
        self.ready: dict[int, dict[int, AcceptedRollout]] = {}
        """the rollouts that have come and were not taken, by round and by lane"""
        self.evaluation = EvaluationTickets(run.policy, len(run.facts))
        self.max_env_copies = 0
        """most env copies on all workers, with those of evaluations; 0: no limit"""
        self._placement = LanePlacement(self.lanes, _by_joining)
        self._rounds = Rounds(max_lag)
        self._to_deal = set[int]()  # lanes with rounds that are to be dealt
        self._weights: dict[int, Weights] = {}  # by version: the newest, and those that act in open rounds

    # ---------------------------------------------------------------- in

    def reject_message(self, peer: bytes, why: str, now: float) -> list[Outgoing]:
        """Count a message that could not be read, and answer it."""
        self.ledger.messages_bad += 1
        return super().reject_message(peer, why, now)

    def reject_rollout(self, peer: bytes, rollout: Rollout, why: str, now: float) -> list[Outgoing]:
        """Count a rollout that cannot be used. Its ticket is lost."""
        member = self.members.get(peer)
        steps = int(rollout.valid.sum()) if rollout.valid.dtype == bool else 0
        self.ledger.transitions_received += steps
        self.ledger.transitions_invalid += steps
        if member is None or member.session != rollout.session:
            return [(peer, Rejoin(rollout.session))]
        member.heard_s = now
        out = self._unusable(member, why)
        if rollout.ticket in member.tickets:
            ticket = self.tickets[rollout.ticket]
            self.lanes[ticket.lane].arrived(ticket.sequence)  # so that its worker drops it
            self._lose(member, rollout.ticket)
        return out + self._deal()

    def refuse(self, member: CollectingMember, why: str) -> list[Outgoing]:
        """Refuse a worker that holds tickets and does nothing with them: they are dealt again."""
        return self.membership.refuse(member, SentUnusable, why) + self._deal()

    # ---------------------------------------------------------------- the learner's side

    def publish(self, version: int, parameters: Array, buffers: Array, *, env_attributes: Array | None = None) -> None:
        """Set the newest weights. Orders name them from now on: call `begin_update`, or `begin_evaluation`."""
        assert not self.evaluation.pending, "an evaluation is pending"
        self.version = version
        self._weights[version] = Weights(version, parameters, buffers, env_attributes)
        self._weights = {v: each for v, each in self._weights.items() if v == version or self._rounds.acts(v)}

    def begin_update(self) -> list[Outgoing]:
        """The next update begins, unless it has begun, with the newest weights: deal the rounds that it opens."""
        for number in self._rounds.begin(self.version):
            for lane in self.lanes:
                lane.due.append(number)
        self._to_deal |= {lane.number for lane in self.lanes if lane.due}
        return self._deal()

    def take(self) -> list[AcceptedRollout] | None:
        """The rollouts of the next update, in lane order, or None while there are too few."""
        if len(self.ready.get(self._rounds.next, ())) < len(self.lanes):
            return None
        taken = [rollout for _, rollout in sorted(self.ready.pop(self._rounds.next).items())]
        self._rounds.end()
        self.ledger.used += len(taken)
        self.ledger.transitions_used += sum(arrived.rollout.env_steps for arrived in taken)
        return [self._marked(arrived) for arrived in taken]

    def not_used(self, taken: list[AcceptedRollout]) -> None:
        """Count rollouts that `take` returned as lost: no update was made of them."""
        self.ledger.used -= len(taken)
        self.ledger.lost += len(taken)
        env_steps = sum(arrived.rollout.env_steps for arrived in taken)
        self.ledger.transitions_used -= env_steps
        self.ledger.transitions_late += env_steps

    def begin_evaluation(self, plan: EvaluationPlan, on_rows: OnRows | None = None) -> list[Outgoing]:
        """Begin to evaluate the newest weights. `self.evaluation` says when it is done."""
        self.evaluation.begin(plan, self.version, on_rows)
        return self._deal()

    def end_evaluation(self) -> list[PlayedEpisode]:
        """End the evaluation, also one that is not done. Returns its episodes, in the order of their seeds."""
        return self.evaluation.end()

    def awaited(self) -> list[Ticket]:
        """The outstanding tickets of the next update."""
        return [ticket for ticket in self.tickets.values() if ticket.round == self._rounds.next]

    def rollouts_waiting(self) -> int:
        """Number of rollouts that have come and were not taken."""
        return sum(map(len, self.ready.values()))

    def incarnations(self) -> list[int]:
        """The next incarnation of each lane, for a checkpoint. One that was dealt a ticket is not used again."""
        return [*(lane.incarnation + (lane.dealt > 0) for lane in self.lanes), *self._absent]

    # ---------------------------------------------------------------- inside

    def _marked(self, arrived: AcceptedRollout) -> AcceptedRollout:
        """The rollout, which an update uses next, marked as fresh or not."""
        lane = self.lanes[arrived.rollout.lane]
        return replace(arrived, fresh=not lane.use(arrived.incarnation, arrived.rollout.sequence))

    def _joined(self) -> list[Outgoing]:
        self._placement.joined()
        return self._deal()

    def _unusable(self, member: CollectingMember, why: str) -> list[Outgoing]:
        """Count what could not be used; after too much of it the worker is refused."""
        member.strikes += 1
        return super()._unusable(member, why) if member.strikes >= STRIKES else []

    def _kind(self, failure: Failure) -> type[Failed]:
        # No worker can blame a policy that is not the user's.
        return PolicyRaised if failure.of_policy and self.run.policy.own is not None else super()._kind(failure)

    def _late(self, message: ToLearner) -> None:
        if isinstance(message, Rollout):
            self.ledger.transitions_received += message.env_steps
            self.ledger.transitions_late += message.env_steps

    def _answer(self, member: CollectingMember, message: ToLearner) -> list[Outgoing]:
        match message:
            case Rollout():
                return self._rollout(member, message)
            case Evaluated():
                why = self.evaluation.take(member, message)
            case EpisodeRows():
                why = self.evaluation.take_rows(member, message)
            case _:
                return []  # answers to orders that a run does not give
        return (self._unusable(member, why) if why else []) + self._deal()

    def _rollout(self, member: CollectingMember, rollout: Rollout) -> list[Outgoing]:
        ticket = self.tickets.get(rollout.ticket)
        if ticket is None:
            self.ledger.transitions_received += rollout.env_steps
            self.ledger.transitions_duplicate += rollout.env_steps
            return []
        expected = ticket.peer, ticket.lane, ticket.version, ticket.sequence
        if (member.peer, rollout.lane, rollout.version, rollout.sequence) != expected:
            expects = f"lane {ticket.lane}, version {ticket.version}, sequence {ticket.sequence}"
            got = f"lane {rollout.lane}, version {rollout.version}, sequence {rollout.sequence}"
            why = f"ticket {ticket.number}: expected {expects}, got {got}"
            return self.reject_rollout(member.peer, rollout, why, member.heard_s)
        self.ledger.transitions_received += rollout.env_steps
        del self.tickets[ticket.number], member.tickets[ticket.number]
        lane = self.lanes[ticket.lane]
        lane.outstanding.remove(ticket.number)
        lane.arrived(rollout.sequence)
        self._placement.ticket_ended(member)
        member.stepped = True
        self.ready.setdefault(ticket.round, {})[lane.number] = AcceptedRollout(rollout, ticket.incarnation)
        return self._deal()

    def _heartbeat(self, member: CollectingMember, heartbeat: Heartbeat) -> list[Outgoing]:
        self.ledger.late_actions += member.new_late_actions(heartbeat)
        return super()._heartbeat(member, heartbeat)

    def _again(self, member: CollectingMember, heartbeat: Heartbeat, lost: Sequence[int]) -> list[Outgoing]:
        out = self._lost_weights(member, heartbeat)
        return out + self._with_weights(self._collect(member, lost) + self.evaluation.send_again(member, heartbeat))

    def _lost_weights(self, member: CollectingMember, heartbeat: Heartbeat) -> list[Outgoing]:
        """The weights that this worker's tickets name and that were lost on the way, as its heartbeat shows."""
        sent = member.versions.items()
        # What it does not list was dropped or lost, unless it may still be on its way.
        held = {version: at for version, at in sent if version in heartbeat.versions or at >= heartbeat.replies}
        named = {self.tickets[number].version for number in heartbeat.tickets if number in member.tickets}
        if member.peer in self.evaluation.holders:
            named.add(self.version)
        lost = sorted(named - held.keys())
        member.versions = held | dict.fromkeys(lost, member.replies)
        return [(member.peer, self._weights[version]) for version in lost]

    def _with_weights(self, orders: list[Outgoing]) -> list[Outgoing]:
        """These messages; after each order that names a version that its worker does not hold, these weights."""
        out: list[Outgoing] = []
        for peer, message in orders:
            out.append((peer, message))
            member = self.members[peer]
            if isinstance(message, Collect | Evaluate) and message.version not in member.versions:
                out.append((peer, self._weights[message.version]))
                needed = {version: sent_at for version, sent_at in member.versions.items() if version in self._weights}
                member.versions = needed | {message.version: member.replies}
        return out

    def _received(self, member: CollectingMember) -> tuple[Received, ...]:
        mine = [self.lanes[number] for number in member.lanes]
        return tuple(Received(lane.number, lane.incarnation, lane.next_sequence, tuple(lane.out_of_order)) for lane in mine)

    def _collect(self, member: CollectingMember, tickets: Sequence[int]) -> list[Outgoing]:
        """Collect messages for these outstanding tickets: one for each version that they name."""
        out: list[Outgoing] = []
        for version in sorted({self.tickets[number].version for number in tickets}):
            chosen = [self.tickets[number] for number in tickets if self.tickets[number].version == version]
            permits = tuple(Permit(each.number, each.lane, each.incarnation, each.sequence) for each in chosen)
            member.tickets |= {ticket.number: member.replies for ticket in chosen}
            out.append((member.peer, Collect(member.session, version, permits, self._received(member))))
        return out

    def _removed(self, member: CollectingMember, why: str) -> None:
        """The worker is gone: its tickets are lost, its lanes have no owner. `_deal` gives both to other workers."""
        for number in list(member.tickets):
            self._lose(member, number)
        self.evaluation.removed(member.peer)
        self._placement.removed(member)

    def _lose(self, member: CollectingMember, number: int) -> None:
        ticket = self.tickets.pop(number)
        del member.tickets[number]
        lane = self.lanes[ticket.lane]
        lane.outstanding.remove(number)
        insort(lane.due, ticket.round)
        self._to_deal.add(lane.number)
        self._placement.ticket_ended(member)
        self.ledger.lost += 1

    def _deal(self) -> list[Outgoing]:
        """Give lanes without an owner to workers, balance the lanes, and deal the tickets of open rounds."""
        if not self._weights or self.membership.draining is not None or not self.members:
            return []
        out = self._placement.place(self.members.values())
        if self.evaluation.pending:
            return self._with_weights(out + self.evaluation.deal(self._evaluators()))
        dealt: dict[bytes, list[int]] = {}
        for lane in [self.lanes[number] for number in sorted(self._to_deal)]:
            if lane.owner is None or lane.moving:
                continue
            for round_number in lane.due:
                ticket = lane.deal(self.ledger.issued, round_number, self._rounds.version(round_number))
                self.tickets[ticket.number] = ticket
                dealt.setdefault(lane.owner, []).append(ticket.number)
                self.ledger.issued += 1
            lane.due.clear()
            self._to_deal.remove(lane.number)
        for peer, numbers in dealt.items():
            out += self._collect(self.members[peer], numbers)
        return self._with_weights(out)

    def _evaluators(self) -> list[CollectingMember]:
        """Those who may play evaluations: with a limit of copies, the first to join, because a worker keeps its copies."""
        active, plan = self.membership.active(), self.evaluation.plan
        if not self.max_env_copies or plan is None:
            return active
        free = self.max_env_copies - self.run.lanes * self.run.copies
        return active[: max(1, free // min(plan.copies, len(plan.seeds)))]


def _by_joining(member: Member) -> int:
    """Sort key: the next lane goes to the worker with the fewest lanes; in a tie, to the one that joined first."""
    return member.join_number
