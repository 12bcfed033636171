"""Decisions by settings and numbers: when a run stops, when a checkpoint is due, how large an evaluation is. Pure."""

from __future__ import annotations

from typing import NamedTuple

from learner.config.config import Config

MOST_EPISODES, FEWEST_EPISODES = 100, 10  # of an evaluation whose number of episodes is not set
LONGEST_EPISODE = 10  # its episodes are cut after so many times the mean length of training, if there is no time limit


def reason_to_stop(
    config: Config, *, env_steps_after_next_update: int, evaluation_return: float | None, training_return: float | None
) -> str | None:
    """Why the run should end now, or None.

    `evaluation_return`: mean return of the newest greedy evaluation, if there was one. `training_return`: mean return of
    the last episodes of training, if there were enough of them.
    """
    target = config.target_return
    if target is not None and evaluation_return is not None and evaluation_return >= target:
        return f"target return {target:g} reached"
    target = config.target_mean_return
    if target is not None and training_return is not None and training_return >= target:
        return f"mean return {target:g} of the last episodes reached"
    return "all steps done" if env_steps_after_next_update > config.steps else None


def checkpoint_is_due(config: Config, *, since_last_s: float, updates: int) -> bool:
    """Whether to write a checkpoint, `since_last_s` after the last one and after `updates` in all.

    The first update is saved at once: until then a killed run has nothing to resume.
    """
    return updates == 1 or since_last_s >= config.checkpoint_every_s


class EvaluationSize(NamedTuple):
    """How large one evaluation is."""

    episodes: int
    max_steps: int
    """largest number of env steps, of all episodes together"""


def evaluation_size(config: Config) -> EvaluationSize:
    """The size of an evaluation during training."""
    return EvaluationSize(MOST_EPISODES if config.eval_episodes is None else config.eval_episodes, config.eval_max_steps)


def final_evaluation_size(
    config: Config, env_steps: int, episode_length: float | None, time_limit: int | None
) -> EvaluationSize:
    """The size of the evaluation after training.

    `env_steps`: of the training. `episode_length`: mean length of its last episodes, in env steps; None if none has
    ended. `time_limit`: env steps after which the environment truncates an episode of an evaluation, if it does. The
    size depends on these counts, and not on seconds, so that the result of a run is always the same.
    """
    if config.eval_episodes is not None or config.eval_every:
        return evaluation_size(config)
    budget, most = 3 * env_steps // 4, config.eval_max_steps
    length = time_limit or episode_length
    if length is None:  # episodes may have no end
        return EvaluationSize(FEWEST_EPISODES, max(min(most, budget), 1))
    episodes = min(max(int(budget / max(length, 1.0)), FEWEST_EPISODES), MOST_EPISODES)
    if time_limit is not None:
        return EvaluationSize(episodes, most)
    # A greedy policy may last for ever where the policies of training did not.
    return EvaluationSize(episodes, min(most, max(budget, int(LONGEST_EPISODE * episodes * length))))
