"""Whole runs on this machine: real worker processes, real sockets, real faults."""

from __future__ import annotations

import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NoReturn

import gymnasium
import numpy as np
import psutil
import pytest

import millrace
from millrace.extras.monitoring.report.reported_runs import read_run
from millrace.launch.training import train
from millrace.learner.config.config import Config
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.metrics_log import read_rows
from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_folder.results import ALL_STEPS_DONE
from millrace.learner.run_folder.run_format import check_format
from millrace.protocol.errors import EnvironmentFailed, NoWorkers, RunError, UsageError
from millrace.workers.machine_slots import LIMIT_VARIABLE
from tests.support.envs.toy import Countdown
from tests.support.in_process.saved_policies import load_policy
from tests.system.stage import preloaded
from tests.system.stage.local_runs import SMALL, TOY, run, start, worker_processes
from tests.system.stage.processes import START_S, wait_for
from tests.system.stage.run_folders import policy_of, summary
from tests.system.stage.runs import balanced
from tests.system.stage.small_disk import filled, small_disk


@pytest.fixture(params=["workers", "learner"])
def inference(request: pytest.FixtureRequest) -> str:
    """Where the policy acts."""
    where: str = request.param
    return where


@pytest.mark.parametrize(
    ("env", "settings", "places"),
    [
        ("CartPole-v1", {"steps": 5_300, "n_epochs": 1}, [(1, "inproc"), (2, "tcp"), (4, "ipc")]),
        pytest.param(
            *("Pendulum-v1", {"steps": 10_700, "rollout_steps": 64, "n_epochs": 1}),
            list(itertools.product((1, 2, 4), ("inproc", "ipc", "tcp"))),
            marks=pytest.mark.soak,
        ),
    ],
)
def test_the_curve_does_not_depend_on_the_number_of_workers(
    tmp_path: Path, env: str, settings: dict[str, Any], places: list[tuple[int, str]]
) -> None:
    """20 updates with one seed and the default lanes: the same weights for 1, 2 and 4 workers, over inproc, ipc and tcp."""
    policies: dict[tuple[int | str, str], bytes] = {}
    for workers, transport in places:
        more: dict[str, Any] = {"workers": workers, "transport": transport}
        folder = run(tmp_path, env, seed=3, eval_episodes=1, **more, **settings)
        assert summary(folder)["updates"] >= 20
        policies[workers, transport] = policy_of(folder)
    policies["again", "ipc"] = policy_of(run(tmp_path, env, seed=3, workers=2, eval_episodes=1, **settings))
    different = {key for key, policy in policies.items() if policy != policies[1, "inproc"]}
    assert not different
    other = run(tmp_path, env, seed=4, workers=2, eval_episodes=1, **settings)
    assert policy_of(other) != policies[1, "inproc"], "the seed changes nothing"


