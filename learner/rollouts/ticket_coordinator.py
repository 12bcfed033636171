"""The learner's half of the conversation. Pure: messages and `now` in, messages out; no socket, clock, thread or torch.

Rule: a ticket is the permission for one rollout on one lane, and is dealt to the least advanced lane while

    used + outstanding < rollouts_per_update * (version + 1 + max_lag)

`used` and `version` are counted from the first version that this learner publishes, because a resumed run may have other
lanes. A lane has one owner at a time and moves only between rollouts. Its new owner starts it afresh: its incarnation rises.
When a worker is lost, its lanes go to other workers, and new tickets are dealt in place of its tickets. There is no other
failure handling. If a Heartbeat shows that a message was lost on the way, the message is sent again. Every ticket and every
transition is counted in the ledger.

An evaluation belongs to one version: while it is pending, no ticket for a rollout is dealt, and no weights are published.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec

from learner.members.events import EnvironmentRaised, Event, PolicyRaised, RolloutDropped
from learner.members.lane_placement import LanePlacement, is_spare
from learner.members.membership import Member, Membership, Outgoing
from learner.members.states import MemberState, SentUnusable
from learner.rollouts.evaluation_tickets import EvaluationPlan, EvaluationTickets, OnRows, PlayedEpisode
from learner.rollouts.lanes import AcceptedRollout, LaneQueue, Ticket, TicketedLane
from learner.rollouts.ledger import Ledger
from protocol.bounds import one_line
from protocol.messages import (
    Alive,
    Array,
    Collect,
    Described,
    Drain,
    EpisodeRows,
    Evaluated,
    Failure,
    Goodbye,
    Heartbeat,
    HeartbeatReply,
    Hello,
    Permit,
    Received,
    Refuse,
    Rejoin,
    Returned,
    Rollout,
    Stepped,
    ToLearner,
    Weights,
    WorkerExit,
    WorkerStatus,
)
from protocol.specs import RunSpec

STRIKES = 3  # rollouts or messages that could not be used, after which a worker is refused


@dataclass
class CollectingMember(Member):
    """A worker as the learner of a run sees it."""

    acknowledged: int = -1
    """Newest version that the worker is known to have."""
    sending: int | None = None
    """Version of the weights that were sent and are not acknowledged."""
    sending_since: int = 0
    """Value of `replies` when those weights were sent."""
    strikes: int = 0
    """Number of the worker's rollouts and messages that could not be used."""

    def status(self, now: float) -> WorkerStatus:
        """The worker's row of `millrace status`."""
        return msgspec.structs.replace(super().status(now), version=self.acknowledged, strikes=self.strikes)


