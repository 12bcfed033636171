"""How large an evaluation is, by settings and numbers. Pure."""

from __future__ import annotations

from typing import NamedTuple

from millrace.learner.config.config import Config

MOST_EPISODES = 100  # of an evaluation whose number of episodes is not set
FEWEST_EPISODES = 10
LONGEST_EPISODE = 10  # times the mean episode length of training: there episodes are cut if there is no time limit


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

    `env_steps`: number of env steps of the training. `episode_length`: mean length of its last episodes, in env steps; None
    if none has ended. `time_limit`: number of env steps after which the environment truncates an episode of an evaluation,
    if it does. The size depends on these counts, and not on seconds, so that the result of a run is always the same.
    """
    if config.eval_episodes is not None or config.eval_every:
        return evaluation_size(config)
    budget = 3 * env_steps // 4
    most = config.eval_max_steps
    length = time_limit or episode_length
    if length is None:  # episodes may have no end
        return EvaluationSize(FEWEST_EPISODES, max(min(most, budget), 1))
    episodes = min(max(int(budget / max(length, 1.0)), FEWEST_EPISODES), MOST_EPISODES)
    if time_limit is not None:
        return EvaluationSize(episodes, most)
    # An episode of a greedy policy may never end, even if those of training did.
    return EvaluationSize(episodes, min(most, max(budget, int(LONGEST_EPISODE * episodes * length))))
