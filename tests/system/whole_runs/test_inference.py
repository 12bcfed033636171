"""Runs with `--inference learner`: the same weights and the same handling of faults as with `--inference workers`."""

from __future__ import annotations

import json
import logging
import re
import signal
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.metrics_log import read_rows
from millrace.learner.run_folder.progress import Progress
from millrace.protocol.errors import EnvironmentFailed, UsageError
from tests.system.stage.local_runs import SMALL, TOY, run, worker_processes
from tests.system.stage.processes import Learner, Stage, free_port
from tests.system.stage.run_folders import policy_of, summary
from tests.system.stage.runs import balanced

IN_LEARNER: dict[str, Any] = {"inference": "learner"}
REINFORCE: dict[str, Any] = {"steps": 16_000, "algo": "reinforce", "preset": "none", "rollout_steps": 501}


# ---------------------------------------------------------------- the same weights


@pytest.mark.parametrize(
    ("env", "settings"),
    [
        ("CartPole-v1", {"steps": 2_000, "n_epochs": 2}),
        pytest.param("Pendulum-v1", {"steps": 7_000, "rollout_steps": 64, "n_epochs": 1}, marks=pytest.mark.soak),
        ("CartPole-v1", {"steps": 1_500, "core": "lstm", "core_size": 8, "n_epochs": 1, "normalize_observations": True}),
        ("CartPole-v1", {"steps": 3_000, "n_epochs": 2, "max_lag": 1, "lanes": 4, "envs": 8}),
        pytest.param("CartPole-v1", {"steps": 3_000, "algo": "a2c"}, marks=pytest.mark.soak),
        (f"{TOY}Steer-v0", {"steps": 1_500, "n_epochs": 1, "rollout_steps": 16}),
        ("CartPole-v1", {"steps": 2_000, "algo": "dqn"}),
        pytest.param("CartPole-v1", REINFORCE, marks=pytest.mark.soak),
        pytest.param("CartPole-v1", {"steps": 4_000, "algo": "impala", "max_lag": 0}, marks=pytest.mark.soak),
    ],
    ids=["ppo", "gaussian", "lstm", "lag", "a2c", "mixed", "dqn", "reinforce", "impala"],
)
def test_the_weights_equal_those_of_inference_workers(tmp_path: Path, env: str, settings: dict[str, Any]) -> None:
    """Bit for bit: seeds and random numbers belong to the lane, wherever its copies are and wherever the policy acts."""
    in_workers = run(tmp_path, env, seed=3, workers=2, eval_episodes=1, **settings)
    in_learner = run(tmp_path, env, seed=3, workers=2, eval_episodes=1, **settings, **IN_LEARNER)
    assert policy_of(in_learner) == policy_of(in_workers)
    for name in ("updates", "env_steps", "ledger", "return_mean_100", "evaluation", "lags"):
        assert summary(in_learner)[name] == summary(in_workers)[name]
    assert summary(in_learner)["updates"] >= 3
    balanced(summary(in_learner))
    curves = [
        [row["rollout/ep_rew_mean"] for row in read_rows(folder / "metrics.jsonl")] for folder in (in_learner, in_workers)
    ]
    assert curves[0] == curves[1]


def test_the_weights_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    policies = {}
    for workers, transport in ((1, "inproc"), (3, "tcp"), (5, "ipc")):  # with five workers, one has no lane
        settings: dict[str, Any] = {"workers": workers, "transport": transport, "steps": 1_500, **SMALL, **IN_LEARNER}
        policies[workers] = policy_of(run(tmp_path, "CartPole-v1", seed=3, **settings))
    assert len(set(policies.values())) == 1
    other: dict[str, Any] = {"steps": 1_500, **SMALL, **IN_LEARNER}
    assert policy_of(run(tmp_path, "CartPole-v1", seed=4, **other)) != policies[1], "the seed changes nothing"


