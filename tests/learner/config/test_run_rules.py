"""The small settings records: what they take from the configuration, and what they decide."""

from typing import Any

import pytest

from learner.config.config import Config
from learner.config.run_rules import CheckpointPolicy, EvaluationSettings, StopRule


def reason(rule: StopRule, **numbers: Any) -> str | None:
    none = {"env_steps_after_next_update": 0, "evaluation_return": None, "training_return": None}
    return rule.reason_to_stop(**{**none, **numbers})


def test_a_run_ends_when_one_more_update_would_pass_its_steps() -> None:
    rule = Config(steps=100).stop_rule()
    assert reason(rule, env_steps_after_next_update=100) is None
    assert reason(rule, env_steps_after_next_update=101) == "all steps done"


def test_a_run_ends_when_a_target_is_reached() -> None:
    rule = Config(target_return=475.0, target_mean_return=300.0).stop_rule()
    assert reason(rule) is None
    assert reason(rule, evaluation_return=474.9, training_return=299.9) is None
    assert reason(rule, evaluation_return=475.0) == "target return 475 reached"
    assert reason(rule, training_return=300.0) == "mean return 300 of the last episodes reached"
    assert reason(Config().stop_rule(), evaluation_return=1e9, training_return=1e9) is None


@pytest.mark.parametrize(
    ("settings", "numbers", "due"),
    [
        ({}, {"since_last_s": 60.0}, False),
        ({}, {"since_last_s": 60.1}, True),
        ({}, {"episodes_since_last": 1000, "updates": 1000}, False),
        ({"checkpoint_every_episodes": 10}, {"episodes_since_last": 9}, False),
        ({"checkpoint_every_episodes": 10}, {"episodes_since_last": 10}, True),
        ({"checkpoint_every_updates": 3}, {"updates": 8}, False),
        ({"checkpoint_every_updates": 3}, {"updates": 9}, True),
    ],
)
def test_a_checkpoint_is_due_by_time_by_episodes_or_by_updates(
    settings: dict[str, Any], numbers: dict[str, Any], due: bool
) -> None:
    none: dict[str, Any] = {"since_last_s": 0.0, "episodes_since_last": 0, "updates": 1}
    assert Config(**settings).checkpoint_policy().is_due(**{**none, **numbers}) is due


def test_records_take_their_settings_from_the_configuration() -> None:
    config = Config(keep_checkpoints=7, eval_episodes=5, eval_every=1000, seed=3)
    assert config.checkpoint_policy() == CheckpointPolicy(every_s=60.0, every_episodes=0, every_updates=0, keep=7)
    assert config.evaluation_settings() == EvaluationSettings(
        episodes=5, every_env_steps=1000, copies=4, max_steps=1_000_000, seed=3
    )
