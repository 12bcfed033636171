"""The learner of a run with evaluations: that of a training run, and the tickets of the pending evaluation.

Rules: while an evaluation is pending, no ticket for a rollout is dealt and the version stays; each of its tickets is with
nobody, with one worker, or played; its episodes are those of its seeds under its version, each used once; and the rows of a
ticket come from the session whose answer counts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from learner.members.membership import Outgoing
from learner.rollouts.evaluation_dealer import FIRST_TICKET, EvaluationDealer
from protocol.messages import EpisodeRows, ToLearner
from tests.model import learner_part
from tests.model.conversation import Content
from tests.model.learner_part import Learner
from tests.model.message_content import EPISODE_STEPS, evaluated, peer_of, session, ticket, worker_of
from tests.model.names import Kind, name
from tests.support.conversation.fake_ends import BUFFERS, PARAMETERS, fake_rows

if TYPE_CHECKING:
    from tests.model.evaluation.evaluating import Evaluating

SAVED = {"_plan", "version", "_first", "_seeds", "_undealt", "held", "_played", "_rows"}
"""What of `EvaluationDealer` is saved. `_seeds` follow from the plan."""
NOT_SAVED = {"_policy", "_facts", "_on_rows", "most_copies", "_most_workers", "beside"}


class EvaluatingLearner(Learner):
    """One state of the learner, which an event changes."""

    settings: Evaluating
    barrier = 0
    """number of tickets for rollouts that were issued before the pending evaluation began"""
    rows: list[tuple[int, int]]
    """episode and step of the rows of the pending evaluation, in the order in which they came"""

    # ---------------------------------------------------------------- events

    def receive(self, worker: int, message: ToLearner, now: float) -> list[Outgoing]:
        self._now_received = message
        return super().receive(worker, message, now)

    def check(self) -> None:
        super().check()
        if self.coordinator.evaluation.pending:
            assert self.coordinator.rollouts.ledger.issued == self.barrier, (
                "a ticket for a rollout was dealt during an evaluation"
            )

    # ---------------------------------------------------------------- inside

    def _publish(self, version: int) -> list[Outgoing]:
        coordinator, settings = self.coordinator, self.settings
        evaluates = version in settings.evaluated
        self.barrier, self.rows = coordinator.rollouts.ledger.issued, []
        if not evaluates:
            return super()._publish(version)
        coordinator.publish(version, PARAMETERS, BUFFERS)
        return coordinator.begin_evaluation(settings.plan, self._take_rows if settings.rows else None)

    def _take_rows(self, episode: int, rows: EpisodeRows) -> None:
        answer = self._now_received
        assert not isinstance(answer, EpisodeRows), "rows counted before their answer had come"
        assert rows.session == getattr(answer, "session", None), "rows and answer are of two sessions"
        self.rows.append((episode, rows.first_step))

    def _gather(self) -> list[Outgoing]:
        return [] if self.coordinator.evaluation.pending else super()._gather()

    def _learn(self) -> list[Outgoing]:
        evaluation = self.coordinator.evaluation
        if not evaluation.pending:
            return super()._learn()
        if not evaluation.done:
            return []
        self._end_evaluation()
        return self._gather()

    def _end_evaluation(self) -> None:
        plan, version = self.settings.plan, self.coordinator.version
        played = [one.episode.reward for one in self.coordinator.evaluation.end()]
        assert played == [seed + version / 1000 for seed in plan.seeds], f"other episodes than those asked for: {played}"
        every = [(episode, step) for episode in range(len(plan.seeds)) for step in range(EPISODE_STEPS)]
        assert sorted(self.rows) == (every if plan.send_rows else []), "other rows than those of the episodes"
        self.rows = []


# -------------------------------------------------------------------- to tuples and back


def saved(learner: EvaluatingLearner, now: float) -> Content:
    """The training run, and the evaluation: its first ticket, their number, and more if it is pending."""
    content = learner_part.saved(learner, now)
    tickets = learner.coordinator.evaluation
    if not tickets.pending:
        return content, (tickets._first - FIRST_TICKET, len(tickets._seeds))
    held = tuple(
        (
            name(Kind.WORKER, worker_of(member.peer)),
            tuple(
                (number - tickets._first, name(Kind.REPLIES, sent_at, member.session))
                for number, sent_at in sorted(member.tickets.items())
                if number >= FIRST_TICKET
            ),
        )
        for member in sorted(tickets.players, key=lambda member: member.join_number)
    )
    played = tuple((index, tuple(e.reward for e in answer.episodes)) for index, answer in sorted(tickets._played.items()))
    rows = tuple(
        (index, episode, session(each.session), each.first_step)
        for index, of_ticket in sorted(tickets._rows.items())
        for episode, come in sorted(of_ticket.items())
        for each in come
    )
    first = tickets._first - FIRST_TICKET
    undealt = tuple(sorted(tickets._undealt))
    return content, (first, len(tickets._seeds), undealt, held, played, rows, ticket(learner.barrier), tuple(learner.rows))


def is_pending(of_evaluation: Content) -> bool:
    """Whether an evaluation is pending in this part of a learner's content."""
    return len(of_evaluation) > 2


def loaded(content: Content, settings: Evaluating) -> EvaluatingLearner:
    """A learner at the time 0 with this content."""
    both, (first, number, *of_evaluation) = content
    training = learner_part.loaded(both, settings)
    learner = EvaluatingLearner(settings, training.coordinator)
    vars(learner).update(vars(training))
    learner.rows = []
    tickets: EvaluationDealer = learner.coordinator.evaluation
    tickets._first = FIRST_TICKET + first
    if not of_evaluation:
        tickets._seeds = [()] * number
        return learner
    undealt, held, played, rows, barrier, of_learner = of_evaluation
    tickets.begin(settings.plan, learner.coordinator.version, learner._take_rows if settings.rows else None)
    tickets._undealt = list(undealt)
    for worker, mine in held:
        member = learner.coordinator.members[peer_of(worker.value)]
        for index, sent_at in mine:
            tickets.held[tickets._first + index] = member
            member.tickets[tickets._first + index] = sent_at.value
    tickets._played = {index: evaluated(0, tickets._first + index, returns) for index, returns in played}
    for index, episode, of_session, step in rows:
        come = tickets._rows.setdefault(index, {}).setdefault(episode, [])
        come.append(fake_rows(of_session.value, tickets._first + index, episode, step))
    learner.barrier, learner.rows = barrier.value, list(of_learner)
    return learner
