"""The conversation of a run that evaluates some of its versions, between rollouts.

Rule: as the training loop does, the learner publishes a version that is to be evaluated without tickets for rollouts,
evaluates it, and only then collects. Beside training it goes on at once, and waits for the evaluation when the next one is
due, or at the end. The target is reached when the last version is published and no evaluation is pending.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan
from tests.model.conversation import Content, Event, Facts
from tests.model.evaluation import learner_half, worker_half
from tests.model.learner_part import first_learner
from tests.model.message_content import EPISODE_STEPS, content_of, message_of, worker_of
from tests.model.training import Training, learner_event, now_at


@dataclass(frozen=True)
class Evaluating(Training):
    """A training run with evaluations."""

    evaluated: tuple[int, ...] = (0,)
    """versions that are evaluated"""
    episodes: int = 3
    copies: int = 2
    """episodes of a ticket: by default there are two tickets, of two episodes and of one"""
    rows: bool = False
    """whether the rows of the episodes are asked for"""
    evaluators: int | None = None
    """how many of the workers only evaluate, beside training; None: all evaluate, and training waits"""

    @cached_property
    def plan(self) -> EvaluationPlan:
        return EvaluationPlan(tuple(range(1, self.episodes + 1)), self.copies, EPISODE_STEPS, send_rows=self.rows)

    def start(self) -> tuple[Content, list[Content]]:
        learner, _ = first_learner(self, learner_half.EvaluatingLearner)
        evaluates = [number < (self.evaluators or 0) for number in range(self.workers)]
        workers = [worker_half.EvaluatingWorker(self, number, 0, evaluates=each) for number, each in enumerate(evaluates)]
        return learner_half.saved(learner, 0.0), [worker_half.saved(worker, 0.0) for worker in workers]

    def learner(self, content: Content, event: Event, message: Content | None) -> tuple[Content, list[tuple[int, Content]]]:
        now = now_at(event)
        learner, out = learner_event(learner_half.loaded(content, self), event, message, now)
        return learner_half.saved(learner, now), [(worker_of(to), content_of(told, worker_of(to))) for to, told in out]

    def worker(self, content: Content, number: int, event: Event, message: Content | None) -> tuple[Content, list[Content]]:
        now = now_at(event)
        worker = worker_half.loaded(content, number, self)
        said = worker.event(event, None if message is None else message_of(message, number, self.run), now)
        return worker_half.saved(worker, now), [content_of(each, number) for each in said]

    def is_needed(self, worker: Content) -> bool:
        """Whether no other worker can have lanes."""
        return not worker_half.only_evaluates(worker) and self.workers - (self.evaluators or 0) == 1

    def without_checkpoints(self, learner: Content) -> Content:
        both, of_evaluation = learner
        return super().without_checkpoints(both), of_evaluation

    def facts(self, content: Content) -> Facts:
        if isinstance(content[0], str):
            return Facts()
        both, *of_evaluation = content
        facts = super().facts(both)
        if len(of_evaluation) == 1:  # the learner
            return facts._replace(reached=facts.reached and not learner_half.is_pending(of_evaluation[0]))
        return facts._replace(working=facts.working or of_evaluation[1] is not None)

    def __str__(self) -> str:
        rows = " with rows" if self.rows else ""
        beside = "" if self.evaluators is None else f", beside training: {self.evaluators} workers only evaluate"
        versions = " and ".join(map(str, self.evaluated))
        return (
            f"{super().__str__()}, {-(-self.episodes // self.copies)} evaluation tickets{rows} at version {versions}{beside}"
        )
