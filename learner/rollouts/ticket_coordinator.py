"""The learner's half of the conversation of a run. Pure: messages and `now` in, messages out; no socket, clock or torch.

Rule: every task for a worker has a ticket. Two dealers decide which tickets to give out and how to handle an answer:
`rollout_dealer.py` and `evaluation_dealer.py`. This file connects them to the workers. A lane has one owner at a time and
moves only between rollouts; its new owner has new env copies for it, so its incarnation rises. When a worker is lost, its
lanes go to other workers, which continue them, and its tickets are dealt again. There is no other failure handling. If a
Heartbeat shows that a message was lost, the message is sent again.

While an evaluation is pending, no ticket for a rollout is dealt, unless the evaluation runs alongside training. Then the
workers that only evaluate play it, while the others collect rollouts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from millrace.learner.members.coordinator import Coordinator
from millrace.learner.members.events import EnvironmentNoted, EpisodesArrived, LaneContinued, RolloutArrived, RolloutRejected
from millrace.learner.members.lane_placement import LanePlacement, is_spare
from millrace.learner.members.member import Member
from millrace.learner.members.membership import Answered, Gone, Membership, Outgoing
from millrace.learner.rollouts.evaluation_dealer import EvaluationDealer, EvaluationPlan, OnRows
from millrace.learner.rollouts.past_rollouts import PastRollouts, RoundsState
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.protocol.errors import BadRollout
from millrace.protocol.messages import (
    Array,
    Collect,
    EpisodeRows,
    Evaluated,
    Goodbye,
    Heartbeat,
    Hello,
    Received,
    Rollout,
    ToLearner,
    Weights,
)
from millrace.protocol.rows.rollout_checks import validate
from millrace.protocol.specs import RunSpec

CheckRows = Callable[[Rollout, RunSpec, int], None]
"""Checks the rows of a rollout. Raises `BadRollout` if they break the row format, don't fit the run, or contain an episode
with more steps than the last argument.
"""

MOST_NOTES = 10  # how many notes are logged, of all workers together
STRIKES = 3  # a worker is refused after this many rollouts or messages that could not be used


class TicketCoordinator(Coordinator):
    """The members, their lanes and their tickets."""

    def __init__(
        self,
        run: RunSpec,
        rollouts: RolloutDealer,
        *,
        worker_timeout_s: float,
        first_session: int,
        check_rows: CheckRows = validate,
    ) -> None:
        """`check_rows` checks each rollout before it is accepted."""
        self.rollouts = rollouts
        self.evaluation = EvaluationDealer(run)
        lanes = self.rollouts.lanes
        membership = Membership(run, self._removed, first_session, lambda member: is_spare(member, lanes))
        super().__init__(membership, worker_timeout_s)
        self.run = run
        self.version = -1  # version of the newest weights; -1 before the first `publish`
        self._placement = LanePlacement(lanes, _by_joining)
        self.weights = rollouts.weights
        self._notes = set[str]()  # notes already logged; workers with the same environment send the same notes
        self._check_rows = check_rows

    # ---------------------------------------------------------------- in

    def reject_message(self, peer: bytes, why: str, now: float) -> list[Outgoing]:
        """Count a message that could not be read, and answer it."""
        self.rollouts.ledger.messages_bad += 1
        return super().reject_message(peer, why, now)

    def refuse(self, member: Member, why: str) -> list[Outgoing]:
        """Refuse a worker that holds tickets without working on them, and deal its tickets again."""
        return self.membership.refuse(member, why) + self._deal()

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
        """Set the newest weights, which later orders name. Then call `begin_update` or `begin_evaluation`.

        `env_steps` is the number of training env steps so far; with None, the weights never become an opponent. Without
        `env_attributes`, weights that are published again keep the attributes that they have.
        """
        if env_attributes is None and version in self.weights.kept:
            env_attributes = self.weights.kept[version].env_attributes
        if self.rollouts.opponents is not None and env_steps is not None:
            self.rollouts.opponents.made(version, env_steps)
        self.version = version
        self.weights.keep(Weights(version, parameters, buffers, env_attributes), self._needed())

    def keep(self, weights: Weights) -> None:
        """Store weights that act in an open round of a resumed run."""
        self.weights.kept[weights.version] = weights

    def past(self, first: int) -> PastRollouts:
        """The state from which another learner continues after the last round that was taken.

        `first` is the version that the other learner publishes first, so its weights are left out. It may differ from the
        version that was published last here, because weights are also published to be evaluated.
        """
        rounds = self.rollouts.rounds
        return PastRollouts(
            ledger=self.rollouts.ledger.copy(),
            incarnations=self.rollouts.incarnations(),
            rounds=RoundsState(rounds.next, dict(rounds.versions)),
            lanes=self.rollouts.pasts(),
            acting=[self.weights.kept[version] for version in sorted(rounds.acting() - {first})],
        )

    def begin_update(self) -> list[Outgoing]:
        """Begin the next update with the newest weights, unless it has begun, and deal the rounds that it opens."""
        self.rollouts.begin_update(self.version)
        return self._deal()

    def begin_evaluation(
        self, plan: EvaluationPlan, on_rows: OnRows | None = None, *, beside: bool = False
    ) -> list[Outgoing]:
        """Begin to evaluate the newest weights, alongside training if `beside`.

        The evaluation is then `self.evaluation.pending`; its `done` says when to end it.
        """
        self.evaluation.begin(plan, self.version, on_rows, beside=beside)
        return self._deal()

    def await_evaluation(self) -> list[Outgoing]:
        """Let all workers play the awaited evaluation if no worker that only evaluates is left."""
        evaluation = self.evaluation.pending
        if evaluation is None or any(member.hello.evaluates for member in self.membership.active()):
            return []
        evaluation.all_play()
        return self._deal()

    def share_evaluation(self) -> list[Outgoing]:
        """Let an idle worker, if there is one, also play the oldest ticket, because no answer has arrived for long."""
        evaluation = self.evaluation.pending
        return [] if evaluation is None else self.weights.after(evaluation.share(self.membership.active()), self.members)

    def collected(self) -> int:
        """The env steps made so far for the next update's rollouts, complete and running, as workers report them."""
        rollouts = self.rollouts
        of_one = self.run.rollout_steps * self.run.copies
        awaited = Counter(ticket.peer for ticket in rollouts.awaited())
        under_way = (min(self.members[peer].steps_under_way, count * of_one) for peer, count in awaited.items())
        return rollouts.collected() + sum(under_way)

    def steps_of_update(self) -> int:
        """The number of env steps in an update's rollouts, provided that no step only resets a copy."""
        return self.run.lanes * self.run.rollout_steps * self.run.copies

    # ---------------------------------------------------------------- inside

    def _deal(self) -> list[Outgoing]:
        """Assign lanes without an owner to workers, balance the lanes, and deal tickets."""
        if self.version < 0 or self.membership.draining is not None or not self.members:
            return []
        out = self._placement.place(self.members.values())
        evaluation = self.evaluation.pending
        if evaluation is not None:
            out += evaluation.deal(self.membership.active())
        if evaluation is None or evaluation.beside:
            out += self._deal_rollouts()
        return self.weights.after(out, self.members)

    def _deal_rollouts(self) -> list[Outgoing]:
        dealt = self.rollouts.deal(self.members)
        for peer, order in dealt:
            for permit in order.permits if isinstance(order, Collect) else ():
                if (past := permit.past) is not None and past.memory:  # true only if the lane has had rollouts
                    worker = self.members[peer].hello.worker
                    history = self.rollouts.lanes[permit.lane].history
                    longest = 0 if history is None else history.longest_given_up
                    event = LaneContinued(worker, permit.lane, past.repeated_steps, past.new_episodes, longest)
                    self.events.append(event)
        return dealt

    def _needed(self) -> set[int]:
        """The versions, other than the newest, that orders may name."""
        opponents = self.rollouts.opponents
        needed = self.rollouts.rounds.acting()
        if self.evaluation.pending is not None:
            needed.add(self.evaluation.pending.version)
        if opponents is not None:
            needed.update(opponents.versions)
        return needed

    def _not_of_member(self, message: ToLearner, answered: Answered) -> None:
        match message:
            case Hello() if answered.changed:
                self._placement.joined()
            case Rollout():
                self.rollouts.late(message)

    def _answer(self, member: Member, message: ToLearner) -> list[Outgoing]:
        match message:
            case Heartbeat():
                return self._heartbeat(member, message)
            case Rollout():
                return self._take_rollout(member, message)
            case Evaluated():
                return self._take_evaluated(member, message)
            case EpisodeRows() if self.evaluation.pending is not None:
                why = self.evaluation.pending.take_rows(member, message)
                return self._unusable(member, why) if why else []
            case Goodbye(_, reason):
                self.membership.leave(member, reason)
        return []  # answers to orders that a run never sends, and rows of an evaluation that has ended, are ignored

    def _take_rollout(self, member: Member, rollout: Rollout) -> list[Outgoing]:
        """Accept a rollout, unless it had arrived before. If it can't be used, it is counted, and its ticket is lost."""
        try:
            longest = self.rollouts.longest_episode(rollout.ticket, self.run.rollout_steps)
            self._check_rows(rollout, self.run, longest)
            accepted = self.rollouts.take_in(member, rollout)
        except BadRollout as error:
            return self._reject(member, rollout, f"rollout of ticket {rollout.ticket}: {error}")
        self._placement.ticket_ended(member)
        if accepted:
            member.ended_steps += rollout.env_steps
            self.events.append(RolloutArrived(member.hello.worker, rollout.lane, rollout.version))
        return []

    def _reject(self, member: Member, rollout: Rollout, why: str) -> list[Outgoing]:
        self.events.append(RolloutRejected(member.peer, why))
        out = self._unusable(member, why)
        self.rollouts.reject(member, rollout)
        self._placement.ticket_ended(member)
        return out

    def _take_evaluated(self, member: Member, answer: Evaluated) -> list[Outgoing]:
        """Accept episodes of an evaluation, unless they had arrived before."""
        evaluation = self.evaluation.pending
        if evaluation is None:
            return []
        taken = evaluation.take_in(member, answer)
        if taken.ended:
            member.ended_steps += sum(episode.length for episode in answer.episodes)
        if taken.accepted:
            self.events.append(EpisodesArrived(member.hello.worker))
        return self._unusable(member, taken.why) if taken.why else []

    def _heartbeat(self, member: Member, heartbeat: Heartbeat) -> list[Outgoing]:
        self.rollouts.ledger.late_actions += member.new_late_actions(heartbeat)
        note = heartbeat.note
        if note and note not in self._notes and len(self._notes) < MOST_NOTES:
            self._notes.add(note)
            self.events.append(EnvironmentNoted(member.hello.worker, note))
        described = member.describes
        out = super()._heartbeat(member, heartbeat)
        if described and not member.describes:
            self._placement.joined()  # from now on, the worker may have lanes
        return out

    def _again(self, member: Member, heartbeat: Heartbeat, lost: Sequence[int]) -> list[Outgoing]:
        out = self.weights.again(member, heartbeat)
        orders = self.rollouts.send(member, lost)
        if self.evaluation.pending is not None:
            orders += self.evaluation.pending.send(member, lost)
        return out + self.weights.after(orders, self.members)

    def _received(self, member: Member) -> tuple[Received, ...]:
        return self.rollouts.received(member)

    def _removed(self, member: Member, gone: Gone) -> None:
        """Count a lost worker's tickets as lost, and take away its lanes, so that `_deal` gives both to other workers."""
        self.rollouts.worker_lost(member, gone)
        for number in list(member.tickets):
            if number in self.rollouts.held:
                self.rollouts.lose(member, number)
            elif self.evaluation.pending is not None:
                self.evaluation.pending.lose(member, number)
        self._placement.removed(member)
        self.weights.held.forget(member.peer)

    def _unusable(self, member: Member, why: str) -> list[Outgoing]:
        """Count a message that could not be used, and refuse the worker after `STRIKES` of them."""
        member.strikes += 1
        return super()._unusable(member, why) if member.strikes >= STRIKES else []


def _by_joining(member: Member) -> int:
    """Sort key for workers with equally few lanes: the one that joined first gets the next lane."""
    return member.join_number
