"""Evaluation by real workers: as fast as there are workers, the same for any number of them, and it can be stopped."""

from __future__ import annotations

import json
import re
import signal
import sys
import time
from pathlib import Path
from typing import Any, Literal

import pytest

import millrace
from millrace.launch.policy_workers import PlayingWorkers, policy_player
from millrace.launch.training import train
from millrace.learner.config.layers import resolve
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.policy_player import SavedPolicy
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan
from millrace.learner.run_folder.metrics_log import read_rows
from millrace.protocol.errors import EnvironmentFailed, UserFacingError
from millrace.protocol.specs import SessionTerms
from tests.support.gymnasium_versions import CLIFF
from tests.support.in_process.collectors import TOY, random_weights, run_of
from tests.support.in_process.saved_policies import policy_of_run
from tests.system.stage.processes import START_S, Stage, crowding, wait_for
from tests.system.stage.run_folders import policy_of

EVERY_TRANSPORT: list[Literal["inproc", "ipc", "tcp"]] = ["inproc", "ipc", "tcp"]


def silent(text: str) -> None:
    """Shows nothing."""


def untrained(env: str, kwargs: dict[str, Any] | None = None) -> SavedPolicy:
    """A policy with random weights."""
    run = run_of(env, kwargs=kwargs)
    return policy_of_run(run, *random_weights(run.policy))


@pytest.mark.parametrize("env", ["CartPole-v1", pytest.param("Pendulum-v1", marks=pytest.mark.soak)])
def test_the_returns_are_the_same_bits_for_any_number_of_workers_over_any_transport(env: str) -> None:
    policy, plan = untrained(env), EvaluationPlan.of(18, seed=5, copies=4, max_steps=18 * 120)
    found = {}
    for transport in EVERY_TRANSPORT:
        for workers in (1, 2, 4):
            with policy_player(policy, PlayingWorkers(workers, transport), silent) as player:
                played = player.play(plan)
            found[transport, workers] = [(one.episode.reward, one.episode.length, one.cut) for one in played]
    first = found["inproc", 1]
    assert len({reward for reward, _, _ in first}) > 2
    assert not {key for key, figures in found.items() if figures != first}


@pytest.mark.parametrize("inference", ["workers", "learner"])
def test_evaluations_of_a_run_and_of_its_policy_have_their_own_arguments_of_the_environment(
    inference: Literal["workers", "learner"], tmp_path: Path
) -> None:
    """CartPole pays 1 for each step; with the reward of Sutton and Barto, 0, and -1 at the end."""
    given: dict[str, Any] = {"steps": 600, "workers": 1, "run_dir": str(tmp_path), "eval_episodes": 5, "progress": False}
    run = millrace.train(
        "CartPole-v1", inference=inference, n_epochs=1, eval_env_kwargs={"sutton_barto_reward": True}, **given
    )
    assert run.summary is not None
    assert run.summary.evaluation is not None
    assert run.summary.evaluation.return_mean == -1
    assert run.metrics["rollout/ep_rew_mean"][-1] > 5
    assert run.evaluate(episodes=3, workers=1, inference=inference).return_mean == -1


@pytest.mark.parametrize(
    ("kwargs", "says"),
    [
        ({"nonsense": 1}, "unexpected keyword argument 'nonsense'"),
        ({"observation": "image"}, "eval_env_kwargs: expected the spaces of training"),
    ],
)
@pytest.mark.parametrize("inference", ["workers", "learner"])
def test_wrong_arguments_of_evaluations_are_refused_before_training(
    kwargs: dict[str, Any], says: str, inference: Literal["workers", "learner"], tmp_path: Path
) -> None:
    with pytest.raises(UserFacingError, match=says) as caught:
        millrace.train(
            "tests.support.envs.toy:Spaces-v0", inference=inference, steps=10_000, workers=1, run_dir=str(tmp_path / "runs"),
            progress=False, eval_env_kwargs=kwargs,
        )  # fmt: skip
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "runs").exists(), "a run folder was left"


