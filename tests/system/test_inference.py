"""Runs whose policy acts beside the learner: the same weights as where workers act, and the same end under faults."""

from __future__ import annotations

import json
import logging
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import gymnasium
import psutil
import pytest

import millrace
from learner.config.layers import resolve
from learner.run_folder.metrics_log import read_rows
from learner.run_folder.progress import Progress
from millrace.launch.local import train
from protocol.errors import EnvironmentFailed, NoWorkers, UsageError
from tests.system.processes import Stage, free_port, wait_for
from tests.system.test_local_run import assert_balanced, run, start, summary, worker_processes

SMALL: dict[str, Any] = {"n_epochs": 2, "eval_episodes": 2}
TOY = "workers.envs.toy:"
HERE: dict[str, Any] = {"inference": "learner"}


def policy_of(folder: Path) -> bytes:
    return (folder / "policy.safetensors").read_bytes()


# ---------------------------------------------------------------- the same


@pytest.mark.parametrize(
    ("env", "settings"),
    [
        ("CartPole-v1", {"steps": 4_000}),
        ("Pendulum-v1", {"steps": 17_000, "n_epochs": 1, "batch_size": 256}),
        ("CartPole-v1", {"steps": 3_000, "core": "lstm", "core_size": 8, "n_epochs": 1, "normalize_observations": True}),
        ("CartPole-v1", {"steps": 3_000, "algo": "a2c"}),
        ("CartPole-v1", {"steps": 4_000, "algo": "dqn"}),
        ("CartPole-v1", {"steps": 16_000, "algo": "reinforce", "preset": "none", "rollout_steps": 501}),
        ("CartPole-v1", {"steps": 4_000, "algo": "impala", "max_lag": 0}),
    ],
    ids=["ppo", "gaussian", "lstm", "a2c", "dqn", "reinforce", "impala"],
)
def test_the_weights_are_those_of_workers_that_act(tmp_path: Path, env: str, settings: dict[str, Any]) -> None:
    """To the bit: every lane has its seeds and its random numbers, wherever its copies are and whoever acts."""
    there = run(tmp_path, env, seed=3, workers=2, eval_episodes=1, **settings)
    here = run(tmp_path, env, seed=3, workers=2, eval_episodes=1, **settings, **HERE)
    assert policy_of(here) == policy_of(there)
    for name in ("updates", "env_steps", "ledger", "return_mean_100", "evaluation", "lags"):
        assert summary(here)[name] == summary(there)[name]
    assert summary(here)["updates"] >= 3
    assert_balanced(summary(here)["ledger"])
    curves = [[row["rollout/ep_rew_mean"] for row in read_rows(folder / "metrics.jsonl")] for folder in (here, there)]
    assert curves[0] == curves[1]


def test_the_weights_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    found = {}
    for workers, transport in ((1, "ipc"), (2, "tcp"), (3, "inproc"), (5, "ipc")):  # of five, one has no lane
        settings: dict[str, Any] = {"workers": workers, "transport": transport, "steps": 2_500, **SMALL, **HERE}
        found[workers] = policy_of(run(tmp_path, "CartPole-v1", seed=3, **settings))
    assert len(set(found.values())) == 1
    other: dict[str, Any] = {"steps": 2_500, **SMALL, **HERE}
    assert policy_of(run(tmp_path, "CartPole-v1", seed=4, **other)) != found[1], "the seed changes nothing"


def test_it_learns(tmp_path: Path) -> None:
    folder = run(tmp_path, "CartPole-v1", steps=60_000, target_mean_return=150.0, eval_episodes=10, **HERE)
    assert summary(folder)["stop_reason"] == "mean return 150 of the last episodes reached"
    assert summary(folder)["evaluation"]["return_mean"] > 150


def test_a_resumed_run_goes_on_as_one_where_workers_act(tmp_path: Path) -> None:
    """The lanes begin anew in both, with the same seeds; optimiser, normaliser and counters go on."""
    settings: dict[str, Any] = {"seed": 3, "normalize_observations": True, "normalize_rewards": True, **SMALL}
    policies = []
    for inference in ("workers", "learner"):
        folder = run(tmp_path, "CartPole-v1", steps=1_500, inference=inference, **settings)
        first = summary(folder)
        train(resolve(resume=folder, steps=3_000), folder, lambda progress: None)
        second = summary(folder)
        assert first["env_steps"] < 1_500 < second["env_steps"] <= 3_000
        assert second["updates"] > first["updates"]
        assert_balanced(second["ledger"])
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


