"""A worker's collector and evaluator. They share a policy that acts in a run's env copies.

Rule: the policy has the weights of the current task. Weights are loaded only if a task needs other weights than the task
before it did.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from millrace.protocol.bounds import Stages
from millrace.protocol.messages import Weights
from millrace.protocol.policy.called_policy import CalledPolicy
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.specs import RunSpec
from millrace.protocol.wire.weight_dtypes import to_float32
from millrace.workers.collect.collector import Collector
from millrace.workers.conversation.session import EvaluationTask, RolloutTask, WorkAnswer
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.open_lanes import OpenLanes
from millrace.workers.evaluate.episode_rows import SendRows
from millrace.workers.evaluate.evaluator import Evaluator
from millrace.workers.lanes.lane import Lane


class Actors:
    """A collector and an evaluator that share a policy."""

    def __init__(self, collector: Collector, evaluator: Evaluator) -> None:
        self._collector = collector
        self._evaluator = evaluator
        self._loaded: Weights | None = None

    def do(self, task: RolloutTask | EvaluationTask, send: SendRows, pulse: Pulse) -> Sequence[WorkAnswer]:
        """Collect rollouts, or play episodes and pass their rows to `send`. `pulse` is called at every step and may raise.

        Raises `EnvironmentFailed`, `PolicyFailed`, and what `pulse` raises.
        """
        self._load(task.weights)
        match task:
            case RolloutTask(session, weights, permits, held):
                return self._collector.collect(permits, weights.version, session, pulse, held)
            case EvaluationTask(_, order, held):
                return [self._evaluator.play(order, send, pulse, held)]

    def _load(self, weights: Weights) -> None:
        if self._loaded is not weights:
            attributes = weights.env_attributes
            self._collector.load(to_float32(weights.parameters), weights.buffers)
            self._collector.env_attributes = b"" if attributes is None else attributes.tobytes()
            self._loaded = weights

    @property
    def steps(self) -> int:
        """Number of env steps made, in rollouts and evaluations."""
        return self._collector.steps + self._evaluator.steps

    @property
    def stages(self) -> Stages:
        """Seconds spent in each stage; "evaluate" is missing before the first evaluation."""
        evaluation: Stages = {"evaluate": self._evaluator.seconds} if self._evaluator.steps else {}
        return self._collector.stages | evaluation

    @property
    def note(self) -> str:
        """What the user should know about the environment; empty if there is nothing to report."""
        return self._collector.note

    @property
    def lanes(self) -> OpenLanes[Lane]:
        """The lanes whose env copies are open."""
        return self._collector.lanes

    def close(self) -> None:
        """Close all env copies."""
        self._collector.lanes.close_all()
        self._evaluator.close()


MakeActors = Callable[[RunSpec], Actors]


def make_local_actors(run: RunSpec) -> Actors:
    """Make actors that act with a policy in this process, on env copies of their own."""
    policy = make_policy(run.policy, run.images_dtype) if run.policy.own is None else CalledPolicy(run.policy, run.extras)
    return Actors(Collector(run, policy), Evaluator(run, policy))
