"""A worker of a run with evaluations: that of a training run, and the evaluation that it plays.

Rules: an order is played under its own version and, unless its rows are asked for, once in a session; and a worker does one
piece of work at a time. It holds orders of one evaluation, that of the highest ticket. The first rows are sent when the work
begins, the last ones with the answer.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from millrace.protocol.messages import Describe, Evaluate, ToLearner, ToWorker
from millrace.protocol.rules import Rule
from millrace.workers.conversation.session import EvaluationTask, RolloutTask
from tests.model import worker_part
from tests.model.conversation import Content
from tests.model.message_content import EPISODE_STEPS, content_of, message_of, order_content, session, ticket, weights
from tests.model.worker_part import Worker
from tests.support.conversation.fake_ends import fake_rows

if TYPE_CHECKING:
    from tests.model.evaluation.evaluating import Evaluating

SAVED = {"asked", "answered"}
"""What of `HeldEvaluations` is saved: all."""


@dataclass
class EvaluatingWorker(Worker):
    """One state of a worker, which an event changes."""

    played: set[tuple[int, int]] = field(default_factory=set)
    """session and ticket of the orders that were played"""

    def end(self) -> None:
        super().end()
        self.played = set()

    def handle(self, message: ToWorker, now: float) -> list[ToLearner]:
        assert self.session is not None
        before = set(self.session._current.evaluations.asked) if isinstance(message, Evaluate) else set()
        out = super().handle(message, now)
        asked = {} if self.session is None else self.session._current.evaluations.asked
        assert len({order.version for order in asked.values()}) <= 1, (
            f"{Rule.EVALUATE_ENDS}: a worker holds orders of two evaluations"
        )
        assert not before or max({*before, *asked}) in asked, (
            f"{Rule.EVALUATE_ENDS}: an order of an earlier evaluation has ended a later one"
        )
        return out

    def finish(self, now: float) -> list[ToLearner]:
        last_rows = _rows(self.task.order, EPISODE_STEPS - 1) if isinstance(self.task, EvaluationTask) else []
        return [*last_rows, *super().finish(now)]

    def _begin(self, work: RolloutTask | EvaluationTask | Describe) -> list[ToLearner]:
        first_rows = super()._begin(work)
        if isinstance(work, EvaluationTask):
            order = work.order
            assert work.weights.version == order.version, (
                f"{Rule.EVALUATE_VERSION}: an evaluation under other weights than those of its order"
            )
            assert (order.session, order.ticket) not in self.played, (
                f"{Rule.EVALUATE_ONCE}: an order to evaluate was played twice"
            )
            if not order.send_rows:
                self.played.add((order.session, order.ticket))
            first_rows += _rows(order, 0)
        return first_rows


def _rows(order: Evaluate, step: int) -> list[ToLearner]:
    """The row of this step of each episode, if they are asked for."""
    episodes = range(len(order.seeds) if order.send_rows else 0)
    return [fake_rows(order.session, order.ticket, episode, step) for episode in episodes]


# -------------------------------------------------------------------- to tuples and back


def only_evaluates(content: Content) -> bool:
    """Whether the worker of this content only plays evaluations."""
    return worker_part.only_evaluates(content[0])


def saved(worker: EvaluatingWorker, now: float) -> Content:
    """The training run; orders and answers, and what was played; and the order that is played."""
    content = worker_part.saved(worker, now)
    if worker.session is None:
        return content, None, None
    held = worker.session._current.evaluations
    orders = tuple(order_content(order) for _, order in sorted(held.asked.items()))
    answers = tuple(content_of(answer, worker.number) for answer in held.answered.values())
    played = tuple(
        (session(number), ticket(each)) for number, each in sorted(worker.played) if number == worker.session.session
    )
    task = worker.task
    if not isinstance(task, EvaluationTask):
        return content, (orders, answers, played), None
    return content, (orders, answers, played), (task.weights.version, order_content(task.order))


def loaded(content: Content, number: int, settings: Evaluating) -> EvaluatingWorker:
    """A worker at the time 0 with this content."""
    both, held, running = content
    worker = worker_part.loaded(both, number, settings, EvaluatingWorker)
    if worker.session is None:
        return worker
    orders, answers, played = held
    evaluations = worker.session._current.evaluations
    for order in (message_of(each, number, settings.run) for each in orders):
        evaluations.asked[order.ticket] = order
    for answer in (message_of(each, number, settings.run) for each in answers):
        evaluations.answered[answer.ticket] = answer
    worker.played = {(of_session.value, each.value) for of_session, each in played}
    if running is not None:
        worker.task = EvaluationTask(weights(running[0]), message_of(running[1], number, settings.run), {})
    return worker
