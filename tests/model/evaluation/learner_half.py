"""The learner of a run with evaluations: that of a training run, and the tickets of the pending evaluation.

Rules: while an evaluation is pending that all play, no ticket for a rollout is dealt; one beside training is played by the
workers that only evaluate, and by all once the learner waits for it and none of them is left; each of its tickets is with
nobody, with one worker, or played; its episodes are those of its seeds under its version, each used once; and the rows of a
ticket come from the session whose answer counts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from millrace.learner.members.member import SentTicket
from millrace.learner.members.membership import Outgoing
from millrace.learner.rollouts.evaluation_dealer import FIRST_TICKET, EvaluationDealer, PendingEvaluation
from millrace.protocol.messages import EpisodeRows, ToLearner
from millrace.protocol.rules import Rule
from tests.model import learner_part
from tests.model.conversation import Content
from tests.model.learner_part import Learner
from tests.model.message_content import EPISODE_STEPS, evaluated, peer_of, session, ticket, worker_of
from tests.model.names import Kind, name
from tests.support.conversation.fake_ends import fake_rows
from tests.support.conversation.rules import pending_evaluation

if TYPE_CHECKING:
    from tests.model.evaluation.evaluating import Evaluating

SAVED: dict[type, set[str]] = {
    EvaluationDealer: {"pending", "_next_ticket"},
    PendingEvaluation: {"plan", "version", "beside", "seeds", "playing", "_first", "_undealt", "_played", "_rows"},
}
"""What is saved. `seeds` follow from the plan, and `_next_ticket` from `_first` while an evaluation is pending."""
NOT_SAVED: dict[type, set[str]] = {
    EvaluationDealer: {"_run", "most_copies", "_late"},
    PendingEvaluation: {"_run", "_on_rows", "_most_copies", "_most_workers", "_late"},
}
"""A second worker is asked only after ten minutes, so there is none here, and nobody is late."""


class EvaluatingLearner(Learner):
    """One state of the learner, which an event changes."""

    settings: Evaluating
    barrier = 0
    """number of tickets for rollouts that were issued before all began to play the pending evaluation"""
    rows: list[tuple[int, int]]
    """episode and step of the rows of the pending evaluation, in the order in which they came"""

    @property
    def awaits(self) -> bool:
        """Whether the learner waits for the pending evaluation: all play it, or the next one is due, or the run ends."""
        waits = self.settings.evaluators is None or self.coordinator.version >= self.settings.updates or self._is_due()
        return self.coordinator.evaluation.pending is not None and waits

    # ---------------------------------------------------------------- events

    def receive(self, worker: int, message: ToLearner, now: float) -> list[Outgoing]:
        self._now_received = message
        return super().receive(worker, message, now)

    def check(self) -> None:
        super().check()
        evaluation = self.coordinator.evaluation.pending
        if evaluation is not None and not evaluation.beside:
            assert self.coordinator.rollouts.ledger.issued == self.barrier, (
                "a ticket for a rollout was dealt during an evaluation"
            )

    # ---------------------------------------------------------------- inside

    def _resume(self, version: int) -> list[Outgoing]:
        """An evaluation beside training that an earlier version began is begun again."""
        begun = max((each for each in self.settings.evaluated if each <= version), default=version)
        if self.settings.evaluators is None or begun == version:
            return super()._resume(version)
        self._set_weights(begun)
        return [*self._begin_evaluation(), *super()._resume(version)]

    def _publish(self, version: int) -> list[Outgoing]:
        self._set_weights(version)
        out = self._begin_evaluation() if self._is_due() and self.coordinator.evaluation.pending is None else []
        return out if self.awaits else [*out, *self.coordinator.begin_update()]

    def _needed(self) -> set[int]:
        evaluation = self.coordinator.evaluation.pending
        return super()._needed() | (set() if evaluation is None else {evaluation.version})

    def _is_due(self) -> bool:
        """Whether the newest version is to be evaluated, and its evaluation isn't pending."""
        version, pending = self.coordinator.version, self.coordinator.evaluation.pending
        return version in self.settings.evaluated and (pending is None or version != pending.version)

    def _begin_evaluation(self) -> list[Outgoing]:
        coordinator, settings = self.coordinator, self.settings
        self.barrier, self.rows = coordinator.rollouts.ledger.issued, []
        on_rows = self._take_rows if settings.rows else None
        return coordinator.begin_evaluation(settings.plan, on_rows, beside=settings.evaluators is not None)

    def _take_rows(self, episode: int, rows: EpisodeRows) -> None:
        answer = self._now_received
        assert not isinstance(answer, EpisodeRows), f"{Rule.ROWS_FIRST}: rows counted before their answer had come"
        assert rows.session == getattr(answer, "session", None), f"{Rule.ROWS_FIRST}: rows and answer are of two sessions"
        self.rows.append((episode, rows.first_step))

    def _gather(self) -> list[Outgoing]:
        return self._await() if self.awaits else super()._gather()

    def _learn(self) -> list[Outgoing]:
        return self._await() if self.awaits else super()._learn()

    def _await(self) -> list[Outgoing]:
        """The learner waits: let all play, if they must. Go on if the evaluation is done."""
        coordinator, evaluation = self.coordinator, pending_evaluation(self.coordinator)
        if not evaluation.done:
            if not evaluation.beside:
                return []
            self.barrier = coordinator.rollouts.ledger.issued
            out = coordinator.await_evaluation()
            evaluators = [member for member in coordinator.members.values() if member.hello.evaluates]
            assert evaluation.beside == bool(evaluators), (
                "all play an evaluation although a worker is there that only evaluates"
            )
            return out
        is_due = self._is_due()
        self._end_evaluation()
        out = self._begin_evaluation() if is_due else []
        return [*out, *self._gather()]

    def _end_evaluation(self) -> None:
        plan, version = self.settings.plan, pending_evaluation(self.coordinator).version
        played = [one.episode.reward for one in self.coordinator.evaluation.end()]
        assert played == [seed + version / 1000 for seed in plan.seeds], f"other episodes than those asked for: {played}"
        every = [(episode, step) for episode in range(len(plan.seeds)) for step in range(EPISODE_STEPS)]
        assert sorted(self.rows) == (every if plan.send_rows else []), (
            f"{Rule.ROWS_FIRST}: other rows than those of the episodes"
        )
        self.rows = []