@pytest.mark.soak
def test_a_run_with_learner_inference_learns(tmp_path: Path) -> None:
    folder = run(tmp_path, "CartPole-v1", steps=60_000, target_mean_return=150.0, eval_episodes=10, **IN_LEARNER)
    assert summary(folder)["stop_reason"] == "mean return 150 of the last episodes reached"
    # Ten greedy episodes of a policy that gets 150 vary by 100 or so, and with the processor's arithmetic.
    assert summary(folder)["evaluation"]["return_mean"] > 150 - 2.5 * 100 / 10**0.5


def test_a_resumed_run_equals_one_with_inference_workers(tmp_path: Path) -> None:
    """In both the lanes start again with the same seeds; optimizer, normalization and counters continue."""
    settings: dict[str, Any] = {"seed": 3, "normalize_observations": True, "normalize_rewards": True, **SMALL}
    settings["lost_lanes"] = "restart"
    policies = []
    for inference in ("workers", "learner"):
        folder = run(tmp_path, "CartPole-v1", steps=1_500, inference=inference, **settings)
        first = summary(folder)
        run(tmp_path, resume=folder, steps=3_000)
        second = summary(folder)
        assert first["env_steps"] < 1_500 < second["env_steps"] <= 3_000
        assert second["updates"] > first["updates"]
        balanced(second)
        policies.append(policy_of(folder))
    assert policies[0] == policies[1]
    assert 'inference = "learner"' in (folder / "config.toml").read_text()


def test_every_whole_episode_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    steps = []
    for inference in ("workers", "learner"):
        name = f"cartpole/{inference}-v0"
        run(tmp_path, "CartPole-v1", steps=1_500, record=name, inference=inference, **SMALL)
        dataset = minari.load_dataset(name)
        steps.append((dataset.total_episodes, dataset.total_steps))
    assert steps[0] == steps[1]
    assert steps[0][0] > 20


# ---------------------------------------------------------------- thin workers


@pytest.mark.parametrize("inference", [pytest.param("workers", marks=pytest.mark.soak), "learner"])
def test_workers_that_only_step_do_not_import_torch_for_images(tmp_path: Path, inference: str) -> None:
    with_torch: list[bool] = []

    def watch(progress: Progress) -> None:
        maps = [Path(f"/proc/{worker.pid}/maps").read_text() for worker in worker_processes()]
        with_torch.extend("libtorch" in text for text in maps)

    settings: dict[str, Any] = {"env_kwargs": {"observation": "image"}, "rollout_steps": 16, "steps": 400}
    folder = run(tmp_path, f"{TOY}Spaces-v0", watch, inference=inference, **settings, **SMALL)
    assert summary(folder)["updates"] >= 2
    assert with_torch
    assert set(with_torch) == {inference == "workers"}


def test_a_torch_policy_does_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    settings: dict[str, Any] = {
        "env_kwargs": {"observation": "image"},
        "rollout_steps": 16,
        "steps": 600,
        **SMALL,
        **IN_LEARNER,
    }
    policies = {policy_of(run(tmp_path, f"{TOY}Spaces-v0", workers=workers, **settings)) for workers in (1, 2)}
    assert len(policies) == 1


@pytest.mark.parametrize("inference", [pytest.param("workers", marks=pytest.mark.soak), "learner"])
def test_acting_dtype_changes_how_images_are_processed(tmp_path: Path, inference: str) -> None:
    settings: dict[str, Any] = {"env_kwargs": {"observation": "image"}, "rollout_steps": 16, "steps": 300, **SMALL}
    settings |= {"inference": inference}
    dtypes = ("float32", "bfloat16")
    policies = {policy_of(run(tmp_path, f"{TOY}Spaces-v0", acting_dtype=dtype, **settings)) for dtype in dtypes}
    assert len(policies) == 2


# ---------------------------------------------------------------- faults