def test_the_evaluation_after_a_short_run_is_small_and_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Episodes of CartPole-v1 last about 20 steps at first: 300 env steps hold 10 of them."""
    given: dict[str, Any] = {"steps": 300, "rollout_steps": 16, "workers": 1, "run_dir": str(tmp_path), "progress": False}
    run = millrace.train("CartPole-v1", **given)
    assert run.summary is not None
    assert run.summary.evaluation is not None
    assert 10 <= run.summary.evaluation.episodes < 40
    assert any("the evaluation has" in record.getMessage() for record in caplog.records)
    assert millrace.train("CartPole-v1", resume=run, workers=1, progress=False).summary == run.summary


def test_a_run_reports_the_same_evaluation_whatever_the_number_of_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    often = SessionTerms(heartbeat_s=0.05)  # the figures of workers come with heartbeats
    monkeypatch.setattr(RolloutConfig, "terms", lambda self: often)
    settings: dict[str, Any] = {
        "steps": 3_000, "eval_every": 1_000, "eval_episodes": 10, "seed": 3, "n_epochs": 2,
    }  # fmt: skip
    found = []
    for workers, inference in ((1, "workers"), (3, "workers"), (2, "learner")):
        config = resolve(
            "CartPole-v1", run_dir=str(tmp_path / f"{workers}"), workers=workers, inference=inference, **settings
        )
        folder = train(config, None, lambda progress: None)
        summary = json.loads((folder / "summary.json").read_text())
        rows = read_rows(folder / "metrics.jsonl")
        evaluations = [row["eval/mean_reward"] for row in rows if "eval/mean_reward" in row]
        assert len(evaluations) >= 2
        assert len(rows) == summary["updates"], "an evaluation has no row of its own"
        found.append((evaluations, summary["evaluation"], summary["best"], policy_of(folder)))
        assert summary["stages"]["learner_evaluate"] > 0
        assert summary["stages"]["worker_evaluate"] > 0
    assert found[0] == found[1] == found[2]


def test_four_workers_take_at_most_two_fifths_of_the_time_of_one() -> None:
    """100 episodes of a 5 ms environment."""
    policy, seconds = untrained(f"{TOY}Slow-v0", {"seconds": 0.005, "k": 8}), {}
    plan = EvaluationPlan.of(100, seed=5, copies=4, max_steps=1_000_000)
    warm_up = EvaluationPlan.of(16, seed=1, copies=1, max_steps=16)
    for workers in (1, 4):
        with policy_player(policy, PlayingWorkers(workers), silent) as player:
            deadline_s = time.monotonic() + START_S
            player.play(warm_up)
            while player.workers < workers:
                assert time.monotonic() < deadline_s
                player.play(warm_up)
            began_s = time.monotonic()
            assert len(player.play(plan)) == 100
            seconds[workers] = time.monotonic() - began_s
    sys.stdout.write(f"\n100 episodes of 8 steps of 5 ms: {seconds[1]:.2f} s on one worker, {seconds[4]:.2f} s on four\n")
    assert seconds[4] <= 0.4 * crowding() * seconds[1]


def test_a_worker_in_a_long_step_is_not_silent() -> None:
    policy = untrained(f"{TOY}Slow-v0", {"seconds": 0.8, "k": 1})
    which = PlayingWorkers(1, settings=RolloutConfig(worker_timeout_s=0.5))
    with policy_player(policy, which, silent) as player:
        played = player.play(EvaluationPlan.of(1, seed=5, copies=1, max_steps=100))
    assert [one.episode.length for one in played] == [1]


def test_an_environment_that_raises_ends_the_evaluation_with_its_traceback() -> None:
    policy = untrained(f"{TOY}Raises-v0", {"after": 3})
    with (
        pytest.raises(EnvironmentFailed, match="while the policy was evaluated: copy 0, step ") as caught,
        policy_player(policy, PlayingWorkers(1, settings=RolloutConfig(max_env_failures=0)), silent) as player,
    ):
        player.play(EvaluationPlan.of(4, seed=5, copies=2, max_steps=100))
    assert "in step" in caught.value.detail


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.soak), signal.SIGTERM])
def test_a_signal_during_an_evaluation_ends_the_run_at_once_with_its_checkpoint(stage: Stage, number: int) -> None:
    """The environment has no time limit: the greedy policy may walk on for ever."""
    command = [sys.executable, "-m", "millrace", "train", CLIFF, "--steps", "1200", "--rollout-steps", "32"]
    command += ["--run-dir", str(stage.runs), "--eval-max-steps", "1000000000", "--eval-episodes", "100"]
    run = stage.start(command, "train")
    run.hears("evaluating for ", START_S)
    saved_at = max(map(_steps, stage.runs.glob("*/checkpoints/*.pt")))
    began_s = time.monotonic()
    run.signal(number)
    assert run.ends() == 130, run.said()
    seconds = time.monotonic() - began_s
    assert seconds <= 2.0 * crowding(), f"the run ended {seconds:.2f} s after the signal"
    assert re.search("interrupted; continue with: .*millrace train --resume", run.said())
    assert "Traceback" not in run.said()
    rows = read_rows(next(stage.runs.glob("*/metrics.jsonl")))
    assert saved_at == rows[-1]["time/total_timesteps"] > 0


def _steps(checkpoint: Path) -> int:
    return int(checkpoint.stem)


@pytest.mark.soak
def test_an_evaluation_that_was_cut_off_is_made_when_the_run_is_resumed(stage: Stage) -> None:
    """SIGKILL: the checkpoint before the evaluation says that it is due."""
    command = [sys.executable, "-m", "millrace", "train", f"{TOY}Slow-v0", "--run-dir", str(stage.runs)]
    command += ["--env-kwargs", "seconds", "0.001", "--steps", "3000", "--rollout-steps", "32"]
    command += ["--eval-every", "1000", "--eval-episodes", "400"]
    killed = stage.start(command, "killed")
    stopped_at = wait_for(
        lambda: max((at for at in map(_steps, stage.runs.glob("*/checkpoints/*.pt")) if at >= 1_000), default=0), START_S
    )
    killed.kill()
    (folder,) = stage.runs.iterdir()
    assert not [row for row in read_rows(folder / "metrics.jsonl") if "eval/mean_reward" in row]
    resumed = stage.start([sys.executable, "-m", "millrace", "train", "--resume", str(folder)], "resumed")
    assert resumed.ends(START_S) == 0, resumed.said()
    evaluated = [row["time/total_timesteps"] for row in read_rows(folder / "metrics.jsonl") if "eval/mean_reward" in row]
    assert evaluated[0] == stopped_at
    assert len(evaluated) >= 2


def test_an_episode_that_never_ends_is_cut_and_the_result_says_so(tmp_path: Path) -> None:
    config = resolve(CLIFF, run_dir=str(tmp_path), steps=600, rollout_steps=32, eval_episodes=5, eval_max_steps=500)
    folder = train(config, None, lambda progress: None)
    evaluation = json.loads((folder / "summary.json").read_text())["evaluation"]
    assert evaluation["cut"] == 5
    assert evaluation["length_mean"] == 100
