"""Counts the env steps, updates and episodes of one run. The counts decide when it ends, and when an evaluation is due.

Rule: decisions depend only on counts, so every run with the same settings makes the same decisions. The time that
evaluations take is a stage of its own and does not count as training. `run_folder/checkpoint.py` says when a checkpoint is
due. This module uses no files and no sockets.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from millrace.learner.between_updates.stop_rules import reason_to_stop, target_reached
from millrace.learner.config.config import Config
from millrace.learner.rollouts.hub import StageTimes
from millrace.learner.rollouts.opponent_pool import OpponentPool
from millrace.learner.run_folder.episode_window import EpisodeWindow
from millrace.learner.run_folder.results import DecidingReturns
from millrace.learner.run_state import SavedRun
from millrace.protocol.rollout import Batch, Episode
from millrace.protocol.specs import RunSpec


class Tally:
    """The counts of one run."""

    def __init__(
        self,
        config: Config,
        spec: RunSpec,
        saved: SavedRun,
        ended_by: Callable[[], str | None] = lambda: None,
        pool: OpponentPool | None = None,
    ) -> None:
        """`saved` is what the run continues from. `ended_by` returns why a callback has ended the run, or None if none has.

        `pool` holds the opponents in self-play, if there are any.
        """
        self.pool = pool
        self.state = state = saved.state
        """The run's state. Evaluations change it too."""
        self.window = EpisodeWindow.from_state(saved.episodes, saved.facts, spec.facts)
        self.new_episodes: tuple[Episode, ...] = ()
        """The episodes that ended in the rollouts of the last update."""
        due_at = state.env_steps + config.eval_every
        state.next_evaluation = min(state.next_evaluation or due_at, due_at)
        self.note = ""
        """A line for the user about the newest evaluation."""
        self.gathered_s = 0.0
        """Seconds that `on_rollouts` callbacks and the dataset took for the next update's rollouts."""
        self._ended_by = ended_by
        self._config = config
        self._steps_per_update = spec.rollout_steps * config.envs
        self._update_s = 0.0
        self.wall_before_s = saved.wall_s
        self._stages_before = dict(saved.stages)
        self.steps_before = state.env_steps
        self._started_s = time.monotonic()

    def count(self, batch: Batch) -> None:
        """Count an update with this batch."""
        self.state.ended_with = None
        self.state.version += 1
        self.state.env_steps += batch.env_steps
        self.window.extend(batch.episodes)
        if self.pool is not None:
            self.pool.played(batch.episodes)
        self.new_episodes = batch.episodes

    def ratings(self) -> dict[str, float]:
        """The metrics of self-play."""
        return {} if self.pool is None else self.pool.metrics()

    def stop_reason(self) -> str | None:
        """Why the run should end now; None if it should continue."""
        return self._ended_by() or self._reason(self._deciding())

    def training_ended(self) -> None:
        """Record the returns with which training ended, so that later evaluations don't change why it ended."""
        self.state.ended_with = self._deciding()

    def decided_by_evaluation(self) -> DecidingReturns | None:
        """The returns with which the run ends, if it ends because of an evaluation; otherwise None.

        This includes a run that a callback ended after the newest policy was evaluated, because the evaluation may have been
        the callback's reason.
        """
        returns = self.state.ended_with or self._returns()
        of_newest = returns.evaluation is not None and returns.evaluated_before is None
        decided = of_newest if self._ended_by() is not None else target_reached(self._config, returns)
        return returns if decided else None

    def training_goes_on(self) -> bool:
        """Whether the next rollouts may be collected now, because no evaluation is due and the run doesn't end now."""
        return not self.evaluation_is_due() and self.stop_reason() is None

    # ---------------------------------------------------------------- evaluations

    def evaluation_is_due(self) -> bool:
        """Whether an evaluation is due. No more are due once a callback has ended the run."""
        due = self._config.eval_every and self.state.env_steps >= self.state.next_evaluation
        return bool(due) and self._ended_by() is None

    def evaluated(self) -> None:
        """Count the evaluation that was due. The next one is due at the next multiple of `eval_every` not yet reached."""
        every = self._config.eval_every
        state = self.state
        state.next_evaluation += every * (1 + (state.env_steps - state.next_evaluation) // every)

    # ---------------------------------------------------------------- seconds

    def updated(self, seconds: float) -> None:
        """Count the time of an update: the `seconds` from the arrival of its rollouts until its weights were published.

        `seconds` includes the time that callbacks and the dataset took for the rollouts. This time is subtracted here.
        """
        self._update_s += seconds - self.gathered_s

    def stages(self, times: StageTimes) -> dict[str, float]:
        """Seconds in each stage of the learner, and in each stage of all workers together, as of their last heartbeats.

        These seconds include the time before the run was resumed.
        """
        other_s = times.learn_s - self._update_s
        since = {"learner_wait": times.wait_s, "learner_update": self._update_s, "learner_other": other_s}
        since |= {"learner_evaluate": times.evaluate_s} if times.evaluate_s else {}
        since |= {f"worker_{name}": seconds for name, seconds in times.worker_stages.items()}
        before = self._stages_before
        return {name: before.get(name, 0.0) + since.get(name, 0.0) for name in since | before}

    def wall_s(self, times: StageTimes) -> float:
        """Seconds of training so far, without evaluations but including the time before the run was resumed."""
        return self.wall_before_s + times.at_s - self._started_s - times.evaluate_s

    # ---------------------------------------------------------------- inside

    def _reason(self, returns: DecidingReturns) -> str | None:
        after_next = self.state.env_steps + self._steps_per_update if self.state.version else 0
        return reason_to_stop(self._config, returns, env_steps_after_next_update=after_next)

    def _deciding(self) -> DecidingReturns:
        """The returns that decide whether the run stops: the current ones, unless training has ended with others.

        The current returns also decide if the run was resumed with settings for which the returns at the end of its training
        give no reason to stop.
        """
        ended_with = self.state.ended_with
        return self._returns() if ended_with is None or self._reason(ended_with) is None else ended_with

    def _returns(self) -> DecidingReturns:
        """The current returns."""
        state = self.state
        newest = state.newest_evaluation
        return DecidingReturns(
            evaluation=None if newest is None else newest.return_mean,
            evaluated_before=state.evaluated.env_steps if state.evaluated.version != state.version else None,
            training=self.window.return_mean if self.window.full else None,
        )
