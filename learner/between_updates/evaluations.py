"""The evaluations of one run. Each version is evaluated at most once. At the end, the best policy is evaluated again.

A return that was used to select a policy is a biased estimate of that policy's return: the highest of several evaluations
is biased upwards. So is an evaluation that ended the run, because the target was reached or a callback stopped the run.
Therefore, for the best policy, and for the final policy if its evaluation ended the run, the summary reports a second
evaluation, on other episodes.

Rule: without `eval_workers`, training waits for each evaluation. With them, evaluations run alongside training. The result
of an evaluation is used when the next one is due, or at the end of the run; if it isn't ready by then, the run waits for it.
The course of a run therefore doesn't depend on speed. The evaluated policy is kept until its result is used.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

from millrace.learner.between_updates.run_parts import RunParts
from millrace.learner.config.evaluation_size import EvaluationSize, evaluation_size, final_evaluation_size
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan, evaluation_of
from millrace.learner.run_folder.progress import Row
from millrace.learner.run_folder.results import EVALUATED_AT_KEY, Best, EvaluatedPolicy, Evaluation
from millrace.protocol.arrays import Array, Floats
from millrace.protocol.logs.notices import log_notice
from millrace.protocol.random_streams import Purpose

log = logging.getLogger("millrace.learner")


class Evaluations:
    """Greedy evaluations of the newest policy, and the best policy so far."""

    def __init__(self, run: RunParts, time_limit: int | None) -> None:
        """`time_limit` is the number of env steps after which an evaluation episode is truncated; None without a limit."""
        self.confirmed: Best | None = None
        """The best policy and its second evaluation. Set by `conclude`."""
        self.final: Evaluation | None = None
        """The evaluation of the final policy that is reported. Set by `conclude`."""
        self.ended_by: float | None = None
        """The mean return of the evaluation that ended the run, if one did. Set by `conclude`."""
        self._run = run
        self._config = run.config
        self._time_limit = time_limit
        self._tally = run.tally
        self._state = run.tally.state
        self.write_best()  # the file may be from a later update, which a resumed run has lost

    def begin_again(self, env_attributes: Array | None, watch: Callable[[], None]) -> Row | None:
        """Restart the evaluation that was running alongside training when the run was interrupted. Publishes its weights.

        If the run was resumed without `eval_workers`, this also waits for the evaluation and returns its metrics.
        `env_attributes` belong to the newest weights. They are sent along if the newest weights are to be evaluated. If
        older weights are to be evaluated, and these still act in an open round, the hub has their attributes.
        """
        if (pending := self._state.pending) is None:
            return None
        attributes = env_attributes if pending.version == self._state.version else None
        self._run.hub.publish(pending.version, *self._state.pending_policy, deal=False, env_attributes=attributes)
        self._begin_beside()
        return None if self._config.eval_workers else self.end_pending(watch)

    def evaluate_when_due(self, watch: Callable[[], None]) -> Row | None:
        """Evaluate the newest policy, because an evaluation is due. Returns the evaluation's metrics.

        With `eval_workers`, only begins the evaluation, and returns None. The previous evaluation must have ended
        (`end_pending`); if its result ended the run, no other begins, even if the run was resumed without `eval_workers`.
        `watch` is called several times a second during the wait.
        """
        if not self._config.eval_workers:
            if self._tally.decided_by_evaluation() is not None:
                return None
            evaluation = self._evaluate_newest(evaluation_size(self._config), watch)
            self._keep_if_best(evaluation, self._state.env_steps, self._run.algorithm.weights)
            self._tally.evaluated()
            return evaluation.metrics()
        if self._tally.stop_reason() is None:
            self._tally.evaluated()
            self._state.pending = EvaluatedPolicy(self._state.version, self._state.env_steps)
            self._state.pending_policy = self._run.algorithm.weights()
            self._begin_beside()
        return None

    def end_pending(self, watch: Callable[[], None]) -> Row | None:
        """Wait for the evaluation that runs alongside training, if there is one.

        Returns its metrics, which include the evaluated policy's env steps.
        """
        state = self._state
        pending = state.pending
        policy = state.pending_policy
        if pending is None:
            return None
        evaluation = self._end(watch)
        state.pending = state.pending_policy = None
        self._record(evaluation, pending)
        self._keep_if_best(evaluation, pending.env_steps, lambda: policy)
        return evaluation.metrics() | {EVALUATED_AT_KEY: pending.env_steps}

    def conclude(self, watch: Callable[[], None]) -> bool:
        """Evaluate the final policy. If the run kept a best policy, evaluate it again on other episodes.

        Sets `final`, `confirmed` and `ended_by`. Returns True if the final policy had not yet been evaluated with as many
        episodes.
        """
        state = self._state
        before = self.of_newest()
        decided = self._tally.decided_by_evaluation()
        biased = self._newest_is_biased()
        size = final_evaluation_size(self._config, state.env_steps, self._tally.window.length_mean, self._time_limit)
        if size != (usual := evaluation_size(self._config)):
            log_notice(log, _smaller(size, usual))
        evaluation = self._evaluate_newest(size, watch)
        if self._config.eval_every or state.best is not None:  # a run resumed with eval_every 0 may have a best policy
            self._keep_if_best(evaluation, state.env_steps, self._run.algorithm.weights)
        found_again = None
        if biased:
            found_again = self._evaluate(Purpose.CONFIRMATION, size, watch)
            self._say(found_again, state.env_steps, ", on other episodes")
        self.final = found_again or evaluation
        self.ended_by = None if decided is None else decided.evaluation
        self.confirmed = self._confirm(found_again, size, watch)
        return evaluation is not before

    def write_best(self) -> None:
        """Write the best policy, if there is one. Raises `RunTakenOver` if another process trains this run now."""
        if self._state.best_policy is None:
            return
        policy = self._state.best_policy
        spec = self._run.spec
        folder = self._run.folder
        folder.confirm_lock()
        folder.writes.write("best policy", lambda: folder.write_policy(spec, policy[0], policy[1], "best"))

    def to_report(self) -> Evaluation | None:
        """The evaluation to report, even if the run was cut short; None if the newest one may have ended the run."""
        if self.final is not None:
            return self.final
        return None if self._newest_is_biased() else self.of_newest()

    def of_newest(self) -> Evaluation | None:
        """The evaluation of the newest policy, if there is one."""
        return self._state.newest_evaluation if self._state.evaluated.version == self._state.version else None

    def _newest_is_biased(self) -> bool:
        """Whether the newest policy's evaluation ended the run."""
        decided = self._tally.decided_by_evaluation()
        return decided is not None and decided.evaluated_before is None

    def _confirm(self, found_again: Evaluation | None, size: EvaluationSize, watch: Callable[[], None]) -> Best | None:
        """Evaluate the best policy again, if the run kept one. `found_again` is the final policy's second evaluation."""
        state = self._state
        if state.best is None:
            return None
        chosen_by, env_steps = state.best
        if found_again is not None and env_steps == state.env_steps:
            return Best(env_steps=env_steps, chosen_by=chosen_by, evaluation=found_again)
        self._run.hub.publish(state.version + 1, *state.best_policy, deal=False)  # a version that no update has used
        confirmed = self._evaluate(Purpose.CONFIRMATION, size, watch)
        return Best(env_steps=env_steps, chosen_by=chosen_by, evaluation=confirmed)

    def _evaluate_newest(self, size: EvaluationSize, watch: Callable[[], None]) -> Evaluation:
        """Evaluate the newest policy, unless it was already evaluated with the same number of episodes."""
        state = self._state
        evaluation = self.of_newest()
        if evaluation is None or evaluation.episodes != size.episodes:
            evaluation = self._evaluate(Purpose.EVALUATION, size, watch)
            self._record(evaluation, EvaluatedPolicy(state.version, state.env_steps))
        return evaluation

    def _record(self, evaluation: Evaluation, of: EvaluatedPolicy) -> None:
        """Record this evaluation of the policy `of` as the newest."""
        self._state.newest_evaluation = evaluation
        self._state.evaluated = of
        self._say(evaluation, of.env_steps)

    def _say(self, evaluation: Evaluation, env_steps: int, how: str = "") -> None:
        self._tally.note = f"{env_steps:,} env steps: greedy {evaluation}{how}"

    def _evaluate(self, purpose: Purpose, size: EvaluationSize, watch: Callable[[], None]) -> Evaluation:
        """Evaluate the weights that were last published, while training waits."""
        self._run.hub.begin_evaluation(self._plan(purpose, size))
        return self._end(watch)

    def _begin_beside(self) -> None:
        """Begin to evaluate the weights that were last published, alongside training."""
        self._run.hub.begin_evaluation(self._plan(Purpose.EVALUATION, evaluation_size(self._config)), beside=True)

    def _plan(self, purpose: Purpose, size: EvaluationSize) -> EvaluationPlan:
        plan = EvaluationPlan.of(size.episodes, self._config.seed, self._config.eval_copies, size.max_steps, purpose)
        pool = self._tally.pool
        return replace(plan, time_limit=self._time_limit, opponents=() if pool is None else pool.yardsticks)

    def _end(self, watch: Callable[[], None]) -> Evaluation:
        """Wait for the pending evaluation, and return it."""
        played = self._run.hub.end_evaluation(lambda played, env_steps: watch())
        return evaluation_of(played, self._run.spec.facts)

    def _keep_if_best(self, evaluation: Evaluation, env_steps: int, policy: Callable[[], tuple[Floats, Floats]]) -> None:
        """Keep the evaluated policy, reached after `env_steps`, as the best, unless an earlier policy was better.

        In a tie, the newer policy is kept, because it has learned for longer. This matters if all returns are equal, as in a
        zero-sum game that the policy plays against itself, because there is no other criterion.
        """
        state = self._state
        if state.best is None or evaluation.return_mean >= state.best[0]:
            state.best = (evaluation.return_mean, env_steps)
            state.best_policy = policy()
            self.write_best()


def _smaller(size: EvaluationSize, usual: EvaluationSize) -> str:
    """A line that says that an evaluation is smaller than usual, and why."""
    steps = f" and at most {size.max_steps:,} env steps" if size.max_steps < usual.max_steps else ""
    why = "because the training was short; --eval-episodes sets another number"
    return f"the evaluation has {size.episodes} episodes{steps}, {why}"