class Uneven(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Its steps take longer in some processes than in others."""

    def step(self, action: Any) -> Any:
        time.sleep(0.001 * (os.getpid() % 4))
        return self.env.step(action)


def test_with_a_lag_the_curve_does_not_depend_on_who_is_fast(tmp_path: Path) -> None:
    policies, max_lag = set(), 2
    where: list[tuple[int, Literal["inproc", "ipc"]]] = [(1, "inproc"), (3, "ipc")]
    for workers, transport in where:
        folder = millrace.train(
            lambda: Uneven(gymnasium.make("CartPole-v1")),
            run_dir=str(tmp_path), seed=3, workers=workers, transport=transport, max_lag=max_lag, envs=4, rollout_steps=16,
            steps=640, eval_every=200, batch_size=64, **SMALL,
        ).path  # fmt: skip
        policies.add(policy_of(folder))
        lags = [row["lag/max"] for row in read_rows(folder / "metrics.jsonl")]
        assert lags == [min(update, max_lag) for update in range(len(lags))]
    assert len(policies) == 1


def test_with_a_lag_a_lost_worker_leads_to_the_same_run_whoever_is_fast(tmp_path: Path) -> None:
    """There are three workers for two lanes: the spare one takes the lane over, whichever it is."""
    died = tmp_path / "died"

    class Dies(Uneven):
        def __init__(self, env: Any) -> None:
            super().__init__(env)
            copy = millrace.env_copy()
            self.steps, self.dies = 0, copy.lane == 0 and not copy.evaluation

        def step(self, action: Any) -> Any:
            self.steps += 1
            if self.dies and self.steps == 90 and not died.exists():
                died.touch()
                os._exit(1)
            return super().step(action)

    policies = set()
    for _ in range(2):
        died.unlink(missing_ok=True)
        folder = millrace.train(
            lambda: Dies(gymnasium.make("CartPole-v1")),
            run_dir=str(tmp_path), seed=3, workers=3, lanes=2, envs=2, max_lag=1, rollout_steps=20, steps=400, eval_every=0,
            batch_size=20, worker_timeout_s=5.0, **SMALL,
        ).path  # fmt: skip
        assert died.exists()
        assert summary(folder)["ledger"]["lost"] in (1, 2)
        policies.add(policy_of(folder))
    assert len(policies) == 1


@pytest.mark.soak
def test_a_run_with_rounded_weights_learns(tmp_path: Path) -> None:
    """The run reaches a good return. Its weights differ from those of a run with exact weights, as expected."""
    settings: dict[str, Any] = {"steps": 12_000, "seed": 3, "eval_episodes": 5, "learning_rate": 0.003, "rollout_steps": 64}
    env = f"{TOY}Identity-v0"
    folders = {dtype: run(tmp_path, env, acting_dtype=dtype, **settings) for dtype in ("float32", "bfloat16")}
    for folder in folders.values():
        assert summary(folder)["evaluation"]["return_mean"] == 10
        assert summary(folder)["return_mean_100"] > 8  # a random policy returns 2.5
    assert len({policy_of(folder) for folder in folders.values()}) == 2


@pytest.mark.parametrize("max_lag", [0, 1])
def test_workers_have_a_lower_priority_than_updates_that_use_all_cores_meanwhile(
    tmp_path: Path, max_lag: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("millrace.learner.torch_setup.usable_cores", lambda: 2)
    found: list[int] = []
    settings: dict[str, Any] = {"max_lag": max_lag, "torch_threads": 2, "steps": 500, "eval_episodes": 1}
    run(tmp_path, "CartPole-v1", lambda progress: found.extend(each.nice() for each in worker_processes()), **settings)
    assert set(found) == ({19} if max_lag else {os.nice(0)})


@pytest.mark.parametrize("max_lag", [0, 1])
def test_the_learners_stages_sum_to_its_time(tmp_path: Path, max_lag: int) -> None:
    folder = run(tmp_path, "CartPole-v1", max_lag=max_lag, steps=12_000, **SMALL)
    first, *_, last = read_rows(folder / "metrics.jsonl")
    names = ("learner_wait", "learner_update", "learner_other")
    told = sum(last[f"stage/{name}"] - first[f"stage/{name}"] for name in names)
    assert told == pytest.approx(last["time/time_elapsed"] - first["time/time_elapsed"], abs=1e-6)


def test_the_best_policy_of_the_evaluations_is_kept_and_evaluated_again(tmp_path: Path) -> None:
    """The greedy return of CartPole rises and falls. The policy with the highest return is kept, not the last one.

    With some seeds the last one is the best: which seeds these are depends on the processor's last bits.
    """
    settings: dict[str, Any] = {"steps": 6_000, "eval_every": 500, "eval_episodes": 4, "learning_rate": 0.01}
    for seed in range(3, 8):
        folder = run(tmp_path, "CartPole-v1", seed=seed, **settings)
        if summary(folder)["best"]["env_steps"] < summary(folder)["env_steps"]:
            break
    evaluations = {
        row["time/total_timesteps"]: row["eval/mean_reward"]
        for row in read_rows(folder / "metrics.jsonl")
        if "eval/mean_reward" in row
    }
    best = summary(folder)["best"]
    assert len(evaluations) >= 10
    assert best["chosen_by"] == max(evaluations.values()) == evaluations[best["env_steps"]]
    assert best["evaluation"]["episodes"] == 4
    final, kept = (load_policy(folder, which) for which in ("final", "best"))
    assert best["env_steps"] < summary(folder)["env_steps"]
    zeros = [np.zeros((1, 1, 4), np.float32)]
    assert not np.array_equal(final[0](zeros), kept[0](zeros))


def test_a_run_stops_at_a_mean_return(tmp_path: Path) -> None:
    folder = run(tmp_path, "CartPole-v1", target_mean_return=40.0, eval_episodes=1)
    found = summary(folder)
    assert found["stop_reason"] == "mean return 40 of the last episodes reached"
    assert found["return_mean_100"] >= 40
    assert found["env_steps"] < 50_000


def test_a_checkpoint_is_saved_after_every_update_if_no_second_may_pass(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"checkpoint_every_s": 0.0, "keep_checkpoints": 100, "steps": 2_560, **SMALL}
    folder = run(tmp_path, "CartPole-v1", **settings)
    assert len(list((folder / "checkpoints").iterdir())) == 1 + summary(folder)["updates"]  # one at the start


@pytest.mark.parametrize("chunk_bytes", [1, 2**20], ids=["while it trains", "at its end"])
def test_a_dataset_for_which_there_is_no_space_costs_no_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, chunk_bytes: int
) -> None:
    """HDF5 would end the process. The run is complete, and fails as one whose summary cannot be written."""
    monkeypatch.setattr("millrace.extras.datasets.minari.CHUNK_BYTES", chunk_bytes)
    with small_disk(tmp_path / "disk") as disk:
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(disk))
        filler = filled(disk)
        os.truncate(filler, filler.stat().st_size - 30_000)  # so that the first write begins
        with pytest.raises(RunError) as caught:
            run(tmp_path, "CartPole-v1", steps=3_000, record="cartpole/training-v0", **SMALL)
        says = r"dataset cartpole/training-v0 was not written: .*No space left on device"
        assert re.fullmatch(says, str(caught.value))
        assert caught.value.__notes__[0] == "raised in TrainingRecorder.on_end"
        assert list(disk.iterdir()) == [filler]
    (folder,) = tmp_path.glob("runs*/*")
    assert summary(folder)["stop_reason"] == ALL_STEPS_DONE
    said = [record.getMessage() for record in caplog.records if "not written" in record.getMessage()]
    assert len(said) == (chunk_bytes == 1)


def test_training_episodes_are_recorded_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    folder: Path | None = None
    recorded = 0
    for name, steps in (("training", 3_000), ("resumed", 6_000)):
        caplog.clear()
        env = "" if folder else "CartPole-v1"
        folder = run(tmp_path, env, resume=folder, steps=steps, max_lag=1, record=f"cartpole/{name}-v0", **SMALL)
        dataset = minari.load_dataset(f"cartpole/{name}-v0")
        episodes = list(dataset.iterate_episodes())
        assert len(episodes) > 20
        for episode in episodes:
            assert len(episode.observations) == len(episode.rewards) + 1
            assert bool(episode.terminations[-1]) or bool(episode.truncations[-1])
            assert not (episode.terminations[:-1] | episode.truncations[:-1]).any()
            assert np.abs(episode.observations[0]).max() <= 0.05, "it does not begin with a reset of CartPole"
        said = re.search(r"([\d,]+) steps of others left out", caplog.text)
        recorded += dataset.total_steps + (int(said[1].replace(",", "")) if said else 0)
        assert recorded == read_rows(folder / "metrics.jsonl")[-1]["time/total_timesteps"]


def test_a_resumed_run_records_whole_episodes_into_another_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))

    def recorded(dataset_id: str) -> list[tuple[bytes, bytes]]:
        episodes = minari.load_dataset(dataset_id).iterate_episodes()
        return [(episode.observations.tobytes(), episode.actions.tobytes()) for episode in episodes]

    class Interrupts(millrace.Callback):
        def on_update(self, progress: Progress) -> None:
            if progress.updates == 3:
                raise KeyboardInterrupt

    settings: dict[str, Any] = {**SMALL, "steps": 1_000, "envs": 4, "lanes": 2, "rollout_steps": 64}
    settings |= {"workers": 1, "transport": "inproc", "run_dir": str(tmp_path), "progress": False}
    millrace.train("CartPole-v1", record="cartpole/whole-v0", **settings)
    settings |= {"record": "cartpole/training-v0", "run_dir": str(tmp_path / "interrupted")}
    with pytest.raises(KeyboardInterrupt):
        millrace.train("CartPole-v1", callbacks=[Interrupts()], **settings)
    before = recorded("cartpole/training-v0")
    steps = millrace.train("CartPole-v1", resume="auto", **settings).metrics["time/total_timesteps"][2]
    after = recorded("cartpole/training-v1")
    whole = recorded("cartpole/whole-v0")
    assert recorded("cartpole/training-v0") == before
    assert len(before) > 3
    assert len(after) > 3
    assert {*before, *after} <= {*whole}
    assert len(whole) - 4 <= len({*before, *after}) == len(before) + len(after), "only those that ran then may be missing"
    about = json.loads((tmp_path / "datasets/cartpole/training-v1/data/metadata.json").read_text())["description"]
    assert f"that began after it was resumed at {steps:,.0f} env steps" in about


def test_a_killed_worker_is_replaced_and_the_run_ends_well(
    tmp_path: Path, inference: str, caplog: pytest.LogCaptureFixture
) -> None:
    killed, gone, back = False, False, False

    def watch(progress: Progress) -> None:
        nonlocal killed, gone, back
        if progress.updates == 5:
            worker_processes()[0].kill()
            killed = True
        # Where the learner acts, an update has the rows of all lanes: none is made while a worker is away.
        gone |= killed and (progress.workers_alive == 1 or inference == "learner")
        back |= gone and progress.updates > 6 and progress.workers_alive == 2
        if killed and not back:
            time.sleep(0.3)  # the other worker's steps must not use up the run before the new one has started

    caplog.set_level("WARNING")
    folder = run(tmp_path, "CartPole-v1", watch, steps=10_000, inference=inference, **SMALL)
    found = summary(folder)
    assert gone, "nobody noticed that the worker was killed"
    assert back, "the killed worker never came back"
    assert found["stop_reason"] == "all steps done"
    assert 10_000 - 256 < found["env_steps"] <= 10_000
    assert "was killed by SIGKILL" in caplog.text
    balanced(found)
    if inference == "learner":  # it costs only the episodes of its copies
        assert caplog.text.count("comes back truncated") == 2, "the killed worker had two of the four lanes"
        assert found["ledger"]["lost"] == 0


def test_an_environment_that_raises_ends_the_run_with_its_own_traceback(tmp_path: Path, inference: str) -> None:
    expected = r"; failure .* (in a row|within an hour).*; max_env_failures allows 1"
    with pytest.raises(EnvironmentFailed, match=expected) as failure:
        run(tmp_path, f"{TOY}Raises-v0", max_env_failures=1, inference=inference, **SMALL)
    assert "toy.py" in failure.value.detail, "the traceback is not the worker's"
    assert "Traceback" in failure.value.detail
    assert "\n" not in str(failure.value)
    assert re.search("worker w.*its environment raised ValueError", str(failure.value))


class Unreachable(Countdown):
    """Cannot be reset."""

    def reset(self, **kwargs: Any) -> Any:
        raise ConnectionRefusedError("no simulator at this port")


def test_an_environment_that_raises_at_each_reset_ends_a_run_of_many_copies_soon(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"run_dir": str(tmp_path), "transport": "inproc", "workers": 2, "envs": 16, "lanes": 16}
    with pytest.raises(EnvironmentFailed, match=r"first reset: .*no simulator.*; failure 4 in a row; ") as failure:
        millrace.train(Unreachable, **settings)
    assert "in reset\n    raise ConnectionRefusedError" in failure.value.detail, "the traceback is not the worker's"


def test_a_run_continues_after_an_environment_raised_once(tmp_path: Path, inference: str) -> None:
    once = str(tmp_path / "raised")
    settings: dict[str, Any] = {"env_kwargs": {"once": once, "after": 30}, "workers": 1, "steps": 2_000, **SMALL}
    found = summary(run(tmp_path, f"{TOY}Raises-v0", inference=inference, **settings))
    assert Path(once).exists()
    assert found["stop_reason"] == "all steps done"
    lost = balanced(found)["lost"]
    assert lost == 4 if inference == "learner" else lost > 0  # tickets of the unfinished rollouts


@pytest.mark.parametrize(("env", "what"), [("NaNObservation", "observation"), ("NaNReward", "reward")])
def test_nan_ends_the_run_with_an_error_that_says_where(tmp_path: Path, env: str, what: str, inference: str) -> None:
    with pytest.raises(EnvironmentFailed, match=rf"lane \d.*{what}.*nan at step \d+, copy \d+"):
        run(tmp_path, f"{TOY}{env}-v0", max_env_failures=0, inference=inference, **SMALL)


def test_a_run_whose_workers_cannot_start_fails(tmp_path: Path, inference: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The workers cannot start. The run ends at its deadline and says what it waited for."""
    monkeypatch.setattr("millrace.workers.supervise.worker_process.sys.executable", "/bin/false")
    with pytest.raises(NoWorkers, match="waited 1 s for 1 worker"):
        run(tmp_path, "CartPole-v1", no_workers_timeout_s=1.0, inference=inference, **SMALL)


@pytest.mark.parametrize(
    ("observation", "action", "transport"),
    [
        ("image", "discrete", "ipc"),
        ("nested", "table", "inproc"),
        ("dict", "multibinary", "inproc"),
        ("unbounded", "half", "inproc"),
        ("multidiscrete", "offset", "inproc"),
        ("tuple", "unbounded", "inproc"),
    ],
)
def test_a_run_learns_with_every_kind_of_space(tmp_path: Path, observation: str, action: str, transport: str) -> None:
    kwargs = {"observation": observation, "action": action}
    settings: dict[str, Any] = {
        "env_kwargs": kwargs,
        "transport": transport,
        "workers": 1,  # each imports PyTorch if it acts on images
        "rollout_steps": 16,
        "steps": 400,
        "normalize_observations": True,
    }
    folder = run(tmp_path, f"{TOY}Spaces-v0", **settings, **SMALL)
    found = summary(folder)
    assert found["updates"] >= 2
    assert found["ledger"]["transitions_invalid"] == 0
    assert found["evaluation"]["episodes"] == 2


@pytest.mark.parametrize(
    ("inference", "refusal"), [("workers", "ipc or inproc only"), ("learner", "an environment factory is code")]
)
def test_an_environment_may_be_a_callable_and_travels_to_local_workers_only(
    tmp_path: Path, inference: str, refusal: str
) -> None:
    def balance(gravity: float = 9.8) -> gymnasium.Env[Any, Any]:
        env = gymnasium.make("CartPole-v1")
        env.unwrapped.gravity = gravity  # type: ignore[attr-defined]
        return env

    settings: dict[str, Any] = {"steps": 1_000, "run_dir": str(tmp_path), "env_kwargs": {"gravity": 5.0}, **SMALL}
    settings |= {"inference": inference}
    folder = millrace.train(balance, **settings).path
    assert summary(folder)["env"] == "<balance>"
    with pytest.raises(UsageError, match=refusal):
        millrace.train(balance, transport="tcp", **settings)


def test_learner_and_workers_train_as_separate_processes(tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/learner"
    flags = ["CartPole-v1", "--bind", address, "--min-workers", "2", "--steps", "2000", "--eval-episodes", "2"]
    command = [sys.executable, "-m", "millrace", "learner", *flags, "--run-dir", str(tmp_path / "runs")]
    learner = preloaded.start(command, stderr=subprocess.PIPE)
    workers = [
        preloaded.start([sys.executable, "-m", "millrace.workers", address], stderr=subprocess.PIPE) for _ in range(2)
    ]
    _, said = learner.communicate(timeout=60)
    assert learner.returncode == 0, said
    for worker in workers:
        _, said = worker.communicate(timeout=20)
        assert worker.returncode == 0, said
    (folder,) = (tmp_path / "runs").iterdir()
    assert summary(folder)["stop_reason"] == "all steps done"
    again = preloaded.run([sys.executable, "-m", "millrace", "learner", "--resume", str(folder)], timeout=60)
    assert again.returncode == 0, "a run that is done waits for workers"


def test_a_worker_without_a_learner_says_that_nobody_answers(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "millrace.workers", f"ipc://{tmp_path}/nobody", "--join-timeout-s", "0.5"]
    worker = preloaded.run(command, timeout=30)
    assert worker.returncode == 1
    assert worker.stderr.count("\n") == 1
    assert "no learner answered for 0.5 s" in worker.stderr
    assert "is the learner running" in worker.stderr


def test_an_occupied_port_is_one_line_and_leaves_no_folder(tmp_path: Path, inference: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        command = [sys.executable, "-m", "millrace", "learner", "CartPole-v1", "--bind", address]
        command += ["--inference", inference]
        learner = preloaded.run([*command, "--run-dir", str(tmp_path / "runs")], timeout=60)
    assert learner.returncode == 2
    assert (
        learner.stderr
        == f"millrace: address {address} is in use; choose another port, or tcp://127.0.0.1:* for any free one\n"
    )
    assert not (tmp_path / "runs").exists()


# ---------------------------------------------------------------- the learner as a process


def checkpoints(tmp_path: Path) -> list[Path]:
    return sorted(tmp_path.glob("runs/*/checkpoints/*.pt"))


def test_ctrl_c_drains_saves_and_says_how_to_resume(tmp_path: Path, inference: str) -> None:
    """Also while no env step is answered."""
    learner = start(tmp_path, "--inference", inference)
    wait_for(lambda: any(len(read_rows(path)) > 10 for path in tmp_path.glob("runs/*/metrics.jsonl")), START_S, "10 updates")
    workers = preloaded.workers_of(learner.pid)
    assert len(workers) == 2
    if inference == "learner":
        for worker in workers:
            worker.suspend()
    learner.send_signal(signal.SIGINT)
    _, stderr = learner.communicate(timeout=40)
    assert learner.returncode == 130
    assert b"--resume" in stderr
    assert b"Traceback" not in stderr
    assert not any(worker.is_running() for worker in workers), "a worker outlived its learner"
    (folder,) = tmp_path.glob("runs/*")
    steps = read_rows(folder / "metrics.jsonl")[-1]["time/total_timesteps"]
    assert int(checkpoints(tmp_path)[-1].stem) == steps, "the last update was not saved"
    assert summary(folder)["stop_reason"] == "interrupted"


def test_a_learner_that_was_killed_goes_on_from_its_newest_checkpoint(tmp_path: Path) -> None:
    learner = start(tmp_path, "--checkpoint-every-s", "0.2", "--steps", "100000000")
    wait_for(lambda: len(checkpoints(tmp_path)) >= 3, START_S, "three checkpoints")
    workers = preloaded.workers_of(learner.pid)
    os.kill(learner.pid, signal.SIGKILL)
    learner.communicate(timeout=10)
    _, alive = psutil.wait_procs(workers, timeout=10)
    assert not alive, "workers outlived their host"
    assert not list((tmp_path / "tmp").glob("millrace-*")), "nobody tidied up after the learner"
    (folder,) = tmp_path.glob("runs/*")
    saved = int(checkpoints(tmp_path)[-1].stem)
    rows = read_rows(folder / "metrics.jsonl")
    (clock,) = (row["time/time_elapsed"] for row in rows if row["time/total_timesteps"] == saved)
    first: list[Progress] = []

    def watch(progress: Progress) -> None:
        first.append(progress)

    steps = saved + 4_000
    run(tmp_path, watch=watch, resume=folder, steps=steps)
    assert saved < first[0].env_steps <= saved + 256, "it did not go on from the newest checkpoint"
    assert first[0].wall_s > clock, "the clock began again"
    found = summary(folder)
    assert steps - 256 < found["env_steps"] <= steps
    balanced(found)
    curve = [row["time/total_timesteps"] for row in read_rows(folder / "metrics.jsonl")]
    assert curve == sorted(set(curve)), "the curve goes over the same steps twice"


def test_a_run_that_goes_on_has_no_summary_until_it_ends_again(tmp_path: Path) -> None:
    folder = run(tmp_path, "CartPole-v1", steps=512, transport="inproc", workers=1, **SMALL)
    ended = millrace.Run(folder)
    assert ended.summary is not None
    meanwhile: list[tuple[str, int, bool]] = []

    def watch(progress: Progress) -> None:
        if progress.env_steps > 1_000 and not meanwhile:
            assert ended.summary is None
            shown = read_run(folder).progress
            meanwhile.append((shown.stop_reason, shown.total_steps, shown.at_s > 0))

    run(tmp_path, watch=watch, resume=folder, steps=1_536)
    assert meanwhile == [("", 1_536, True)]
    assert ended.summary.env_steps > 1_000


@pytest.mark.parametrize("worker_timeout_s", [1.0, 30.0], ids=["shorter", "longer"])
def test_a_worker_whose_environment_hangs_is_ended_and_replaced(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, worker_timeout_s: float
) -> None:
    caplog.set_level("INFO", "millrace")
    settings = {"step_timeout_s": 2.0, "worker_timeout_s": worker_timeout_s, "max_env_failures": 1, **SMALL}
    with pytest.raises(EnvironmentFailed, match=r"took longer than 2 s \(--step-timeout-s\), at .*toy.py.*; failure 2"):
        run(tmp_path, f"{TOY}Hangs-v0", workers=1, steps=100_000, **settings)
    said = [record.getMessage() for record in caplog.records]
    assert len([line for line in said if "joined" in line]) >= 2
    assert not [line for line in said if "silent" in line]


Ask = Callable[..., subprocess.CompletedProcess[str]]


@contextmanager
def training(tmp_path: Path, *flags: str) -> Iterator[tuple[subprocess.Popen[bytes] | preloaded.ForkedProcess, Path, Ask]]:
    """A learner that trains, its run folder, and a function that runs `millrace status` of it; ended afterwards."""
    learner = start(tmp_path, "--steps", "100000000", "--workers", "2", *flags)
    try:
        wait_for(
            lambda: any(len(read_rows(path)) > 3 for path in tmp_path.glob("runs/*/metrics.jsonl")), START_S, "3 updates"
        )
        (folder,) = tmp_path.glob("runs/*")

        def status(*flags: str) -> subprocess.CompletedProcess[str]:
            command = [sys.executable, "-m", "millrace", "status", str(folder), *flags]
            return preloaded.run(command, timeout=60)

        yield learner, folder, status
    finally:
        learner.send_signal(signal.SIGINT)
        learner.communicate(timeout=30)


def test_status_asks_the_learner_of_a_run_that_acts_in_the_learner(tmp_path: Path) -> None:
    """Its answer is the run's, with the processes that step the env copies."""
    with training(tmp_path, "--inference", "learner") as (learner, _, status):
        asked = status("--json")
        assert asked.returncode == 0, asked.stderr
        answer = json.loads(asked.stdout)
        progress = answer["progress"]
        assert (answer["env"], progress["total_steps"]) == ("CartPole-v1", 100_000_000)
        assert progress["env_steps"] > 0
        assert progress["ledger"]["used"] > 0
        assert {worker["pid"] for worker in answer["workers"]} == {one.pid for one in preloaded.workers_of(learner.pid)}


@pytest.mark.parametrize(
    ("flags", "why"),
    [
        (("--transport", "inproc"), "with --transport inproc it listens in its own process only"),
        (("--transport", "inproc", "--inference", "learner"), "with --transport inproc it listens in its own process only"),
        (("--transport", "tcp", "--keys", "KEYS"), "the keys of its local workers are not in any file"),
    ],
)
def test_status_of_a_run_that_nobody_can_ask_is_one_line_that_says_why(
    tmp_path: Path, flags: tuple[str, ...], why: str
) -> None:
    keys = str(tmp_path / "keys")
    with training(tmp_path, *(keys if flag == "KEYS" else flag for flag in flags)) as (learner, folder, status):
        refused = status()
    assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (2, "", 1)
    assert f"run {folder}: process {learner.pid} on " in refused.stderr
    assert why in refused.stderr
    assert refused.stderr.endswith("run it with --transport ipc\n")


def test_status_asks_the_learner_that_train_started_by_its_run_folder(tmp_path: Path) -> None:
    with training(tmp_path) as (learner, folder, status):
        answer = json.loads(status("--json").stdout)
        assert answer["env"] == "CartPole-v1"
        assert answer["progress"]["env_steps"] > 0
        assert not check_format(folder).workers_elsewhere
        assert {worker["worker"] for worker in answer["workers"]} == {"w0", "w1"}
        assert {worker["pid"] for worker in answer["workers"]} == {one.pid for one in preloaded.workers_of(learner.pid)}
        assert "nothing was lost or dropped" in status().stdout
    ended = status()
    assert (ended.returncode, ended.stderr) == (0, "")
    assert re.match("Interrupted; continue it with: .*millrace train --resume ", ended.stdout)


def test_a_local_run_keeps_within_the_env_copies_of_its_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without room for an evaluation nothing starts. The limit is no setting of the run, which may resume elsewhere."""
    seen: list[int] = []

    class Starts(Exception):
        """The run may start."""

    def starts(config: Config, *rest: object, elsewhere: bool) -> NoReturn:
        seen.append(config.max_env_copies)
        raise Starts

    monkeypatch.setattr("millrace.launch.training._pool", starts)
    for here, of_run in (("", 0), ("", 9), ("7", 0), ("7", 9), ("7", 6)):
        monkeypatch.setenv(LIMIT_VARIABLE, here)
        config = resolve("CartPole-v1", inference="learner", envs=4, lanes=4, eval_copies=2, max_env_copies=of_run)
        with pytest.raises(Starts):
            train(config, None, lambda progress: None)
    assert seen == [0, 9, 0, 9, 6]
    monkeypatch.setenv(LIMIT_VARIABLE, "5")
    with pytest.raises(UsageError, match=f"^{LIMIT_VARIABLE} 5: expected at least 6, for 4 env copies and 2 that play"):
        train(config, None, lambda progress: None)
