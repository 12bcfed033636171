"""Action masks in whole runs: training, evaluation, datasets, resume, acting beside the learner, own learners and policies.

The environments raise for an illegal action, so each of these runs also checks every step.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import millrace
from millrace.learner.config.layers import resolve
from millrace.learner.env_spaces import EnvSpaces
from millrace.learner.rollout_spec import rollout_spec
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import MillraceError, UsageError
from millrace.protocol.specs import PolicySpec
from tests.support.users_code.mask_envs import CHOICES, InInfo, InObservation, Parts

NAMED = "tests.support.users_code.mask_envs:{}-v0"
SMALL: dict[str, Any] = {"workers": 1, "envs": 4, "lanes": 2, "steps": 600, "eval_episodes": 4, "progress": False}
ONCE: dict[str, Any] = {"max_env_failures": 0}


def train(name: str, folder: Path, **settings: Any) -> millrace.Run:
    masks = "auto" if name == "InObservation" else "info"
    return millrace.train(
        NAMED.format(name), run_dir=str(folder), **{"action_masks": masks, "rollout_steps": 16, **SMALL, **ONCE, **settings}
    )


def leaf_paths(run: millrace.Run) -> list[str]:
    described = json.loads((Path(run) / "policy.json").read_bytes())
    assert described["masked"]
    return [leaf["path"] for leaf in described["policy"]["observation"]]


@pytest.mark.parametrize("inference", ["workers", "learner"])
@pytest.mark.parametrize("name", ["InInfo", "InObservation", "Parts"])
def test_a_run_trains_evaluates_and_plays_with_masks(name: str, inference: Any, tmp_path: Path) -> None:
    run = train(name, tmp_path, inference=inference)
    assert leaf_paths(run) == (["seen"] if name == "InObservation" else [""])
    assert millrace.evaluate(run, episodes=6, workers=1, progress=False).episodes == 6


def test_a_run_is_resumed_with_its_masks(tmp_path: Path) -> None:
    run = train("InInfo", tmp_path, algo="dqn", learning_starts=50)
    resumed = millrace.train(resume=run, steps=1200, progress=False)
    assert leaf_paths(resumed) == [""]
    with pytest.raises(UsageError, match="action_masks"):
        millrace.train(resume=run, steps=1800, action_masks="none", progress=False)


def test_without_masks_the_key_is_an_observation(tmp_path: Path) -> None:
    with pytest.raises(MillraceError, match="illegal action"):
        train("InObservation", tmp_path, action_masks="none")


def test_masks_for_a_box_action_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="action_masks info: expected an action space Discrete or MultiDiscrete, got Box"):
        millrace.train("Pendulum-v1", run_dir=str(tmp_path), action_masks="info", **SMALL)


def test_prior_data_has_no_masks_and_is_refused(tmp_path: Path) -> None:
    says = "prior toy/none-v0: a dataset has no action masks, and this run uses them; take --action-masks none"
    with pytest.raises(UsageError, match=says):
        train("InInfo", tmp_path / "runs", algo="dqn", prior="toy/none-v0")
    assert not list((tmp_path / "runs").glob("*"))


def test_envpool_has_no_masks_and_is_refused() -> None:
    env = InInfo()
    policy = PolicySpec(observation_leaves(env.observation_space), action_spec(env.action_space))
    config = resolve("Any-v0", preset="none", vector="envpool")
    spaces = EnvSpaces.of_policy(policy)
    with pytest.raises(UsageError, match="vector envpool: its environments report no action masks; use --vector loop"):
        rollout_spec(config, EnvSpec("Any-v0"), policy, 8, spaces=spaces._replace(masked=True))
    assert rollout_spec(config, EnvSpec("Any-v0"), policy, 8, spaces=spaces).vector == "envpool"


@pytest.mark.parametrize(("kind", "deterministic"), [(InInfo, True), (InInfo, False), (InObservation, True), (Parts, False)])
def test_a_loaded_policy_takes_masks(kind: Any, deterministic: bool, tmp_path: Path) -> None:
    run = train(kind.__name__, tmp_path, steps=64, eval_episodes=1)
    policy, env = millrace.load(run, deterministic=deterministic), kind()
    observation, info = env.reset(seed=1)
    forbidden = 0
    for _ in range(200):
        mask = info.get("action_mask")
        action = policy(observation, mask=mask)  # the key of a Dict observation is read without it
        observation, _, terminated, truncated, info = env.step(action)
        forbidden += 0 if mask is None else int((np.hstack(mask) == 0).sum())
        if terminated or truncated:
            observation, info = env.reset()
    assert forbidden > 0 or kind is InObservation


def test_a_loaded_policy_refuses_a_wrong_mask(tmp_path: Path) -> None:
    policy = millrace.load(train("InInfo", tmp_path, steps=64, eval_episodes=1))
    batch = np.zeros((3, CHOICES), np.float32)
    only = np.eye(CHOICES, dtype=np.int8)
    assert policy(batch, mask=only[4:7]).tolist() == [4, 5, 6]
    assert policy(batch, mask=only[2]).tolist() == [2, 2, 2]
    for mask, got in ((only[0][1:], r"int8\[6\]"), (only[:2], r"int8\[2, 7\]"), (only[0] * 0.5, r"float64\[7\]")):
        with pytest.raises(UsageError, match=f"mask: expected 7 zeros and ones .*, got {got}"):
            policy(batch, mask=mask)
    with pytest.raises(UsageError, match="mask: expected an allowed choice"):
        policy(batch, mask=only[0] * 0)


def test_training_datasets_leave_the_mask_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    run = train("InObservation", tmp_path, record="masked/train-v0")
    millrace.record(run, "masked/played-v0", steps=30, workers=1, progress=False)
    for name in ("masked/train-v0", "masked/played-v0"):
        episode = minari.load_dataset(name)[0]
        assert set(episode.observations) == {"seen"}
        allowed = episode.observations["seen"][:-1] > 0
        assert allowed[np.arange(len(episode.actions)), episode.actions].all()


class Own:
    """The first allowed action; with `illegal`, the first one that is not."""

    def __init__(self, illegal: bool = False) -> None:
        self.illegal = illegal

    def load(self, arrays: Any) -> None:
        pass

    def act(self, obs: Any, state: Any, rng: Any, *, mask: Any) -> Any:
        assert mask.dtype == bool
        return (~mask if self.illegal else mask).argmax(-1), state, {}


def test_batches_of_an_own_learner_have_masks() -> None:
    settings: dict[str, Any] = {"workers": 1, "lanes": 1, "envs": 3, "rollout_steps": 20, "transport": "inproc"}
    with millrace.RolloutService(InObservation, **settings) as service:
        service.publish(service.policy.initial(seed=1))
        batch = service.gather()
    assert batch.mask is not None
    assert batch.mask.shape == (21, 3, CHOICES)
    seen = batch.obs["seen"] if isinstance(batch.obs, dict) else batch.obs
    assert np.array_equal(batch.mask[:-1][batch.valid], seen[:-1][batch.valid] > 0)
    with millrace.RolloutService(InInfo, millrace.OwnPolicy(Own, {"w": (1,)}), action_masks="info", **settings) as service:
        service.publish({"w": np.zeros(1)})
        batch = service.gather()
        assert service.evaluate(3).episodes == 3
    assert batch.mask is not None
    assert np.array_equal(batch.action[batch.valid], batch.mask[:-1][batch.valid].argmax(-1))


def test_an_own_policy_that_takes_an_illegal_action_is_named() -> None:
    policy = millrace.OwnPolicy(Own, {"w": (1,)}, kwargs={"illegal": True})
    settings: dict[str, Any] = {"workers": 1, "lanes": 1, "envs": 3, "rollout_steps": 20, "action_masks": "info", **ONCE}
    with (
        pytest.raises(MillraceError, match="act: the action: expected one that the mask allows, got"),
        millrace.RolloutService(InInfo, policy, **settings) as service,
    ):
        service.publish({"w": np.zeros(1)})
        service.gather()


def test_the_vector_environment_gives_masks_like_any_other_info() -> None:
    with_masks = NAMED.format("InInfo")
    local = gymnasium.make_vec(with_masks, 3, vectorization_mode="sync")
    env = millrace.make_vec(with_masks, 3, workers=1)
    try:
        for _, infos in (local.reset(seed=1), env.reset(seed=1)):
            assert infos["action_mask"].shape == (3, CHOICES)
            assert infos["_action_mask"].all()
            masks = infos["action_mask"]
        actions = masks.argmax(-1)
        mine, theirs = env.step(actions)[-1], local.step(actions)[-1]
        assert np.array_equal(mine["action_mask"], theirs["action_mask"])
    finally:
        env.close()
        local.close()
