"""How many episodes and env steps an evaluation has. Pure."""

from __future__ import annotations

from typing import NamedTuple

from millrace.learner.config.config import Config

MOST_EPISODES = 100  # the largest number of episodes in an evaluation, unless the settings give a number
FEWEST_EPISODES = 10
LONGEST_EPISODE = 10  # without a time limit, episodes are cut at this many times the mean length of training episodes


class EvaluationSize(NamedTuple):
    """The size of one evaluation."""

    episodes: int
    max_steps: int
    """the largest number of env steps, summed over all episodes"""


def evaluation_size(config: Config) -> EvaluationSize:
    """The size of an evaluation during training."""
    return EvaluationSize(MOST_EPISODES if config.eval_episodes is None else config.eval_episodes, config.eval_max_steps)


def final_evaluation_size(
    config: Config, env_steps: int, episode_length: float | None, time_limit: int | None
) -> EvaluationSize:
    """The size of the evaluation after training.

    `env_steps` is the number of env steps in training. `episode_length` is the mean length of the last training episodes, in
    env steps, or None if no episode has ended. `time_limit` is the number of env steps after which the environment truncates
    an evaluation episode, or None if it doesn't. The size depends on these counts, not on seconds, so that a repeated run
    gives the same result.
    """
    if config.eval_episodes is not None or config.eval_every:
        return evaluation_size(config)
    budget = 3 * env_steps // 4
    most = config.eval_max_steps
    length = time_limit or episode_length
    if length is None:  # no episode has ended, so episodes may never end
        return EvaluationSize(FEWEST_EPISODES, max(min(most, budget), 1))
    episodes = min(max(int(budget / max(length, 1.0)), FEWEST_EPISODES), MOST_EPISODES)
    if time_limit is not None:
        return EvaluationSize(episodes, most)
    # An episode of the greedy policy may never end, even if all training episodes did.
    return EvaluationSize(episodes, min(most, max(budget, int(LONGEST_EPISODE * episodes * length))))
