"""A worker of a run that begins with a description: that of a training run, and the description that it makes.

Rules: a worker describes the environment once in a session; and it holds no tickets for rollouts before it knows the run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from millrace.learner.members.describe_coordinator import FIRST_TICKET
from millrace.protocol.messages import Describe, ToLearner, ToWorker
from millrace.protocol.rules import Rule
from millrace.protocol.specs import WaitSpec
from millrace.workers.conversation.session import EvaluationTask, RolloutTask
from tests.model import worker_part
from tests.model.conversation import Content
from tests.model.message_content import ENV, WAIT, described
from tests.model.worker_part import Worker

if TYPE_CHECKING:
    from tests.model.describing.describing import Describing

SAVED = {"asked", "answered"}
"""What of `HeldDescriptions` is saved: all."""
TICKET = FIRST_TICKET + 1
"""of the only environment"""


@dataclass
class DescribingWorker(Worker):
    """One state of a worker, which an event changes."""

    made: bool = False
    """whether it has begun to describe the environment, in this session"""

    def handle(self, message: ToWorker, now: float) -> list[ToLearner]:
        assert self.session is not None
        before = self.session.session, self.session.state
        out = super().handle(message, now)
        if self.session is not None and (self.session.session, self.session.state) != before:
            self.made = isinstance(self.task, Describe)
        return out

    def end(self) -> None:
        super().end()
        self.made = False

    def _begin(self, work: RolloutTask | EvaluationTask | Describe) -> list[ToLearner]:
        assert self.session is not None
        waits = isinstance(self.session.run, WaitSpec)
        assert waits == isinstance(work, Describe), f"{Rule.DESCRIBE}: a worker that waits does other work than to describe"
        assert not (self.made and waits), f"{Rule.DESCRIBE_AGAIN}: an environment is described twice"
        self.made = self.made or waits
        return super()._begin(work)


# -------------------------------------------------------------------- to tuples and back


def saved(worker: DescribingWorker, now: float) -> Content:
    """The training run; whether it waits, is asked for a description, and has made it; and whether it makes it now."""
    content = worker_part.saved(worker, now)
    current = worker.session
    if current is None:
        return content, None, False
    held = current._current.descriptions
    waits = isinstance(current.run, WaitSpec)
    assert not waits or not current._current.rollouts._lanes, "a worker that waits holds tickets for rollouts"
    return content, (waits, bool(held.asked), bool(held.answered), worker.made), isinstance(worker.task, Describe)


def loaded(content: Content, number: int, settings: Describing) -> DescribingWorker:
    """A worker at the time 0 with this content."""
    training, more, describes = content
    worker = worker_part.loaded(training, number, settings, DescribingWorker)
    current = worker.session
    if current is None:
        return worker
    waits, asked, answered, worker.made = more
    if waits:
        current.run = WAIT
    order = Describe(current.session, TICKET, ENV)
    held = current._current.descriptions
    if asked:
        held.asked[TICKET] = order
    if answered:
        held.answered[TICKET] = described(current.session, TICKET)
    if describes:
        worker.task = order
    return worker