# -------------------------------------------------------------------- to tuples and back


def saved(learner: EvaluatingLearner, now: float) -> Content:
    """The training run; then the next ticket of an evaluation or, if one is pending, its first ticket and its state."""
    content = learner_part.saved(learner, now)
    tickets = learner.coordinator.evaluation.pending
    if tickets is None:
        return content, (learner.coordinator.evaluation._next_ticket - FIRST_TICKET,)
    held = tuple(
        (
            name(Kind.WORKER, worker_of(member.peer)),
            tuple(
                (number - tickets._first, name(Kind.REPLIES, sent.replies, member.session))
                for number, sent in sorted(member.tickets.items())
                if number >= FIRST_TICKET
            ),
        )
        for member in sorted(tickets.players, key=lambda member: member.join_number)
    )
    played = tuple((index, tuple(e.reward for e in answer.episodes)) for index, answer in sorted(tickets._played.items()))
    rows = tuple(
        (index, episode, session(each.session), each.first_step)
        for (index, _), of_ticket in sorted(tickets._rows.items())
        for episode, come in sorted(of_ticket.items())
        for each in come
    )
    first, undealt = tickets._first - FIRST_TICKET, tuple(sorted(tickets._undealt))
    barrier = None if tickets.beside else ticket(learner.barrier)
    more = undealt, held, played, rows, tickets.version, barrier, tuple(learner.rows)
    return content, (first, *more)


def is_pending(of_evaluation: Content) -> bool:
    """Whether an evaluation is pending in this part of a learner's content."""
    return len(of_evaluation) > 1


def loaded(content: Content, settings: Evaluating) -> EvaluatingLearner:
    """A learner at the time 0 with this content."""
    both, (first, *of_evaluation) = content
    training = learner_part.loaded(both, settings)
    learner = EvaluatingLearner(settings, training.coordinator)
    vars(learner).update(vars(training))
    learner.rows = []
    learner.coordinator.evaluation._next_ticket = FIRST_TICKET + first
    if not of_evaluation:
        return learner
    undealt, held, played, rows, version, barrier, of_learner = of_evaluation
    on_rows = learner._take_rows if settings.rows else None
    learner.coordinator.evaluation.begin(settings.plan, version, on_rows, beside=barrier is None)
    tickets = pending_evaluation(learner.coordinator)
    tickets._undealt = list(undealt)
    for worker, mine in held:
        member = learner.coordinator.members[peer_of(worker.value)]
        for index, sent_at in mine:
            tickets.playing[tickets._first + index] = [member]
            member.tickets[tickets._first + index] = SentTicket(sent_at.value, {version})
    tickets._played = {index: evaluated(0, tickets._first + index, returns) for index, returns in played}
    for index, episode, of_session, step in rows:
        (holder,) = tickets.playing[tickets._first + index]
        come = tickets._rows.setdefault((index, holder.peer), {}).setdefault(episode, [])
        come.append(fake_rows(of_session.value, tickets._first + index, episode, step))
    learner.barrier, learner.rows = 0 if barrier is None else barrier.value, list(of_learner)
    return learner
