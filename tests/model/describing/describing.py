"""The conversation of a run that begins while its workers wait for it: one describes the environment, all are taken over.

Rule: the learner takes over its workers some time after the environment was described, and publishes the first weights some
time after that. Then it trains, to the same target. After a restart the run is known, and workers join it at once.
"""

from __future__ import annotations

from dataclasses import dataclass

from tests.model.conversation import Content, Event, Facts
from tests.model.describing import learner_half, worker_half
from tests.model.message_content import content_of, message_of, worker_of
from tests.model.training import Training, now_at


@dataclass(frozen=True)
class Describing(Training):
    """A training run that begins with a description, or with several, one after another."""

    environments: int = 1
    """how many environments are described: that of the run is the last"""

    def start(self) -> tuple[Content, list[Content]]:
        workers = [worker_half.DescribingWorker(self, number, 0) for number in range(self.workers)]
        return learner_half.start(self), [worker_half.saved(worker, 0.0) for worker in workers]

    def learner(self, content: Content, event: Event, message: Content | None) -> tuple[Content, list[tuple[int, Content]]]:
        after, out = learner_half.event(content, self, event, message, now_at(event))
        return after, [(worker_of(to), content_of(told, worker_of(to))) for to, told in out]

    def worker(self, content: Content, number: int, event: Event, message: Content | None) -> tuple[Content, list[Content]]:
        now = now_at(event)
        worker = worker_half.loaded(content, number, self)
        said = worker.event(event, None if message is None else message_of(message, number, self.run), now)
        return worker_half.saved(worker, now), [content_of(each, number) for each in said]

    def without_checkpoints(self, learner: Content) -> Content:
        lobby, run = learner
        return lobby, None if run is None else super().without_checkpoints(run)

    def facts(self, content: Content) -> Facts:
        if isinstance(content[0], str):
            return Facts()
        if len(content) == 2:  # the learner
            return learner_half.facts(content, self) if content[1] is None else super().facts(content[1])
        training, _, describes = content
        facts = super().facts(training)
        return facts._replace(working=facts.working or describes is not None)

    def __str__(self) -> str:
        after = "a description" if self.environments == 1 else f"{self.environments} descriptions"
        return f"{super().__str__()}, after {after}"
