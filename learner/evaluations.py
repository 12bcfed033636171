"""Evaluations of one run: each version at most once, the best policy kept, and that one evaluated again at the end.

The highest of several evaluations is biased upwards. So the summary reports the best policy by a
second evaluation, on other episodes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from learner.algorithms import Algorithm
from learner.config.run_rules import EvaluationSettings
from learner.run_folder.results import Best, Evaluation
from learner.run_folder.run_folder import RunFolder
from learner.service import RolloutService
from protocol.arrays import Floats
from protocol.errors import RunError, UsageError
from protocol.specs import RunSpec

log = logging.getLogger("millrace.learner")

EVALUATION_SEED, CONFIRMATION_SEED = 1_000_000, 2_000_000  # far from the seeds of training, and from each other


class Evaluations:
    """Greedy evaluations of the newest policy, and the best policy so far."""

    def __init__(
        self,
        settings: EvaluationSettings,
        folder: RunFolder,
        spec: RunSpec,
        algorithm: Algorithm,
        service: RolloutService,
        best: list[float] | None,
        env_steps: int,
    ) -> None:
        """`best` and `env_steps` are those of the checkpoint that the run resumes from; None and 0 in a new run."""
        self.newest: Evaluation | None = None
        """The newest evaluation since this learner started."""
        self.best = best
        """Mean return and env steps of the best evaluation during training."""
        self.note = ""
        """The newest evaluation as one line of text for the user."""
        self._settings, self._folder, self._spec = settings, folder, spec
        self._algorithm, self._service = algorithm, service
        self._version = -1  # of the weights that `newest` evaluated
        self._next_at = env_steps + settings.every_env_steps

    def evaluate_if_due(self, version: int, env_steps: int) -> dict[str, float]:
        """Evaluate every `every_env_steps` env steps. The metrics of the evaluation; empty if none was due."""
        if not self._settings.every_env_steps or env_steps < self._next_at:
            return {}
        self._next_at += self._settings.every_env_steps
        found = self.evaluate(version, env_steps)
        self._keep_if_best(found, env_steps)
        return found.metrics()

    def evaluate(self, version: int, env_steps: int) -> Evaluation:
        """Evaluate the newest policy, which is this version; the same version is not evaluated twice."""
        if self.newest is None or self._version != version:
            self.newest = self._evaluate(*self._algorithm.weights(), EVALUATION_SEED)
            self._version = version
            self.note = f"{env_steps:,} env steps: greedy {self.newest}"
        return self.newest

    def conclude(self, version: int, env_steps: int) -> Best | None:
        """Evaluate the final policy. If the run kept a best policy, evaluate that one on other episodes and return it."""
        found = self.evaluate(version, env_steps)
        if self._settings.every_env_steps:
            self._keep_if_best(found, env_steps)
        if self.best is None:
            return None
        try:
            _, parameters, buffers = self._folder.read_policy("best")
        except UsageError as error:  # the disk was full when it was written
            log.warning("%s", error)
            return None
        chosen_by, at_env_steps = self.best
        confirmed = self._evaluate(parameters, buffers, CONFIRMATION_SEED)
        return Best(env_steps=int(at_env_steps), chosen_by=chosen_by, evaluation=confirmed)

    def of_version(self, version: int) -> Evaluation | None:
        """The evaluation of this version, if there is one."""
        return self.newest if self._version == version else None

    def _evaluate(self, parameters: Floats, buffers: Floats, seed: int) -> Evaluation:
        return self._service.evaluate(parameters, buffers, self._settings.episodes, seed + self._settings.seed)

    def _keep_if_best(self, found: Evaluation, env_steps: int) -> None:
        """Keep the evaluation if it is the best. A tie keeps the earlier one, which needed fewer steps."""
        if self.best is None or found.return_mean > self.best[0]:
            self.best = [found.return_mean, env_steps]
            weights = self._algorithm.weights()
            warn_on_error(lambda: self._folder.write_policy(self._spec.policy, self._spec.env, *weights, which="best"))


def warn_on_error(write: Callable[[], object]) -> None:
    """Write a file; a disk that is full costs a warning, never the run."""
    try:
        write()
    except RunError as error:
        log.warning("%s", error)
