"""Whole runs with continuous actions and replay: the same for any number of workers, beside the learner, with prior data."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from random import Random
from typing import Any

import gymnasium
import numpy as np
import pytest
from torch import Tensor

import millrace
from millrace.launch.training import train
from millrace.learner.algorithms.replay.transitions import Transitions
from millrace.learner.algorithms.td3 import TD3
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.metrics_log import read_rows
from millrace.learner.run_folder.run_folder import Interrupted
from tests.system.stage.preloaded import workers_of
from tests.system.stage.processes import START_S, Learner, Stage
from tests.system.stage.run_folders import policy_of

SMALL: dict[str, Any] = {
    "preset": "none",
    "transport": "inproc",
    "seed": 3,
    "envs": 8,
    "lanes": 4,
    "rollout_steps": 5,
    "learning_starts": 90,
    "updates_per_step": 0.3,
    "batch_size": 16,
    "net": (16,),
    "eval_episodes": 1,
    "steps": 600,
}
ALGORITHMS = pytest.mark.parametrize(
    "algo", ["sac", "xqc", *(pytest.param(algo, marks=pytest.mark.soak) for algo in ("td3", "tqc", "crossq"))]
)
NORMALIZED: dict[str, Any] = {"critic_net": (16,), "policy_delay": 2}
OWN: dict[str, dict[str, Any]] = {
    "tqc": {"quantiles": 5},
    "crossq": NORMALIZED | {"renormalize_after": 40},
    "xqc": NORMALIZED | {"atoms": 21},
}
"""Settings of an algorithm of its own"""


def run(tmp_path: Path, name: str, resume: Path | None = None, **settings: Any) -> Path:
    keywords = SMALL | OWN.get(settings.get("algo", ""), {}) | settings
    config = resolve("" if resume else "Pendulum-v1", run_dir=str(tmp_path / name), resume=resume, **keywords)
    return train(config, resume, lambda _: None)


@ALGORITHMS
def test_bits_and_replay_ratio_do_not_depend_on_the_number_of_workers(tmp_path: Path, algo: str) -> None:
    folders = [run(tmp_path, str(workers), algo=algo, workers=workers) for workers in (1, 3)]
    assert policy_of(folders[0]) == policy_of(folders[1])
    ahead = [run(tmp_path, f"{workers} at a lag", algo=algo, workers=workers, max_lag=1) for workers in (1, 4)]
    assert policy_of(ahead[0]) == policy_of(ahead[1])
    for folder in folders:
        for row in read_rows(folder / "metrics.jsonl"):
            own = max(0, row["time/total_timesteps"] - 90)
            assert row["train/n_updates"] == int(0.3 * own + 1e-9), "the gradient steps that the ratio demands, no more"
    learner = run(tmp_path, "learner", algo=algo, workers=2, inference="learner")
    assert policy_of(learner) == policy_of(folders[0])


@pytest.mark.parametrize("max_lag", [0, 1])
def test_with_memory_bits_do_not_depend_on_the_number_of_workers(tmp_path: Path, max_lag: int) -> None:
    memory: dict[str, Any] = {"algo": "sac", "core": "lstm", "core_size": 8, "max_lag": max_lag}
    policies = [policy_of(run(tmp_path, f"{workers}", workers=workers, **memory)) for workers in (1, 2, 4)]
    if not max_lag:
        policies.append(policy_of(run(tmp_path, "learner", workers=2, inference="learner", **memory)))
    assert policies == [policies[0]] * len(policies)


@ALGORITHMS
def test_the_replay_ratio_holds_with_lag_and_after_a_resume(tmp_path: Path, algo: str) -> None:
    folder = run(tmp_path, "first", algo=algo, workers=2, steps=300, max_lag=2)
    resumed = run(tmp_path, "first", resume=folder, workers=2, steps=600, max_lag=2)
    last = read_rows(resumed / "metrics.jsonl")[-1]
    assert last["time/total_timesteps"] > 500
    assert last["train/n_updates"] == int(0.3 * (last["time/total_timesteps"] - 90) + 1e-9)


@pytest.mark.soak
def test_the_replay_ratio_is_exact_for_eight_uneven_workers_of_which_one_is_killed_now_and_then(
    stage: Stage, tmp_path: Path
) -> None:
    command = f"""--algo sac --preset none --workers 8 --envs 8 --lanes 8 --rollout-steps 5 --max-lag 1 --learning-starts 90
        --updates-per-step 0.3 --batch-size 16 --net 16 --eval-episodes 1 --steps 20000 --max-env-failures 9
        --run-dir {stage.runs} --env-kwargs slow_file {tmp_path / "slow"}"""
    words = [
        sys.executable,
        "-m",
        "millrace",
        "train",
        "tests.system.environments.slow_envs:UnevenPendulum-v0",
        *command.split(),
    ]
    learner = Learner(words, tmp_path / "train.log", stage.runs)
    stage.started.append(learner)
    random = Random(0)
    for killed in range(1, 5):
        learner.trains(8)
        random.choice(workers_of(learner.pid)).kill()
        learner.hears(r"worker w\d .*was killed by SIGKILL", START_S, killed)
    learner.trains(8)
    learner.signal(signal.SIGINT)
    assert learner.ends() == 130
    rows = learner.rows()
    assert rows[-1]["train/n_updates"] > 200
    for row in rows:
        own = max(0, row["time/total_timesteps"] - 90)
        assert row["train/n_updates"] == int(0.3 * own + 1e-9), "the gradient steps that the ratio demands, no more"


@ALGORITHMS
def test_the_policy_acts_within_the_bounds_and_so_do_its_episodes(tmp_path: Path, algo: str) -> None:
    folder = run(tmp_path, "acts", algo=algo, workers=1)
    loaded, env = millrace.load(folder), gymnasium.make("Pendulum-v1")
    action = loaded(env.reset(seed=1)[0])
    assert env.action_space.contains(action)
    env.close()


@ALGORITHMS
def test_it_learns_from_prior_data(tmp_path: Path, algo: str, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    few: dict[str, Any] = {"envs": 2, "lanes": 2, "steps": 450}  # an episode is 200 steps
    first = run(tmp_path, "recorded", algo=algo, workers=1, record="pendulum/first-v0", **few)
    recorded = minari.load_dataset("pendulum/first-v0")
    actions = np.concatenate([episode.actions for episode in recorded.iterate_episodes()])
    assert np.abs(actions).max() > 1.5, "as the environment took them: Pendulum's bounds are -2 and 2"
    assert np.abs(actions).max() <= 2
    prior = run(tmp_path, "prior", algo=algo, workers=1, prior="pendulum/first-v0", prior_steps=20, steps=300)
    rows = read_rows(prior / "metrics.jsonl")
    assert rows[0]["train/n_updates"] == 20
    last = rows[-1]
    assert last["train/n_updates"] == 20 + int(0.3 * (last["time/total_timesteps"] - 90) + 1e-9)
    assert policy_of(prior) != policy_of(first)


def test_a_clone_is_measured_before_its_prior_steps_even_if_they_are_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    run(tmp_path, "recorded", algo="td3", record="pendulum/first-v0", envs=2, lanes=2, steps=450)
    settings: dict[str, Any] = {"algo": "td3", "prior": "pendulum/first-v0", "clone_epochs": 1, "prior_steps": 20}
    whole = run(tmp_path, "whole", **settings)
    step = TD3.step

    def interrupted_step(self: TD3, rows: Transitions) -> tuple[dict[str, float], Tensor]:
        if self.prior_gradient_steps == 10:
            signal.raise_signal(signal.SIGTERM)
        return step(self, rows)

    with monkeypatch.context() as patched, pytest.raises(Interrupted) as stopped:
        patched.setattr(TD3, "step", interrupted_step)
        run(tmp_path, "stopped", **settings)
    resumed = run(tmp_path, "stopped", resume=stopped.value.run, **settings)
    assert policy_of(resumed) == policy_of(whole)
    cloned = [read_rows(folder / "metrics.jsonl")[0] for folder in (whole, resumed)]
    assert len({row["clone/mean_absolute_error"] for row in cloned}) == 1
    said = [line for line in caplog.messages if line.startswith("cloned ")]
    assert len(said) == 2, "once by each new run"