def test_an_environment_may_be_a_callable(tmp_path: Path) -> None:
    def light(gravity: float = 9.8) -> gymnasium.Env[Any, Any]:
        env = gymnasium.make("CartPole-v1")
        env.unwrapped.gravity = gravity  # type: ignore[attr-defined]
        return env

    settings: dict[str, Any] = {"steps": 1_000, "run_dir": str(tmp_path), "env_kwargs": {"gravity": 5.0}, **SMALL, **HERE}
    assert summary(millrace.train(light, **settings))["env"] == "light"
    with pytest.raises(UsageError, match="an environment factory is code"):
        millrace.train(light, transport="tcp", **settings)


# ---------------------------------------------------------------- thin workers


@pytest.mark.parametrize("inference", ["workers", "learner"])
def test_workers_that_only_step_need_no_torch_for_images(tmp_path: Path, inference: str) -> None:
    with_torch: list[bool] = []

    def look(progress: Progress) -> None:
        maps = [Path(f"/proc/{worker.pid}/maps").read_text() for worker in worker_processes()]
        with_torch.extend("libtorch" in text for text in maps)

    settings: dict[str, Any] = {"env_kwargs": {"observation": "image"}, "rollout_steps": 16, "steps": 400}
    folder = run(tmp_path, f"{TOY}Spaces-v0", look, inference=inference, **settings, **SMALL)
    assert summary(folder)["updates"] >= 2
    assert with_torch
    assert set(with_torch) == {inference == "workers"}


def test_a_policy_of_torch_is_the_same_whatever_the_number_of_workers(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"env_kwargs": {"observation": "image"}, "rollout_steps": 16, "steps": 600, **SMALL, **HERE}
    found = {policy_of(run(tmp_path, f"{TOY}Spaces-v0", workers=workers, **settings)) for workers in (1, 2)}
    assert len(found) == 1


@pytest.mark.parametrize("inference", ["workers", "learner"])
def test_images_are_looked_at_as_the_run_says(tmp_path: Path, inference: str) -> None:
    settings: dict[str, Any] = {"env_kwargs": {"observation": "image"}, "rollout_steps": 16, "steps": 300, **SMALL}
    settings |= {"inference": inference}
    found = {policy_of(run(tmp_path, f"{TOY}Spaces-v0", images_dtype=as_, **settings)) for as_ in ("float32", "bfloat16")}
    assert len(found) == 2


def test_a_policy_that_sees_no_images_takes_no_dtype_for_them(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="images_dtype bfloat16: expected float32"):
        run(tmp_path, f"{TOY}Spaces-v0", images_dtype="bfloat16", steps=300, **SMALL)


# ---------------------------------------------------------------- faults


