"""What a run decides by its settings and by numbers."""

from typing import Any

import pytest

from millrace.learner.between_updates.stop_rules import reason_to_stop
from millrace.learner.config.config import Config
from millrace.learner.config.evaluation_size import evaluation_size, final_evaluation_size
from millrace.learner.run_folder.checkpoint import CheckpointSchedule
from millrace.learner.run_folder.results import DecidingReturns


def reason(config: Config, env_steps_after_next_update: int = 0, **returns: Any) -> str | None:
    return reason_to_stop(config, DecidingReturns(**returns), env_steps_after_next_update=env_steps_after_next_update)


def test_a_run_ends_when_one_more_update_would_pass_its_steps() -> None:
    config = Config(steps=100)
    assert reason(config, env_steps_after_next_update=100) is None
    assert reason(config, env_steps_after_next_update=101) == "all steps done"


def test_a_run_ends_when_a_target_is_reached() -> None:
    config = Config(target_return=475.0, target_mean_return=300.0)
    assert reason(config) is None
    assert reason(config, evaluation=474.9, training=299.9) is None
    assert reason(config, evaluation=475.0) == "target return 475 reached"
    assert reason(config, training=300.0) == "mean return 300 of the last episodes reached"
    assert reason(Config(), evaluation=1e9, training=1e9) is None


@pytest.mark.parametrize(
    ("every_s", "since_last_s", "updates", "due"),
    [(60.0, 59.9, 0, False), (60.0, 60.0, 0, True), (60.0, 0.0, 1000, False), (0.0, 0.0, 2, True), (60.0, 0.0, 1, True)],
)
def test_a_checkpoint_is_due_after_the_first_update_and_by_time(
    every_s: float, since_last_s: float, updates: int, due: bool
) -> None:
    schedule = CheckpointSchedule(every_s, now=0.0)
    schedule.saved(100.0)
    assert schedule.is_due(updates, 100.0 + since_last_s) is due


@pytest.mark.parametrize(
    ("settings", "env_steps", "episode_length", "time_limit", "size"),
    [
        ({}, 100_000, 500.0, 500, (100, 1_000_000)),
        ({}, 5_000, 20.0, 500, (10, 1_000_000)),  # a better policy may last as long as the time limit
        ({}, 100_000, 1000.0, 1000, (75, 1_000_000)),
        ({}, 100_000, 50_000.0, 60_000, (10, 1_000_000)),
        ({}, 600, None, 200, (10, 1_000_000)),
        ({}, 100_000, None, 1000, (75, 1_000_000)),
        ({}, 100_000, 1.0, None, (100, 75_000)),
        ({}, 100_000, 1000.0, None, (75, 750_000)),
        ({}, 1_000, 90.0, None, (10, 9_000)),
        ({}, 100_000, None, None, (10, 75_000)),
        ({}, 0, None, None, (10, 1)),
        ({"eval_max_steps": 500}, 100_000, None, None, (10, 500)),
        ({"eval_max_steps": 500}, 100_000, 40.0, None, (100, 500)),
        ({"eval_episodes": 100}, 100_000, 50_000.0, None, (100, 1_000_000)),
        ({"eval_episodes": 3}, 100_000, None, None, (3, 1_000_000)),
        ({"eval_every": 10_000}, 100_000, 50_000.0, None, (100, 1_000_000)),
    ],
)
def test_the_evaluation_after_training_takes_three_quarters_of_its_env_steps_or_ten_episodes(
    settings: dict[str, Any],
    env_steps: int,
    episode_length: float | None,
    time_limit: int | None,
    size: tuple[int, int],
) -> None:
    assert final_evaluation_size(Config(**settings), env_steps, episode_length, time_limit) == size


def test_during_training_evaluations_have_a_hundred_episodes_or_as_many_as_are_set() -> None:
    assert evaluation_size(Config()) == (100, 1_000_000)
    assert evaluation_size(Config(eval_episodes=7, eval_max_steps=50)) == (7, 50)
