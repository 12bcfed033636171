"""The conversation of a vector environment: orders and answers, between an `OrderCoordinator` and `Session`s.

Rule: the program makes its calls one after the other. A call that raises `NoWorkers`, and a reset that raises `WorkerLost`,
is made again. The target is reached when all calls have returned. After a restart of the learner the program starts anew.

One fault at a time. With two, a Step of copies that were never reset is found: the process after a killed one takes the
Welcome that answers a repeated Hello of the killed one, before its own Hello is heard. Over ZeroMQ this starts nothing: when
the new process connects, what the killed one said loses its name, so none of its later messages counts.
"""

from __future__ import annotations

from dataclasses import dataclass

from millrace.protocol.specs import StepSpec
from tests.model import process_part
from tests.model.conversation import Content, Event, Facts
from tests.model.message_content import worker_of
from tests.model.settings import TICK_S, TIMEOUT_S
from tests.model.training import now_at
from tests.model.vector_env import learner_half, worker_half
from tests.model.vector_env.learner_half import Learner
from tests.model.vector_env.order_content import content_of, message_of, step_spec
from tests.model.vector_env.worker_half import Worker


@dataclass(frozen=True)
class Stepping:
    """A program that uses a vector environment."""

    workers: int
    lanes: int
    calls: tuple[str, ...]
    """each "reset", "interrupted reset" (a reset must follow), "abandoned reset" (after an error), "step" or "call" """
    faults: int
    only: tuple[str, ...] = ()
    few_losses = False

    @property
    def run(self) -> StepSpec:
        return step_spec(self.lanes, TICK_S, TIMEOUT_S)

    @property
    def call_timeout_s(self) -> float:
        """How long a call waits, at most."""
        return 3.0 + 3.0 * self.faults

    @property
    def most_ticks(self) -> int:
        """In so many ticks a worker that is heard must have answered: a fault costs at most three."""
        return 2 + 3 * self.faults

    def start(self) -> tuple[Content, list[Content]]:
        workers = [worker_half.saved(Worker(self, number, 0), 0.0) for number in range(self.workers)]
        return learner_half.saved(Learner(self, 0, 0.0)), workers

    def learner(self, content: Content, event: Event, message: Content | None) -> tuple[Content, list[tuple[int, Content]]]:
        learner, out = learner_half.loaded(content, self, now_at(event)).event(event, message)
        return learner_half.saved(learner), [(worker_of(to), content_of(told, worker_of(to))) for to, told in out]

    def worker(self, content: Content, number: int, event: Event, message: Content | None) -> tuple[Content, list[Content]]:
        worker, now = worker_half.loaded(content, number, self), now_at(event)
        told = None if message is None else message_of(message, number, self.run)
        sent = [content_of(said, number) for said in worker.event(event, told, now)]
        return worker_half.saved(worker, now), sent

    def is_needed(self, worker: Content) -> bool:
        return self.workers == 1

    def without_checkpoints(self, learner: Content) -> Content:
        return learner  # it has none

    def facts(self, content: Content) -> Facts:
        if isinstance(content[0], str):
            return Facts()
        if len(content) == 4:
            return process_part.facts(content)
        members, *_, caller = content
        reached = caller[0] == len(self.calls)
        going_on = caller[1] is None and not reached
        return Facts(reached=reached, updating=going_on, checkpoints=1, members=tuple(each[0].value for each in members[0]))

    def __str__(self) -> str:
        return f"{self.workers} workers, {self.lanes} lanes, {', '.join(self.calls)}, {self.faults} faults"