def test_a_killed_worker_costs_its_copies_their_episodes_and_no_more(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    killed: list[int] = []
    back: list[int] = []

    def watch(progress: Progress) -> None:
        if progress.updates == 5:
            victim = worker_processes()[0]
            killed.append(victim.pid)
            victim.kill()
        if killed and progress.updates > 6 and progress.workers_alive == 2:
            back.append(progress.updates)

    with caplog.at_level(logging.WARNING):
        folder = run(tmp_path, "CartPole-v1", watch, steps=20_000, **SMALL, **HERE)
    found = summary(folder)
    assert killed
    assert back, "the killed worker never came back"
    assert found["stop_reason"] == "all steps done"
    assert "was killed by SIGKILL" in caplog.text
    assert caplog.text.count("comes back truncated") == 2  # it had two of the four lanes
    assert found["ledger"]["lost"] == 0
    assert_balanced(found["ledger"])


def test_an_environment_that_raises_ends_the_run_with_its_own_traceback(tmp_path: Path) -> None:
    with pytest.raises(EnvironmentFailed, match="that was failure 2, at most 1 are borne") as failure:
        run(tmp_path, f"{TOY}Raises-v0", max_env_failures=1, **SMALL, **HERE)
    assert "toy.py" in failure.value.detail, "the traceback is not the worker's"
    assert "\n" not in str(failure.value)
    assert "its environment raised ValueError" in str(failure.value)


def test_an_environment_that_raises_once_is_borne(tmp_path: Path) -> None:
    kwargs: dict[str, Any] = {"once": str(tmp_path / "raised"), "after": 30}
    folder = run(tmp_path, f"{TOY}Raises-v0", env_kwargs=kwargs, workers=1, steps=2_000, **SMALL, **HERE)
    found = summary(folder)
    assert Path(kwargs["once"]).exists()
    assert found["stop_reason"] == "all steps done"
    assert found["ledger"]["lost"] == 4  # the rollouts in hand, one of each lane: dealt again
    assert_balanced(found["ledger"])


@pytest.mark.parametrize(("env", "what"), [("NaNObservation", "observation"), ("NaNReward", "reward")])
def test_nan_ends_the_run_naming_where(tmp_path: Path, env: str, what: str) -> None:
    with pytest.raises(EnvironmentFailed, match=rf"lane \d.*{what}.*nan at step \d+, copy \d+"):
        run(tmp_path, f"{TOY}{env}-v0", max_env_failures=0, **SMALL, **HERE)


def test_an_environment_that_hangs_is_given_up(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    kwargs = {"once": str(tmp_path / "hung"), "after": 30}
    settings: dict[str, Any] = {"steps": 2_000, "step_timeout_s": 1.0, "env_kwargs": kwargs, **SMALL, **HERE}
    with caplog.at_level(logging.WARNING):
        folder = run(tmp_path, f"{TOY}Hangs-v0", **settings)
    assert summary(folder)["stop_reason"] == "all steps done"
    assert "a step of its environment took too long (--step-timeout-s)" in caplog.text


def test_nobody_comes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("workers.host.sys.executable", "/bin/false")
    began_s = time.monotonic()
    with pytest.raises(NoWorkers, match="waited 1 s for 2 workers"):
        run(tmp_path, "CartPole-v1", no_workers_timeout_s=1.0, **SMALL, **HERE)
    assert time.monotonic() - began_s < 20


def test_ctrl_c_while_an_environment_hangs_drains_saves_and_leaves_nobody(tmp_path: Path) -> None:
    learner = start(tmp_path, "--inference", "learner")
    wait_for(lambda: any(len(read_rows(path)) > 10 for path in tmp_path.glob("runs/*/metrics.jsonl")))
    workers = psutil.Process(learner.pid).children()
    assert len(workers) == 2
    for worker in workers:
        worker.suspend()  # no step is answered any more
    learner.send_signal(signal.SIGINT)
    _, stderr = learner.communicate(timeout=40)
    assert learner.returncode == 130
    assert b"--resume" in stderr
    assert b"Traceback" not in stderr
    assert not any(worker.is_running() for worker in workers), "a worker outlived its learner"
    (folder,) = tmp_path.glob("runs/*")
    assert summary(folder)["stop_reason"] == "interrupted"


# ---------------------------------------------------------------- workers elsewhere, refusals


def test_workers_from_elsewhere_step_for_a_learner_that_acts(tmp_path: Path) -> None:
    stage = Stage(tmp_path / "stage")
    address = f"tcp://127.0.0.1:{free_port()}"
    flags = [
        "CartPole-v1",
        "--bind",
        address,
        "--inference",
        "learner",
        "--min-workers",
        "2",
        "--steps",
        "2500",
        "--seed",
        "3",
    ]
    flags += ["--eval-episodes", "2", "--n-epochs", "2", "--run-dir", str(stage.runs)]
    try:
        learner = stage.start([sys.executable, "-m", "millrace", "learner", *flags], "learner")
        learner.hears("waiting for workers; start one with", 60)
        for name in ("here", "there"):
            stage.worker(address, name)
        assert learner.ends(60) == 0
        (folder,) = stage.runs.iterdir()
        alone = run(tmp_path, "CartPole-v1", seed=3, steps=2_500, **SMALL)
        assert policy_of(folder) == policy_of(alone)
    finally:
        stage.close()


def test_an_occupied_port_leaves_no_folder(tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/nowhere/learner"
    command = [sys.executable, "-m", "millrace", "learner", "CartPole-v1", "--bind", address, "--inference", "learner"]
    refused = subprocess.run(
        [*command, "--run-dir", str(tmp_path / "runs")], capture_output=True, text=True, timeout=60, check=False
    )
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1
    assert not (tmp_path / "runs").exists()


def test_what_it_cannot_do_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="inference learner: max_lag expected 0, got 1"):
        resolve("CartPole-v1", max_lag=1, **HERE)
    with pytest.raises(UsageError, match="inference expected one of workers, learner, got 'gpu'"):
        resolve("CartPole-v1", inference="gpu")
    command = [sys.executable, "-m", "learner", "CartPole-v1", "--inference", "learner", "--run-dir", str(tmp_path / "runs")]
    refused = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert refused.returncode == 2
    assert "start it as millrace learner" in refused.stderr
    assert not (tmp_path / "runs").exists()


def test_no_thread_is_left(tmp_path: Path) -> None:
    run(tmp_path, "CartPole-v1", steps=600, **SMALL, **HERE)
    json.loads((next(tmp_path.glob("runs*/*")) / "summary.json").read_text())
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("inference")]