def test_workers_that_die_again_and_again_end_the_run(tmp_path: Path) -> None:
    with pytest.raises(
        EnvironmentFailed, match=r"its process was killed by SIGKILL.*; failure 3 .*max_env_failures allows 2"
    ):
        run(tmp_path, f"{TOY}Dies-v0", max_env_failures=2, workers=1, **SMALL, **IN_LEARNER)


def test_the_run_continues_after_an_environment_hung(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    kwargs = {"once": str(tmp_path / "hung"), "after": 30}
    settings: dict[str, Any] = {"steps": 2_000, "step_timeout_s": 3.0, "env_kwargs": kwargs, **SMALL, **IN_LEARNER}
    shown: list[str] = []
    with caplog.at_level(logging.WARNING):
        folder = run(tmp_path, f"{TOY}Hangs-v0", lambda progress: shown.append(progress.waiting), **settings)
    assert summary(folder)["stop_reason"] == "all steps done"
    assert "a step of its environment took longer than 3 s (--step-timeout-s)" in caplog.text
    named = re.compile(r"waiting \d+ s for lanes? .* \(worker w\d on .*: in step for [23] s\)")
    assert any(map(named.match, shown)), "meanwhile, the worker that steps is named"


# ---------------------------------------------------------------- workers elsewhere, refusals


def acting_learner(stage: Stage, *flags: str) -> tuple[Learner, str]:
    """A learner that acts itself and waits for workers; and its address."""
    address = f"tcp://127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "millrace", "learner", "CartPole-v1", "--bind", address, "--inference", "learner"]
    learner = Learner([*command, "--run-dir", str(stage.runs), *flags], stage.tmp_path / "learner.log", stage.runs)
    stage.started.append(learner)
    return learner, address


def test_workers_elsewhere_step_while_the_policy_acts_in_the_learner(stage: Stage, tmp_path: Path) -> None:
    flags = ["--min-workers", "2", "--steps", "2500", "--seed", "3", "--eval-episodes", "2", "--n-epochs", "2"]
    learner, address = acting_learner(stage, *flags)
    learner.hears("waiting for workers; start one with", 60)
    for name in ("here", "there"):
        stage.worker(address, name)
    assert learner.ends(60) == 0
    (folder,) = stage.runs.iterdir()
    alone = run(tmp_path, "CartPole-v1", seed=3, steps=2_500, **SMALL)
    assert policy_of(folder) == policy_of(alone)


def test_a_worker_elsewhere_may_be_silent_for_as_long_as_the_setting_says(stage: Stage) -> None:
    learner, address = acting_learner(stage, "--steps", "1000000", "--worker-timeout-s", "1")
    worker = stage.worker(address, "w0")
    learner.trains(1)
    worker.kill()
    learner.hears("worker w0 .*silent for 1 s")


def test_the_run_ends_when_the_workers_elsewhere_have_left(stage: Stage) -> None:
    """After --no-workers-timeout-s, although an order may take --step-timeout-s. It says why the last one left."""
    learner, address = acting_learner(stage, "--steps", "1000000", "--no-workers-timeout-s", "5")
    worker = stage.worker(address, "w0")
    learner.trains(2)
    worker.signal(signal.SIGTERM)
    assert worker.ends() == 0
    assert learner.ends(60) == 1
    last = learner.said().splitlines()[-1]
    assert "waited 5 s for 1 worker" in last
    assert "(the last one left: told to stop)" in last
    assert "env steps are saved" in last


def test_unsupported_settings_are_refused_in_one_line() -> None:
    with pytest.raises(UsageError, match="inference learner: eval_workers: expected 0, got 1"):
        resolve("CartPole-v1", eval_workers=1, **IN_LEARNER)
    with pytest.raises(UsageError, match="inference: expected one of workers, learner, got 'gpu'"):
        resolve("CartPole-v1", inference="gpu")


def test_no_thread_is_left(tmp_path: Path) -> None:
    run(tmp_path, "CartPole-v1", steps=600, **SMALL, **IN_LEARNER)
    json.loads((next(tmp_path.glob("runs*/*")) / "summary.json").read_text())
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("inference")]
