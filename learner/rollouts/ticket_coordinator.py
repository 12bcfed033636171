"""The learner's half of the conversation of a run. Pure: messages and `now` in, messages out; no socket, clock or torch.

Rule: whatever a worker is asked for has a ticket. Two dealers decide what is asked and what an answer means:
`rollout_dealer.py` and `evaluation_dealer.py`. Here they meet the workers. A lane has one owner at a time and moves only
between rollouts; its new owner starts it afresh, so its incarnation rises. When a worker is lost, its lanes go to other
workers, and its tickets are dealt again. There is no other failure handling. If a Heartbeat shows that a message was lost on
the way, the message is sent again.

While an evaluation is pending, no ticket for a rollout is dealt, unless the evaluation is beside training: then workers that
only evaluate play it, whatever the others do.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence

import msgspec

from millrace.learner.members.coordinator import Coordinator
from millrace.learner.members.events import EnvironmentNoted, Failed, PolicyRaised
from millrace.learner.members.lane_placement import LanePlacement, is_spare
from millrace.learner.members.member_states import SentUnusable
from millrace.learner.members.membership import Member, Membership, Outgoing
from millrace.learner.rollouts.collecting_member import CollectingMember
from millrace.learner.rollouts.evaluation_dealer import EvaluationDealer, EvaluationPlan, OnRows
from millrace.learner.rollouts.ledger import Ledger
from millrace.learner.rollouts.opponent_pool import OpponentPool
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.sent_weights import SentWeights
from millrace.protocol.messages import (
    Array,
    Collect,
    EpisodeRows,
    Evaluate,
    Evaluated,
    Failure,
    Heartbeat,
    Received,
    Rejoin,
    Rollout,
    ToLearner,
    Weights,
)
from millrace.protocol.specs import RunSpec

MOST_NOTES = 10  # of all workers together
STRIKES = 3  # rollouts or messages that could not be used, after which a worker is refused


class TicketCoordinator(Coordinator[CollectingMember]):
    """Members, their lanes, and what they are asked for.

    A rollout that `receive` is given must have passed `millrace.protocol.rows.rollout_checks.validate`; else call
    `reject_rollout`.
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
        opponents: OpponentPool | None = None,
    ) -> None:
        """`ledger` and `incarnations` come from a checkpoint. `opponents`: those of a run with teams."""
        self.rollouts = RolloutDealer(run.lanes, max_lag, ledger, incarnations, opponents)
        self.evaluation = EvaluationDealer(run)
        lanes = self.rollouts.lanes
        membership = Membership(run, CollectingMember, self._removed, first_session, lambda member: is_spare(member, lanes))
        super().__init__(membership, worker_timeout_s)
        self.run = run
        self.version = -1  # until `publish`
        self._placement = LanePlacement(lanes, _by_joining)
        self.weights = SentWeights()
        self._notes = set[str]()  # of workers; all that step one environment see the same

    # ---------------------------------------------------------------- in

    def reject_message(self, peer: bytes, why: str, now: float) -> list[Outgoing]:
        """Count a message that could not be read, and answer it."""
        self.rollouts.ledger.messages_bad += 1
        return super().reject_message(peer, why, now)

    def reject_rollout(self, peer: bytes, rollout: Rollout, why: str, now: float) -> list[Outgoing]:
        """Count a rollout that cannot be used. Its ticket is lost."""
        self.rollouts.invalid(rollout)
        member = self.members.get(peer)
        if member is None or member.session != rollout.session:
            return [(peer, Rejoin(rollout.session))]
        member.heard_s = now
        out = self._unusable(member, why)
        self.rollouts.reject(member, rollout.ticket)
        self._placement.ticket_ended(member)
        return out + self._deal()

    def refuse(self, member: CollectingMember, why: str) -> list[Outgoing]:
        """Refuse a worker that holds tickets and does nothing with them: they are dealt again."""
        return self.membership.refuse(member, SentUnusable, why) + self._deal()

    # ---------------------------------------------------------------- the learner's side

    def publish(
        self,
        version: int,
        parameters: Array,
        buffers: Array,
        *,
        env_attributes: Array | None = None,
        env_steps: int | None = None,
    ) -> None:
        """Set the newest weights. Orders name them from now on: call `begin_update`, or `begin_evaluation`.

        `env_steps`: of training, after which they were made; None: they never become an opponent.
        """
        if self.rollouts.opponents is not None and env_steps is not None:
            self.rollouts.opponents.made(version, env_steps)
        self.version = version
        self.weights.keep(Weights(version, parameters, buffers, env_attributes), self._needed())

    def begin_update(self) -> list[Outgoing]:
        """The next update begins, unless it has begun, with the newest weights: deal the rounds that it opens."""
        self.rollouts.begin_update(self.version)
        return self._deal()

    def begin_evaluation(
        self, plan: EvaluationPlan, on_rows: OnRows | None = None, *, beside: bool = False
    ) -> list[Outgoing]:
        """Begin to evaluate the newest weights, `beside` training if so. `self.evaluation` says when it is done."""
        self.evaluation.begin(plan, self.version, on_rows, beside=beside)
        return self._deal()

    def await_evaluation(self) -> list[Outgoing]:
        """The learner waits for the evaluation beside training: if no worker only evaluates any more, all play it."""
        if any(member.hello.evaluates for member in self.membership.active()):
            return []
        self.evaluation.all_play()
        return self._deal()

    def share_evaluation(self) -> list[Outgoing]:
        """No answer of the evaluation has come for long: a second worker plays the oldest ticket as well, if one is free."""
        return self._with_weights(self.evaluation.share(self.membership.active()))

    def collected(self) -> int:
        """Env steps of the next update's rollouts: of those that have come, and of those under way, as workers report."""
        rollouts = self.rollouts
        of_one = self.run.rollout_steps * self.run.copies
        awaited = Counter(ticket.peer for ticket in rollouts.awaited())
        under_way = (min(self.members[peer].steps_under_way, count * of_one) for peer, count in awaited.items())
        return rollouts.collected() + sum(under_way)

    def steps_of_update(self) -> int:
        """Env steps of an update's rollouts, if no step only resets a copy."""
        return self.run.lanes * self.run.rollout_steps * self.run.copies

    # ---------------------------------------------------------------- inside

    def _deal(self) -> list[Outgoing]:
        """Give lanes without an owner to workers, balance the lanes, and deal what is to be dealt."""
        if self.version < 0 or self.membership.draining is not None or not self.members:
            return []
        out = self._placement.place(self.members.values())
        if self.evaluation.pending:
            out += self.evaluation.deal(self.membership.active())
        if self.evaluation.beside or not self.evaluation.pending:
            out += self.rollouts.deal(self.members)
        return self._with_weights(out)

    def _with_weights(self, orders: list[Outgoing]) -> list[Outgoing]:
        """These orders, which list the versions that their workers are to keep, and the weights that these workers lack."""
        out = list[Outgoing]()
        for peer, order in orders:
            if isinstance(order, Collect | Evaluate):
                keep = tuple(sorted(self._named(self.members[peer].tickets)))
                order = msgspec.structs.replace(order, keep=keep)
            out.append((peer, order))
        return out + self.weights.after(out, self.members)

    def _named(self, tickets: Collection[int]) -> set[int]:
        """The versions that these tickets name."""
        return self.rollouts.versions(tickets) | self.evaluation.versions(tickets)

    def _needed(self) -> set[int]:
        """The versions that orders may name, beside the newest."""
        opponents = self.rollouts.opponents
        needed = self.rollouts.rounds.acting()
        if self.evaluation.pending:
            needed.add(self.evaluation.version)
        if opponents is not None:
            needed.update(opponents.versions)
        return needed

    def _answer(self, member: CollectingMember, message: ToLearner) -> list[Outgoing]:
        held = len(member.tickets)
        match message:
            case Rollout():
                if why := self.rollouts.take_in(member, message):
                    return self.reject_rollout(member.peer, message, why, member.heard_s)
                member.ended_steps += message.env_steps if len(member.tickets) < held else 0  # 0: it came before
                self._placement.ticket_ended(member)
                return self._deal()
            case Evaluated():
                why = self.evaluation.take_in(member, message)
                made = sum(episode.length for episode in message.episodes)
                member.ended_steps += made if len(member.tickets) < held else 0
            case EpisodeRows():
                why = self.evaluation.take_rows(member, message)
            case _:
                return []  # answers to orders that a run does not give
        return (self._unusable(member, why) if why else []) + self._deal()

    def _late(self, message: ToLearner) -> None:
        if isinstance(message, Rollout):
            self.rollouts.late(message)

    def _heartbeat(self, member: CollectingMember, heartbeat: Heartbeat) -> list[Outgoing]:
        self.rollouts.ledger.late_actions += member.new_late_actions(heartbeat)
        note = heartbeat.note
        if note and note not in self._notes and len(self._notes) < MOST_NOTES:
            self._notes.add(note)
            self.events.append(EnvironmentNoted(member.hello.worker, note))
        return super()._heartbeat(member, heartbeat)

    def _again(self, member: CollectingMember, heartbeat: Heartbeat, lost: Sequence[int]) -> list[Outgoing]:
        out = self.weights.again(member, heartbeat, self._named(heartbeat.tickets))
        orders = self.rollouts.send(member, lost) + self.evaluation.send(member, lost)
        return out + self._with_weights(orders)

    def _received(self, member: CollectingMember) -> tuple[Received, ...]:
        return self.rollouts.received(member)

    def _joined(self) -> list[Outgoing]:
        self._placement.joined()
        return self._deal()

    def _removed(self, member: CollectingMember, why: str) -> None:
        """The worker is gone: its tickets are lost, its lanes have no owner. `_deal` gives both to other workers."""
        for number in list(member.tickets):
            dealer = self.rollouts if number in self.rollouts.held else self.evaluation
            dealer.lose(member, number)
        self._placement.removed(member)
        self.weights.held.forget(member.peer)

    def _unusable(self, member: CollectingMember, why: str) -> list[Outgoing]:
        """Count what could not be used; after too much of it the worker is refused."""
        member.strikes += 1
        return super()._unusable(member, why) if member.strikes >= STRIKES else []

    def _kind(self, failure: Failure) -> type[Failed]:
        return PolicyRaised if failure.of_policy and self.membership.has_policy_code else super()._kind(failure)


def _by_joining(member: Member) -> int:
    """Sort key: the next lane goes to the worker with the fewest lanes; in a tie, to the one that joined first."""
    return member.join_number
