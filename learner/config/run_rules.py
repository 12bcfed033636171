"""Small settings records, one for each part of a run: when to stop, when to write a checkpoint, when to evaluate. Pure.

`Config` makes them. A record decides its own question from numbers that the caller gives.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec


class StopRule(msgspec.Struct, frozen=True, kw_only=True):
    """When training ends."""

    steps: int
    """env steps to train for"""
    target_return: float | None
    """mean return of a greedy evaluation that ends the run"""
    target_mean_return: float | None
    """mean return of the last training episodes that ends the run"""

    def reason_to_stop(
        self, *, env_steps_after_next_update: int, evaluation_return: float | None, training_return: float | None
    ) -> str | None:
        """Why the run should end now, or None.

        `evaluation_return`: mean return of the newest greedy evaluation, if there was one. `training_return`: mean return of
        the last episodes of training, if there were enough of them.
        """
        if self.target_return is not None and evaluation_return is not None and evaluation_return >= self.target_return:
            return f"target return {self.target_return:g} reached"
        target = self.target_mean_return
        if target is not None and training_return is not None and training_return >= target:
            return f"mean return {target:g} of the last episodes reached"
        return "all steps done" if env_steps_after_next_update > self.steps else None


class CheckpointPolicy(msgspec.Struct, frozen=True, kw_only=True):
    """When to write a checkpoint, and how many to keep."""

    every_s: float
    every_episodes: int
    """0: the number of episodes does not matter"""
    every_updates: int
    """0: the number of updates does not matter"""
    keep: int
    """how many of the newest checkpoints stay in the run folder"""

    def is_due(self, *, since_last_s: float, episodes_since_last: int, updates: int) -> bool:
        """Whether to write one now. `since_last_s` and `episodes_since_last`: since the last one; `updates`: in all.

        The first update is saved at once: until then a killed run has nothing to resume.
        """
        by_episodes = self.every_episodes > 0 and episodes_since_last >= self.every_episodes
        by_updates = self.every_updates > 0 and updates % self.every_updates == 0
        return updates == 1 or by_episodes or by_updates or self.is_time(since_last_s)

    def is_time(self, since_last_s: float) -> bool:
        """Whether the last one is so old that the time alone asks for another."""
        return since_last_s > self.every_s


MOST_EPISODES, FEWEST_EPISODES = 100, 10  # of an evaluation whose number of episodes is not set
LONGEST_EPISODE = 10  # its episodes are cut after so many times the mean length of training, if there is no time limit


class EvaluationSize(NamedTuple):
    """How large one evaluation is."""

    episodes: int
    max_steps: int
    """largest number of env steps, of all episodes together"""


class EvaluationSettings(msgspec.Struct, frozen=True, kw_only=True):
    """How often the policy is evaluated greedily, and on which episodes."""

    episodes: int | None
    """episodes of one evaluation; None: 100, and at the end of a run perhaps fewer (`final_size`)"""
    every_env_steps: int
    """env steps between evaluations during training; 0: evaluate only at the end"""
    copies: int
    """episodes that a worker plays at the same time"""
    max_steps: int
    """largest number of env steps of one evaluation"""
    seed: int
    """the run's seed: it decides which episodes are played"""

    def size(self) -> EvaluationSize:
        """The size of an evaluation during training."""
        return EvaluationSize(MOST_EPISODES if self.episodes is None else self.episodes, self.max_steps)

    def final_size(self, env_steps: int, episode_length: float | None, time_limit: int | None) -> EvaluationSize:
        """The size of the evaluation after training.

        `env_steps`: of the training. `episode_length`: mean length of its last episodes, in env steps; None if none has
        ended. `time_limit`: env steps after which the environment truncates an episode of an evaluation, if it does. The
        size depends on these counts, and not on seconds, so that the result of a run is always the same.
        """
        if self.episodes is not None or self.every_env_steps:
            return self.size()
        budget = 3 * env_steps // 4
        length = time_limit or episode_length
        if length is None:  # episodes may have no end
            return EvaluationSize(FEWEST_EPISODES, max(min(self.max_steps, budget), 1))
        episodes = min(max(int(budget / max(length, 1.0)), FEWEST_EPISODES), MOST_EPISODES)
        if time_limit is not None:
            return EvaluationSize(episodes, self.max_steps)
        # A greedy policy may last for ever where the policies of training did not.
        return EvaluationSize(episodes, min(self.max_steps, max(budget, int(LONGEST_EPISODE * episodes * length))))
