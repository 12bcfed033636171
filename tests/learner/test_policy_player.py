"""A run folder is enough to act again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from learner.config.layers import resolve
from learner.policy_player import load_policy, saved_policy
from learner.run_folder.run_folder import RunFolder
from protocol.env_spec import EnvSpec
from protocol.envs.spaces import action_spec, observation_leaves
from protocol.errors import UsageError
from protocol.policy.layout import acting_size, buffer_size
from protocol.policy.recurrent import zero_state
from protocol.specs import PolicySpec


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_a_run_folder_is_enough_to_act_again(tmp_path: Path, env_id: str) -> None:
    env = EnvSpec(env_id)
    made = env.make()
    spec = PolicySpec(
        observation_leaves(made.observation_space), action_spec(made.action_space), net=(8, 8), normalize_observations=True
    )
    rng = np.random.default_rng(0)
    folder = RunFolder.create(resolve(env_id, run_dir=str(tmp_path)))
    parameters = rng.standard_normal(acting_size(spec), dtype=np.float32)
    folder.write_policy(spec, env, parameters, rng.random(buffer_size(spec), dtype=np.float32) + 0.5)
    policy, found_spec, found_env = load_policy(folder.path)
    assert (found_spec, found_env) == (spec, env)
    seen = [rng.standard_normal((1, 3, *leaf.shape), dtype=np.float32) for leaf in spec.observation]
    first = policy(seen, zero_state(spec, 1, 3))
    assert np.array_equal(first, load_policy(folder.path)[0](seen, zero_state(spec, 1, 3)))
    folder.write_policy(spec, env, -parameters, np.ones(buffer_size(spec), np.float32))
    assert not np.array_equal(first, load_policy(folder.path)[0](seen, zero_state(spec, 1, 3)))


@pytest.mark.parametrize("older", [False, True])
def test_the_numbers_that_a_run_logs_of_its_episodes_stand_in_policy_json(tmp_path: Path, older: bool) -> None:
    """An older run folder has them in its config.toml alone."""
    env = EnvSpec("CartPole-v1")
    made = env.make()
    spec = PolicySpec(observation_leaves(made.observation_space), action_spec(made.action_space), net=(8,))
    folder = RunFolder.create(resolve("CartPole-v1", run_dir=str(tmp_path), info_keys="of_config"))
    folder.write_policy(spec, env, np.zeros(acting_size(spec), np.float32), np.zeros(0, np.float32), facts=("of_card",))
    card = folder.path / "policy.json"
    if older:
        fields = json.loads(card.read_text())
        del fields["facts"]
        card.write_text(json.dumps(fields))
    assert saved_policy(folder.path).facts == (("of_config",) if older else ("of_card",))
    (folder.path / "config.toml").write_text("no TOML")
    assert saved_policy(folder.path).facts == (() if older else ("of_card",))


def test_a_folder_without_a_policy_is_said(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such folder"):
        load_policy(tmp_path / "nowhere")