class TicketCoordinator:
    """Members, lanes, tickets and the ledger."""

    def __init__(
        self,
        run: RunSpec,
        *,
        rollouts_per_update: int,
        max_lag: int,
        worker_timeout_s: float,
        first_session: int,
        ledger: Ledger | None = None,
        version: int = -1,
        incarnations: Sequence[int] = (),
    ) -> None:
        """`version` is -1 until `publish`. `ledger` and `incarnations` come from a checkpoint.

        `incarnations`: the first of each lane; there may be more or fewer of them than lanes.
        """
        self.run = run
        self.rollouts_per_update = rollouts_per_update
        self.max_lag = max_lag
        self.ledger = ledger or Ledger()
        self.version = version
        self.worker_timeout_s = worker_timeout_s
        self.membership: Membership[CollectingMember] = Membership(
            run, CollectingMember, self._removed, first_session, lambda member: is_spare(member, self.lanes)
        )
        self.lanes = [TicketedLane(n, incarnations[n] if n < len(incarnations) else 0) for n in range(run.lanes)]
        self._absent = list(incarnations[run.lanes :])  # incarnations of lanes that the run had, and may have again
        self.tickets: dict[int, Ticket] = {}
        self.ready: list[AcceptedRollout] = []
        self.evaluation = EvaluationTickets(run.policy, len(run.facts))
        self.max_env_copies = 0
        """most env copies on all workers, with those of evaluations; 0: no limit"""
        self._held_back = False  # whether to deal no ticket for a rollout, because an evaluation is about to begin
        self._placement, self._queue = LanePlacement(self.lanes, _by_joining), LaneQueue(self.lanes)
        self._oldest_ready = version  # no rollout that is ready is older
        self._weights: Weights | None = None
        self._first_version, self._used_before = 0, 0  # the first version published, and the tickets used before it

    @property
    def members(self) -> dict[bytes, CollectingMember]:
        """Members by routing id."""
        return self.membership.members

    @property
    def events(self) -> list[Event]:
        """Events that were not logged yet."""
        return self.membership.events

    # ---------------------------------------------------------------- in

    def receive(self, peer: bytes, message: ToLearner, now: float) -> list[Outgoing]:
        """Answer a message. A rollout must have passed `protocol.rollout.validate`; else call `reject_rollout`."""
        if isinstance(message, Hello):
            return self._join(peer, message, now)
        if isinstance(message, Alive):
            answer, removed = self.membership.hear_supervisor(peer, message, now)
            return [*answer, *(self._deal() if removed else [])]
        if isinstance(message, Rollout):
            self.ledger.transitions_received += message.env_steps
        member = self.membership.member_of_session(peer, message, now)
        if member is None:
            if isinstance(message, Rollout):
                self.ledger.transitions_late += message.env_steps
            return self.membership.answer_ended_session(peer, message)
        match message:
            case Rollout():
                return self._rollout(member, message)
            case Heartbeat():
                return self._heartbeat(member, message)
            case Evaluated():
                return self._checked(member, self.evaluation.take(member, message), now)
            case EpisodeRows():
                return self._checked(member, self.evaluation.take_rows(member, message), now)
            case Stepped() | Returned() | Described():
                return []  # answers to orders that a run does not give
            case Goodbye(_, reason):
                self.membership.remove(member, Goodbye, f"left: {reason}")
                return self._deal()
            case Failure(_, error, traceback, lane, of_policy):
                # No worker can blame a policy that is not the user's.
                kind = PolicyRaised if of_policy and self.run.policy.own is not None else EnvironmentRaised
                spare = is_spare(member, self.lanes)
                self.events.append(member.failed(kind, error, traceback, lane=lane, spare=spare))
                self.membership.remove(member, Failure, "failed")
                return self._deal()

    def reject_message(self, peer: bytes, why: str, now: float) -> list[Outgoing]:
        """Count a message that could not be read, and answer it."""
        self.ledger.messages_bad += 1
        member = self.members.get(peer)
        if member is None:
            return [(peer, Refuse(one_line(f"not understood: {why}")))]
        return self._strike(member, why, now) + self._deal()

    def reject_rollout(self, peer: bytes, rollout: Rollout, why: str, now: float) -> list[Outgoing]:
        """Count a rollout that cannot be used. Its ticket is lost."""
        member = self.members.get(peer)
        steps = int(rollout.valid.sum()) if rollout.valid.dtype == bool else 0
        self.ledger.transitions_received += steps
        self.ledger.transitions_invalid += steps
        if member is None or member.session != rollout.session:
            return [(peer, Rejoin(rollout.session))]
        out = self._strike(member, why, now)
        if rollout.ticket in member.tickets:
            lane = self.lanes[self.tickets[rollout.ticket].lane]
            if lane.expects(rollout.sequence):
                lane.arrived(rollout.sequence)
            self._lose(member, rollout.ticket)
        return out + self._deal()

    def remove_worker(self, worker: str, why: str) -> list[Outgoing]:
        """A worker's process is known to be dead: do not wait for its silence."""
        return self._deal() if self.membership.remove_worker(worker, why) else []

    def refuse(self, member: CollectingMember, why: str) -> list[Outgoing]:
        """Refuse a worker that holds tickets and does nothing with them: they are dealt again."""
        return self.membership.refuse(member, SentUnusable, why) + self._deal()

    def process_ended(self, worker_exit: WorkerExit) -> list[Outgoing]:
        """A process of this program has ended."""
        return self._deal() if self.membership.record_exit(worker_exit) else []

    def revoke(self, peer: bytes, why: str) -> list[Outgoing]:
        """A member's key was revoked: send it the reason and remove it at once, even if it holds tickets."""
        return self.membership.revoke(peer, why) + self._deal()

    def remove_silent(self, now: float) -> list[Outgoing]:
        """Remove workers that were silent for longer than `worker_timeout_s`.

        Call it only when every message that has arrived was given to `receive`.
        """
        return self._deal() if self.membership.remove_silent(now, self.worker_timeout_s) else []

    # ---------------------------------------------------------------- the learner's side

    def publish(
        self, version: int, parameters: Array, buffers: Array, *, deal: bool = True, env_attributes: Array | None = None
    ) -> list[Outgoing]:
        """Set the newest weights. Send them to the workers that can take them now; deal the tickets that they allow.

        `deal` False: deal none before `deal` is called, because these weights are evaluated first.
        """
        assert not self.evaluation.pending, "an evaluation is pending"
        self._held_back = not deal
        if self._weights is None:
            self._first_version, self._used_before = version, self.ledger.used
        self.version = version
        self._weights = Weights(version, parameters, buffers, env_attributes)
        out = [out for member in self.membership.active() for out in self._send_newest_weights(member)]
        return out + self._deal()

    def take(self) -> list[AcceptedRollout] | None:
        """The rollouts of the next update, in lane order, or None while there are too few. Stale ones are dropped."""
        if self.version - self._oldest_ready > self.max_lag:
            self._drop_stale()
        if len(self.ready) < self.rollouts_per_update:
            return None
        taken, self.ready = self.ready[: self.rollouts_per_update], self.ready[self.rollouts_per_update :]
        self.ledger.used += len(taken)
        self.ledger.transitions_used += sum(arrived.rollout.env_steps for arrived in taken)
        return [self._marked(arrived) for arrived in sorted(taken, key=lambda each: each.rollout.lane)]

    def not_used(self, taken: list[AcceptedRollout]) -> None:
        """Count rollouts that `take` returned as lost: no update was made of them."""
        self.ledger.used -= len(taken)
        self.ledger.lost += len(taken)
        env_steps = sum(arrived.rollout.env_steps for arrived in taken)
        self.ledger.transitions_used -= env_steps
        self.ledger.transitions_late += env_steps

    def deal(self) -> list[Outgoing]:
        """Deal the tickets that may be dealt, as after stale rollouts were dropped, or after an evaluation."""
        self._held_back = False
        return self._deal()

    def begin_evaluation(self, plan: EvaluationPlan, on_rows: OnRows | None = None) -> list[Outgoing]:
        """Begin to evaluate the newest weights. `self.evaluation` says when it is done."""
        self.evaluation.begin(plan, self.version, on_rows)
        return self._deal()

    def end_evaluation(self) -> list[PlayedEpisode]:
        """End the evaluation, also one that is not done. Returns its episodes, in the order of their seeds."""
        return self.evaluation.end()

    def drain(self, reason: str) -> list[Outgoing]:
        """Ask every worker to leave; deal no more tickets."""
        return self.membership.drain(reason)

    def incarnations(self) -> list[int]:
        """The next incarnation of each lane, for a checkpoint. One that was dealt a ticket is not used again."""
        return [*(lane.incarnation + lane.started for lane in self.lanes), *self._absent]

    # ---------------------------------------------------------------- inside

    def _marked(self, arrived: AcceptedRollout) -> AcceptedRollout:
        """The rollout, which an update uses next, marked as fresh or not."""
        lane = self.lanes[arrived.rollout.lane]
        return replace(arrived, fresh=not lane.use(arrived.incarnation, arrived.rollout.sequence))

    def _join(self, peer: bytes, hello: Hello, now: float) -> list[Outgoing]:
        welcome, member = self.membership.join(peer, hello, now)
        if member is None:
            return welcome
        self._placement.joined()
        return welcome + self._send_newest_weights(member) + self._deal()

    def _strike(self, member: CollectingMember, why: str, now: float) -> list[Outgoing]:
        """Count something that could not be used; after too many the worker is refused."""
        member.heard_s = now
        member.strikes += 1
        return self.membership.refuse(member, SentUnusable, why) if member.strikes >= STRIKES else []

    def _checked(self, member: CollectingMember, why: str, now: float) -> list[Outgoing]:
        """After an answer of an evaluation was taken; `why` it could not be used, if so."""
        return (self._strike(member, why, now) if why else []) + self._deal()

    def _drop_stale(self) -> None:
        stale = [arrived.rollout for arrived in self.ready if self.version - arrived.rollout.version > self.max_lag]
        self.ready = [arrived for arrived in self.ready if self.version - arrived.rollout.version <= self.max_lag]
        self._oldest_ready = min((arrived.rollout.version for arrived in self.ready), default=self.version)
        for rollout in stale:
            self.ledger.stale += 1
            self.ledger.transitions_stale += rollout.env_steps
            self._queue.set_back(self.lanes[rollout.lane])
            self.events.append(RolloutDropped(rollout.lane, self.version - rollout.version, rollout.env_steps))

    def _rollout(self, member: CollectingMember, rollout: Rollout) -> list[Outgoing]:
        self._acknowledge(member, min(rollout.version, self.version))
        ticket = self.tickets.get(rollout.ticket)
        if ticket is None:
            self.ledger.transitions_duplicate += rollout.env_steps
            return self._send_newest_weights(member)
        if (
            ticket.peer != member.peer
            or ticket.lane != rollout.lane
            or not ticket.version <= rollout.version <= self.version
            or not self.lanes[ticket.lane].expects(rollout.sequence)
        ):
            self.ledger.transitions_received -= rollout.env_steps  # `reject_rollout` counts it
            why = f"ticket {ticket.number}: expected lane {ticket.lane} under version {ticket.version} or newer, "
            why += f"got lane {rollout.lane}, version {rollout.version}, sequence {rollout.sequence}"
            return self.reject_rollout(member.peer, rollout, why, member.heard_s)
        del self.tickets[ticket.number], member.tickets[ticket.number]
        lane = self.lanes[ticket.lane]
        lane.outstanding.remove(ticket.number)
        lane.arrived(rollout.sequence)
        self._placement.ticket_ended(member)
        member.stepped = True
        self.ready.append(AcceptedRollout(rollout, ticket.incarnation))
        self._oldest_ready = min(self._oldest_ready, rollout.version)
        return self._send_newest_weights(member) + self._deal()

    def _heartbeat(self, member: CollectingMember, heartbeat: Heartbeat) -> list[Outgoing]:
        """Answer a heartbeat. If it shows that messages were lost on the way, send them again."""
        self.ledger.late_actions += member.new_late_actions(heartbeat)
        lost = member.record_heartbeat(heartbeat)
        peer = member.peer
        if member.state is MemberState.DRAINING:
            return [(peer, Drain(one_line(self.membership.draining or "")))]
        self._acknowledge(member, min(heartbeat.version, self.version))
        seen = min(heartbeat.replies, member.replies)
        if member.sending is not None and seen > member.sending_since:
            member.sending = None
        out = self._send_newest_weights(member)
        out += self._collect(member, lost)
        out += self.evaluation.send_again(member, heartbeat)
        member.replies += 1
        out.append((peer, HeartbeatReply(member.session, member.replies, self._received(member.lanes))))
        return out + self._deal()

    def _acknowledge(self, member: CollectingMember, version: int) -> None:
        member.acknowledged = max(member.acknowledged, version)
        if member.sending is not None and version >= member.sending:
            member.sending = None

    def _send_newest_weights(self, member: CollectingMember) -> list[Outgoing]:
        """The newest weights, unless the worker has them or older ones are still on their way."""
        newest = self._weights
        if newest is None or member.sending is not None or member.acknowledged >= newest.version:
            return []
        if member.state is not MemberState.ACTIVE:
            return []
        member.sending, member.sending_since = newest.version, member.replies
        return [(member.peer, newest)]

    def _received(self, lanes: set[int]) -> tuple[Received, ...]:
        mine = [self.lanes[number] for number in lanes]
        return tuple(Received(lane.number, lane.incarnation, lane.next_sequence, tuple(lane.out_of_order)) for lane in mine)

    def _collect(self, member: CollectingMember, tickets: Sequence[int]) -> list[Outgoing]:
        """Collect messages for these outstanding tickets: one for each version that they were dealt under."""
        out: list[Outgoing] = []
        for version in sorted({self.tickets[number].version for number in tickets}):
            chosen = [self.tickets[number] for number in tickets if self.tickets[number].version == version]
            permits = tuple(Permit(ticket.number, ticket.lane, ticket.incarnation) for ticket in chosen)
            member.tickets |= {ticket.number: member.replies for ticket in chosen}
            out.append((member.peer, Collect(member.session, version, permits, self._received(member.lanes))))
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
        self._queue.set_back(lane)
        self._placement.ticket_ended(member)
        self.ledger.lost += 1

    def _deal(self) -> list[Outgoing]:
        """Give lanes without an owner to workers, balance the lanes, and deal tickets to the least advanced lanes."""
        if self._weights is None or self.membership.draining is not None or not self.members:
            return []
        out = self._placement.place(self.members.values())
        if self.evaluation.pending:
            return out + self.evaluation.deal(self._evaluators())
        if self._held_back:
            return out
        allowed = self.rollouts_per_update * (self.version - self._first_version + 1 + self.max_lag)
        room = allowed - (self.ledger.used - self._used_before) - self.ledger.outstanding
        dealt: dict[bytes, list[int]] = {}
        while room > 0:
            lane = self._queue.first()
            if lane.owner is None or lane.moving:
                break  # the least advanced lane comes first: in a synchronous run no other may take its place
            number = self.ledger.issued
            self.tickets[number] = Ticket(number, lane.number, lane.incarnation, self.version, lane.owner)
            lane.outstanding.add(number)
            self._queue.advance(lane)
            lane.started = True
            dealt.setdefault(lane.owner, []).append(number)
            self.ledger.issued += 1
            room -= 1
        for peer, numbers in dealt.items():
            out += self._collect(self.members[peer], numbers)
        return out

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
