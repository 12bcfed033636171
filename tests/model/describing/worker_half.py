"""A worker of a run that begins with a description: that of a training run, and the description that it makes.

Rules: a worker describes each environment once in a session; and it holds no tickets for rollouts before it knows the run.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from millrace.protocol.messages import Describe, ToLearner, ToWorker
from millrace.protocol.rules import Rule
from millrace.protocol.specs import WaitSpec
from millrace.workers.conversation.session import EvaluationTask, RolloutTask
from tests.model import worker_part
from tests.model.conversation import Content
from tests.model.message_content import ENV, WAIT, described, ticket
from tests.model.worker_part import Worker

if TYPE_CHECKING:
    from tests.model.describing.describing import Describing

SAVED = {"asked", "answered"}
"""What of `HeldDescriptions` is saved: all."""


@dataclass
class DescribingWorker(Worker):
    """One state of a worker, which an event changes."""

    made: set[int] = field(default_factory=set)
    """the orders whose environments it has begun to describe, in this session"""

    def handle(self, message: ToWorker, now: float) -> list[ToLearner]:
        assert self.session is not None
        before = self.session.session, self.session.state
        out = super().handle(message, now)
        if self.session is not None and (self.session.session, self.session.state) != before:
            self.made = {self.task.ticket} if isinstance(self.task, Describe) else set()
        return out

    def end(self) -> None:
        super().end()
        self.made = set()

    def _begin(self, work: RolloutTask | EvaluationTask | Describe) -> list[ToLearner]:
        assert self.session is not None
        waits = isinstance(self.session.run, WaitSpec)
        assert waits == isinstance(work, Describe), f"{Rule.DESCRIBE}: a worker that waits does other work than to describe"
        if isinstance(work, Describe):
            assert work.ticket not in self.made, f"{Rule.DESCRIBE_AGAIN}: an environment is described twice"
            self.made = self.made | {work.ticket}
        return super()._begin(work)


# -------------------------------------------------------------------- to tuples and back


def saved(worker: DescribingWorker, now: float) -> Content:
    """The training run; whether it waits, the orders that it holds, has answered and has begun; and that in progress."""
    content = worker_part.saved(worker, now)
    current = worker.session
    if current is None:
        return content, None, None
    held = current._current.descriptions
    waits = isinstance(current.run, WaitSpec)
    assert not waits or not current._current.rollouts._lanes, "a worker that waits holds tickets for rollouts"
    orders = tuple(tuple(ticket(each) for each in sorted(of)) for of in (held.asked, held.answered, worker.made))
    return content, (waits, *orders), ticket(worker.task.ticket) if isinstance(worker.task, Describe) else None


def loaded(content: Content, number: int, settings: Describing) -> DescribingWorker:
    """A worker at the time 0 with this content."""
    training, more, describes = content
    worker = worker_part.loaded(training, number, settings, DescribingWorker)
    current = worker.session
    if current is None:
        return worker
    waits, asked, answered, made = more
    worker.made = {each.value for each in made}
    if waits:
        current.run = WAIT
    held = current._current.descriptions
    held.asked = {each.value: Describe(current.session, each.value, ENV) for each in asked}
    held.answered = {each.value: described(current.session, each.value) for each in answered}
    if describes is not None:
        worker.task = Describe(current.session, describes.value, ENV)
    return worker
