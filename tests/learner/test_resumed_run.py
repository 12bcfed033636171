"""What a resumed run takes from its checkpoint: rollouts, tickets and their reason to stop; and what is refused."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
import torch

from millrace.learner.algorithms.ppo import PPO
from millrace.learner.between_updates.crowded_cores import CrowdedCores
from millrace.learner.between_updates.run_files import RunFiles
from millrace.learner.between_updates.tally import Tally
from millrace.learner.config.config import Config
from millrace.learner.config.hyperparameters import PPOConfig
from millrace.learner.config.layers import resolve
from millrace.learner.resume_checks import unless_finished
from millrace.learner.rollouts.hub import StageTimes
from millrace.learner.rollouts.ledger import Ledger
from millrace.learner.rollouts.opponent_pool import PoolState, Snapshot
from millrace.learner.rollouts.past_rollouts import PastRollouts
from millrace.learner.rollouts.rollout_dealer import AcceptedRollout
from millrace.learner.run_folder import checkpoint
from millrace.learner.run_folder.results import EvaluatedPolicy, Evaluation, Summary
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.learner.run_state import RunState, SavedRun, restore
from millrace.learner.train import train
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import CheckpointError
from millrace.protocol.rollout import Batch, stack_rollouts
from tests.support.conversation.fake_ends import fake_rollout
from tests.support.conversation.fake_ends import run_spec as fake_run_spec
from tests.support.in_process.collectors import random_weights
from tests.support.in_process.described import run_spec


def ppo(config: Config) -> PPOConfig:
    assert isinstance(config.algorithm, PPOConfig)
    return config.algorithm


def test_the_seconds_of_stages_go_on_after_a_resume() -> None:
    saved = SavedRun(stages={"learner_wait": 10.0, "learner_evaluate": 4.0, "worker_step": 7.0})
    tally = Tally(resolve("CartPole-v1"), fake_run_spec(), saved)
    tally.updated(1.5)
    times = StageTimes(wait_s=2.0, learn_s=3.5, worker_stages={"step": 1.0, "act": 0.5})
    assert tally.stages(times) == {
        "learner_wait": 12.0,
        "learner_update": 1.5,
        "learner_other": 2.0,
        "learner_evaluate": 4.0,
        "worker_step": 8.0,
        "worker_act": 0.5,
    }


def test_an_update_gets_what_the_coordinator_says_of_each_rollout() -> None:
    """A rollout of a lane that is not its first and continues nothing, as after a lost one, is fresh in the batch."""
    sequences_and_fresh = {2: (0, True), 0: (5, True), 1: (5, False)}  # of each lane, as they arrive
    arrived = [
        AcceptedRollout(fake_rollout(1, lane, lane, 0, sequence), 0, fresh)
        for lane, (sequence, fresh) in sequences_and_fresh.items()
    ]
    batches: list[Batch] = []

    def update(batch: Batch, pulse: object) -> dict[str, float]:
        batches.append(batch)
        return {}

    policy = fake_run_spec().policy
    algorithm = SimpleNamespace(
        weights=lambda: random_weights(policy),
        update=update,
        remember=lambda: None,
        roll_back=lambda: None,
        is_finite=lambda: True,
    )
    service = MagicMock(gather=lambda show: arrived)
    tally = MagicMock(stop_reason=MagicMock(side_effect=[None, "done"]))
    run = MagicMock(parts=SimpleNamespace(algorithm=algorithm, spec=fake_run_spec(), hub=service, tally=tally))
    train(run, 1, CrowdedCores(0))
    (batch,) = batches
    assert batch.lane.tolist() == [0, 1, 2]
    assert batch.fresh.tolist() == [True, False, True]
    assert stack_rollouts([one.rollout for one in arrived]).fresh.tolist() == [False, False, True]


@pytest.mark.parametrize(
    ("raises", "called"),
    [
        ("remember", ["remember", "not_used"]),
        ("update", ["remember", "update", "roll_back", "not_used"]),
        ("update roll_back", ["remember", "update", "roll_back", "not_used"]),
    ],
)
def test_the_rollouts_of_an_update_that_was_not_made_wait_again_wherever_it_ended(raises: str, called: list[str]) -> None:
    """A second Ctrl-C raises anywhere. Until `remember` has returned, there is nothing to roll back to."""
    calls: list[str] = []

    def does(name: str) -> None:
        calls.append(name)
        if name in raises.split():
            raise KeyboardInterrupt(name)

    algorithm = SimpleNamespace(
        weights=lambda: random_weights(fake_run_spec().policy),
        remember=lambda: does("remember"),
        update=lambda batch, pulse: does("update"),
        roll_back=lambda: does("roll_back"),
    )
    arrived = [AcceptedRollout(fake_rollout(1, 0, 0, 0, 0), 0)]
    service = MagicMock(gather=lambda show: arrived, not_used=lambda taken: does("not_used"))
    tally = MagicMock(stop_reason=lambda: None)
    run = MagicMock(parts=SimpleNamespace(algorithm=algorithm, spec=fake_run_spec(), hub=service, tally=tally))
    run.files.is_whole = True
    with pytest.raises(KeyboardInterrupt, match=raises.split()[-1]):
        train(run, 1, CrowdedCores(0))
    assert calls == called
    assert run.files.is_whole == ("roll_back" not in raises)


@pytest.mark.parametrize("is_whole", [True, False])
def test_only_a_whole_algorithm_is_saved_after_an_error(is_whole: bool) -> None:
    files = MagicMock(is_whole=is_whole)
    RunFiles.save_after_error(files, KeyboardInterrupt())
    assert files.save_unless_saved.called == files.confirm_saved.called == is_whole


def test_tickets_of_the_learner_that_died_are_lost_and_the_ledger_balances(tmp_path: Path) -> None:
    config = resolve("CartPole-v1", run_dir=str(tmp_path))
    run = run_spec(config, EnvSpec("CartPole-v1"))
    algorithm = PPO(ppo(config), run.policy, total_steps=1, seed=1)
    folder = RunFolder.create(config)
    saved = SavedRun(rollouts=PastRollouts(Ledger(issued=10, used=6, transitions_received=80, transitions_used=60)))
    checkpoint.save(folder.path, saved.checkpoint_content(algorithm), env_steps=60, keep=1)
    ledger = restore(folder, algorithm).rollouts.ledger
    assert (ledger.lost, ledger.outstanding, ledger.transitions_late, ledger.transitions_waiting) == (4, 0, 20, 0)


def test_a_checkpoint_of_another_network_is_refused_in_one_line(tmp_path: Path) -> None:
    config = resolve("CartPole-v1", run_dir=str(tmp_path))
    run = run_spec(config, EnvSpec("CartPole-v1"))
    folder = RunFolder.create(config)
    narrower = PPO(ppo(config), run.policy, total_steps=1, seed=1)
    checkpoint.save(folder.path, SavedRun().checkpoint_content(narrower), env_steps=0, keep=1)
    wider = resolve("CartPole-v1", net=(32, 32), run_dir=str(tmp_path))
    other = PPO(ppo(wider), run_spec(wider, EnvSpec("CartPole-v1")).policy, total_steps=1, seed=1)
    with pytest.raises(CheckpointError, match="expected the state of this configuration") as failure:
        restore(folder, other)
    assert "\n" not in str(failure.value)


def is_finished(config: Config, run: Path) -> bool:
    """Whether the run is not launched again."""
    launched: list[object] = []

    def launch(checked: object) -> Path:
        launched.append(checked)
        return run

    assert unless_finished(config, run, launch) == run
    return not launched


def test_a_run_is_finished_while_its_reason_to_stop_holds(tmp_path: Path) -> None:
    config = resolve("CartPole-v1", steps=1000, target_return=400.0, run_dir=str(tmp_path))
    per_update = config.algorithm.rollout_steps * config.envs
    folder = RunFolder.create(config)
    assert not is_finished(config, folder.path), "it has no summary"

    def summary(**changes: Any) -> Summary:
        fields: dict[str, Any] = {"env": "CartPole-v1", "algo": "ppo", "seed": 1, "updates": 3, "wall_s": 1.0}
        fields |= {"env_steps": 900, "env_steps_per_s": 1.0, "stop_reason": "all steps done", "return_mean_100": None}
        evaluation = Evaluation(episodes=1, return_mean=100.0, return_std=0.0, length_mean=100.0)
        return Summary(**{**fields, "evaluation": evaluation, **changes})

    folder.write_summary(summary())
    assert is_finished(config, folder.path)
    beside = "target return 400 reached by the policy of 600 env steps"
    folder.write_summary(summary(stop_reason=beside, ended_by=401.0))
    assert is_finished(config, folder.path), "by an evaluation beside training"
    assert not is_finished(resolve(resume=folder.path, target_return=402.0), folder.path)
    folder.write_summary(summary())
    assert is_finished(resolve(resume=folder.path, target_return=100.0), folder.path), "nothing is left to train"
    assert not is_finished(resolve(resume=folder.path, steps=900 + per_update), folder.path)
    folder.write_summary(summary(return_mean_100=500.0))
    both = resolve(resume=folder.path, target_return=100.0, target_mean_return=300.0)
    assert is_finished(both, folder.path), "neither the final policy's evaluation nor the mean of few episodes ended it"
    folder.write_summary(summary(return_mean_100=500.0, stop_reason="mean return 300 of the last episodes reached"))
    assert is_finished(both, folder.path)
    assert not is_finished(resolve(resume=folder.path, target_mean_return=501.0), folder.path)
    for unfinished in ({"evaluation": None}, {"stop_reason": "interrupted"}, {"env_steps": 1000 - per_update}):
        folder.write_summary(summary(**unfinished))
        assert not is_finished(config, folder.path), unfinished


@pytest.mark.parametrize(
    ("part", "wrong"),
    [
        ("past", {"state": {"version": -1}}), ("past", {"state": {"env_steps": 2**64}}), ("past", {"wall_s": float("inf")}),
        ("past", {"episodes": [[]]}), ("past", {"facts": ["a"], "episodes": [[1.0, 2, 3.0, [4.0]], [1.0, 2, 3.0, []]]}),
        ("past", {"env_attributes": {"sent": b"\xc1"}}), ("past", {"env_attributes": {"waiting": b"\x01"}}),
        ("rollouts", torch.zeros(2, dtype=torch.uint8)), ("rollouts", None),
        ("best_policy", ["x"]), ("best_policy", 1), ("algorithm", []), ("algorithm", {"observations": []}),
        ("algorithm", {"rewards": {"moments": "x"}}),
    ],
)  # fmt: skip
def test_a_checkpoint_of_another_structure_is_one_line(tmp_path: Path, part: str, wrong: Any) -> None:
    config = resolve("CartPole-v1", run_dir=str(tmp_path), normalize_observations=True)
    algorithm = PPO(ppo(config), run_spec(config, EnvSpec("CartPole-v1")).policy, total_steps=100, seed=1)
    content = SavedRun().checkpoint_content(algorithm)
    content[part] = content[part] | wrong if isinstance(wrong, dict) else wrong
    folder = RunFolder.create(config)
    checkpoint.save(folder.path, content, env_steps=0, keep=3)
    with pytest.raises(CheckpointError, match="expected the state of this configuration, got another"):
        restore(folder, algorithm)


@pytest.mark.parametrize(
    ("says", "policy"),
    [
        ({"best": (1.0, 10)}, {"best_policy": None}),
        ({"best": (1.0, 10)}, {"best_policy": "a number fewer"}),
        ({"best": (1.0, 10)}, {"best_policy": "float64"}),
        ({}, {"best_policy": "one"}),
        ({"pending": EvaluatedPolicy(1, 10)}, {"pending_policy": None}),
        ({"pending": EvaluatedPolicy(1, 10)}, {"pending_policy": "a number fewer"}),
        ({"opponents": PoolState(snapshots=[Snapshot(0, 0, 1200.0)] * 2)}, {"opponent_policies": None}),
        ({"opponents": PoolState(snapshots=[Snapshot(0, 0, 1200.0)] * 2)}, {"opponent_policies": "one"}),
    ],
)
def test_a_policy_that_a_checkpoint_speaks_of_is_in_it(tmp_path: Path, says: dict[str, Any], policy: dict[str, Any]) -> None:
    config = resolve("CartPole-v1", run_dir=str(tmp_path))
    algorithm = PPO(ppo(config), run_spec(config, EnvSpec("CartPole-v1")).policy, total_steps=100, seed=1)
    own = [torch.from_numpy(array) for array in algorithm.weights()]
    made = {
        None: None,
        "one": own,
        "a number fewer": [own[0][1:], own[1]],
        "float64": [each.double() for each in own],
    }
    content = SavedRun(state=RunState(**says)).checkpoint_content(algorithm) | {
        name: made[kind] for name, kind in policy.items()
    }
    folder = RunFolder.create(config)
    checkpoint.save(folder.path, content, env_steps=0, keep=3)
    with pytest.raises(CheckpointError, match=f"got another \\({next(iter(policy))}: expected ") as refused:
        restore(folder, algorithm)
    assert "\n" not in str(refused.value)
