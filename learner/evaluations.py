"""Evaluations of one run: each version at most once, the best policy kept, and that one evaluated again at the end.

The highest of several evaluations is biased upwards. So the summary reports the best policy by a
second evaluation, on other episodes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from learner.algorithms import Algorithm
from learner.config.run_rules import EvaluationSettings, EvaluationSize
from learner.rollout_service.service import RolloutService
from learner.rollouts.evaluation_tickets import EvaluationPlan
from learner.run_folder.results import Best, Evaluation
from learner.run_folder.run_folder import RunFolder
from learner.run_state import RunState
from protocol.arrays import Floats
from protocol.errors import UsageError
from protocol.logs.notices import log_notice
from protocol.random_streams import Purpose
from protocol.specs import RunSpec

log = logging.getLogger("millrace.learner")


class Evaluations:
    """Greedy evaluations of the newest policy, and the best policy so far."""

    def __init__(
        self,
        settings: EvaluationSettings,
        folder: RunFolder,
        spec: RunSpec,
        algorithm: Algorithm,
        service: RolloutService,
        state: RunState,
        watch: Callable[[], None],
    ) -> None:
        """`state`: where the run stands. `watch` is called several times a second during an evaluation."""
        self.newest = state.newest_evaluation
        """The newest evaluation."""
        self.version = state.evaluated_version
        """The version that `newest` belongs to."""
        self.best = state.best
        """Mean return and env steps of the best evaluation during training."""
        self.best_policy: tuple[Floats, Floats] | None = state.best_policy
        """Parameters and buffers of the best policy."""
        self.note = ""
        """The newest evaluation as one line of text for the user."""
        self._settings, self._folder, self._spec = settings, folder, spec
        self._algorithm, self._service, self._watch = algorithm, service, watch
        due_at = state.env_steps + settings.every_env_steps
        self.next_at = min(state.next_evaluation or due_at, due_at)
        """Env steps at which the next evaluation is due."""
        self.write_best()  # the folder may have that of a later version, which was lost

    def is_due(self, env_steps: int) -> bool:
        """Whether an evaluation is due after so many env steps."""
        return bool(self._settings.every_env_steps) and env_steps >= self.next_at

    def evaluate_newest(self, version: int, env_steps: int) -> dict[str, float | None]:
        """Make the evaluation that is due, of the newest policy, which is this version. Returns its metrics."""
        found = self._evaluate_version(version, env_steps, self._settings.size())
        self._keep_if_best(found, env_steps)
        every = self._settings.every_env_steps
        self.next_at += every * (1 + (env_steps - self.next_at) // every)  # the next multiple that is not reached yet
        return found.metrics()

    def conclude(self, version: int, env_steps: int, episode_length: float | None, time_limit: int | None) -> Best | None:
        """Evaluate the final policy. If the run kept a best policy, evaluate that one on other episodes and return it.

        `episode_length`, `time_limit`: see `EvaluationSettings.final_size`.
        """
        size = self._settings.final_size(env_steps, episode_length, time_limit)
        if size != (usual := self._settings.size()):
            log_notice(log, _smaller(size, usual))
        found = self._evaluate_version(version, env_steps, size)
        if self._settings.every_env_steps or self.best is not None:  # best: of a run that was resumed with eval_every 0
            self._keep_if_best(found, env_steps)
        if self.best is None:
            return None
        if self.best_policy is None:
            try:
                _, parameters, buffers = self._folder.read_policy("best")
            except UsageError as error:
                log.warning("%s", error)
                return None
            self.best_policy = parameters, buffers
        chosen_by, at_env_steps = self.best
        self._service.publish(version + 1, *self.best_policy, deal=False)  # training is over: no update has this number
        confirmed = self._evaluate(Purpose.CONFIRMATION, size)
        return Best(env_steps=int(at_env_steps), chosen_by=chosen_by, evaluation=confirmed)

    def write_best(self) -> None:
        """Write the best policy into the run folder, if it is known."""
        if self.best_policy is None:
            return
        (parameters, buffers), spec = self.best_policy, self._spec
        write = self._folder.write_policy
        self._folder.writes.write(
            "best policy", lambda: write(spec.policy, spec.env, parameters, buffers, "best", spec.facts, spec.masked)
        )

    def of_version(self, version: int) -> Evaluation | None:
        """The evaluation of this version, if there is one."""
        return self.newest if self.version == version else None

    def _evaluate_version(self, version: int, env_steps: int, size: EvaluationSize) -> Evaluation:
        """Evaluate the newest policy, which is this version; the same version is not evaluated twice."""
        if self.newest is None or self.version != version or self.newest.episodes != size.episodes:
            self.newest = self._evaluate(Purpose.EVALUATION, size)
            self.version = version
            self.note = f"{env_steps:,} env steps: greedy {self.newest}"
        return self.newest

    def _evaluate(self, purpose: Purpose, size: EvaluationSize) -> Evaluation:
        """Evaluate the weights that were published last."""
        settings = self._settings
        plan = EvaluationPlan.of(size.episodes, settings.seed, settings.copies, size.max_steps, purpose)
        return self._service.evaluate(plan, lambda played, env_steps: self._watch())

    def _keep_if_best(self, found: Evaluation, env_steps: int) -> None:
        """Keep the evaluation if it is the best. A tie keeps the earlier one, which needed fewer steps."""
        if self.best is None or found.return_mean > self.best[0]:
            self.best = [found.return_mean, env_steps]
            self.best_policy = self._algorithm.weights()
            self.write_best()


def _smaller(size: EvaluationSize, usual: EvaluationSize) -> str:
    """Says that an evaluation is smaller than usual."""
    steps = f" and at most {size.max_steps:,} env steps" if size.max_steps < usual.max_steps else ""
    why = "because the training was short; --eval-episodes sets another number"
    return f"the evaluation has {size.episodes} episodes{steps}, {why}"
