"""How cores are counted and shared out between a learner and its workers."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar, Literal

import gymnasium
import pytest
import threadpoolctl
import torch
from msgspec.structs import replace

import millrace
from millrace.launch.crew import crew_of_run, worker_cores
from millrace.learner import torch_setup
from millrace.learner.between_updates.crowded_cores import CrowdedCores
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.run_format import POLICY_ARRAYS
from millrace.learner.torch_setup import one_thread, threads
from millrace.protocol.machine.waiting_threads import VARIABLE as WAIT
from millrace.protocol.policy.own_encoder import describe_encoder
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec

CORES = {2, 3}


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: CORES, raising=False)
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, mask: None, raising=False)


def test_a_program_has_its_threads_again_whichever_run_ends_first(monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = [4]
    monkeypatch.setattr(torch, "get_num_threads", lambda: numbers[-1])
    monkeypatch.setattr(torch, "set_num_threads", numbers.append)
    runs = [one_thread() for _ in range(3)]
    for run, of_run in zip(runs, (2, 3, 5), strict=True):
        run.__enter__()
        torch.set_num_threads(of_run)
    found = []
    for run in (runs[1], runs[0], runs[2]):
        run.__exit__(None, None, None)
        found.append(torch.get_num_threads())
    assert found == [5, 5, 4]


@pytest.mark.parametrize(
    ("workers", "max_lag", "kept"),
    [
        (2, 0, True),
        (4, 0, True),
        (1, 0, False),  # another run's only worker would keep to the same core
        (3, 0, False),
        (2, 1, False),  # the learner runs beside them
    ],
)
def test_workers_keep_to_the_cores_that_this_process_may_use(workers: int, max_lag: int, kept: bool) -> None:
    config = resolve("CartPole-v1", workers=workers, max_lag=max_lag)
    assert worker_cores(config) == (sorted(CORES) if kept else [])


def test_workers_that_only_step_use_any_core(tmp_path: Path) -> None:
    """The thread that acts would have to leave its core whenever it orders a step of a worker that is pinned there."""
    for inference, cores in (("workers", sorted(CORES)), ("learner", [])):
        assert list(crew_of_run(resolve("CartPole-v1", workers=2, inference=inference), tmp_path).cores) == cores


def test_where_the_system_cannot_they_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_setaffinity")
    assert worker_cores(resolve("CartPole-v1", workers=2)) == []


ACTION = ActionSpec("discrete", (), "int64", (2,), (0,))
SMALL = PolicySpec((Leaf("", "box", (4,), "float32"),), ACTION)
WIDE = PolicySpec((Leaf("", "box", (4,), "float32"),), ACTION, net=(256, 256))
LARGE = PolicySpec((Leaf("", "box", (4,), "float32"),), ACTION, net=(512, 512))
RECURRENT = PolicySpec((Leaf("", "box", (4,), "float32"),), ACTION, core="lstm")
FEATURES = PolicySpec((Leaf("", "discrete", (), "int64", (500,), (0,)),), ACTION)
IMAGES = PolicySpec((Leaf("", "box", (84, 84, 4), "uint8", divisor=255),), ACTION)


SMALL_IMAGES = PolicySpec((Leaf("", "box", (7, 7, 3), "uint8"),), ACTION)


@pytest.mark.parametrize(
    ("policy", "rows", "max_lag", "workers", "count"),
    [
        (SMALL, 1 << 20, 0, 2, 1),
        (RECURRENT, 64, 0, 2, 1),
        (FEATURES, 64, 0, 2, 1),
        (WIDE, 4096, 0, 2, 1),
        (LARGE, 64, 0, 2, 1),
        (LARGE, 256, 0, 2, 4),
        (LARGE, 4096, 0, 2, 8),  # workers wait while it learns
        (LARGE, 256, 1, 2, 4),
        (SMALL_IMAGES, 64, 0, 2, 1),
        (IMAGES, 32, 0, 2, 7),
        (IMAGES, 64, 0, 2, 8),
        (IMAGES, 64, 1, 2, 6),
        (IMAGES, 64, 1, 0, 8),  # they are elsewhere
        (IMAGES, 64, 1, 3, 5),
        # Workers wait most of the time: the learner on half of the cores would be slower than without lag.
        (IMAGES, 64, 1, 4, 8),
        (IMAGES, 64, 1, 8, 8),
        (IMAGES, 64, 1, 20, 8),
    ],
)
def test_each_thread_has_work_and_the_learner_takes_the_cores_that_workers_leave(
    monkeypatch: pytest.MonkeyPatch, policy: PolicySpec, rows: int, max_lag: int, workers: int, count: int
) -> None:
    monkeypatch.setattr(torch_setup, "usable_cores", lambda: 8)
    assert threads(policy, rows, max_lag, workers).number == count


def small_encoder(features: int, images: list[tuple[int, ...]]) -> torch.nn.Module:
    return torch.nn.Sequential(torch.nn.Linear(features, 64), torch.nn.ReLU(), torch.nn.Linear(64, 64))


def large_encoder(features: int, images: list[tuple[int, ...]]) -> torch.nn.Module:
    return torch.nn.Sequential(torch.nn.Linear(features, 1024), torch.nn.ReLU(), torch.nn.Linear(1024, 1024))


@pytest.mark.parametrize(("encoder", "count"), [("small_encoder", 1), ("large_encoder", 2)])
def test_an_encoder_has_the_threads_that_its_work_is_worth(
    monkeypatch: pytest.MonkeyPatch, encoder: str, count: int
) -> None:
    monkeypatch.setattr(torch_setup, "usable_cores", lambda: 8)
    described = describe_encoder(f"{__name__}:{encoder}", SMALL.observation, ACTION)
    chosen = threads(replace(SMALL, encoder=described), 64, 0, 2)
    assert chosen.number == count
    assert chosen.line.startswith(f"PyTorch uses {count} of 8 cores: a pass of 64 rows has ")
    assert not threads(SMALL, 64, 0, 2).line


def test_the_rows_of_a_minibatch_follow_from_the_settings() -> None:
    settings: dict[str, Any] = {"envs": 8, "rollout_steps": 16, "preset": "none"}
    assert resolve("CartPole-v1", algo="ppo", batch_size=32, **settings).algorithm.minibatch_rows(8) == 32
    assert resolve("CartPole-v1", algo="a2c", **settings).algorithm.minibatch_rows(8) == 8 * 16
    assert resolve("CartPole-v1", algo="impala", minibatches=4, **settings).algorithm.minibatch_rows(8) == 8 * 4
    assert resolve("CartPole-v1", algo="dqn", batch_size=128, **settings).algorithm.minibatch_rows(8) == 128


@pytest.mark.parametrize(
    ("threads", "took_s", "computed_s", "says"),
    [(2, 62.0, 1.6, True), (1, 62.0, 1.6, False), (0, 62.0, 1.6, False), (2, 9.0, 0.1, False), (8, 62.0, 40.0, False)],
)
def test_an_update_whose_threads_wait_for_cores_is_said_once(
    threads: int, took_s: float, computed_s: float, says: bool
) -> None:
    cores = CrowdedCores(threads)
    line = cores.updated(took_s, computed_s)
    assert bool(line) is says
    if says:
        assert line.startswith("an update took 62 s and computed for 2 s of them: PyTorch's 2 threads wait for cores")
        assert line.endswith("compare --torch-threads 1")
    assert not cores.updated(took_s, computed_s)


@pytest.mark.parametrize(
    ("imports", "variable", "spin"),
    [
        ("millrace; import torch", "", False),
        ("torch; import millrace", "", True),
        ("torch; import millrace", "PASSIVE", False),
    ],
)
def test_threads_sleep_while_they_wait_if_millrace_is_imported_before_torch(
    imports: str, variable: str, spin: bool, tmp_path: Path
) -> None:
    (tmp_path / "torch.py").touch()
    asks = f"from millrace.protocol.machine.waiting_threads import SPIN; print(SPIN, os.environ[{WAIT!r}])"
    program = f"import {imports}; import os; {asks}"
    environment = {name: value for name, value in os.environ.items() if name != WAIT} | (
        {WAIT: variable} if variable else {}
    )
    environment["PYTHONPATH"] = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])])
    said = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=60)
    assert said.stdout.split() == [str(spin), "PASSIVE"], said.stderr


def test_a_run_keeps_the_number_of_threads_that_it_began_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever resumes or repeats it with its config.toml on a machine of another size gets the same bits."""
    settings: dict[str, Any] = {
        "rollout_steps": 8,
        "envs": 4,
        "eval_episodes": 1,
        "transport": "inproc",
        "net": (512, 512),
        "batch_size": 512,
    }
    used: list[int] = []
    monkeypatch.setattr(torch, "set_num_threads", used.append)
    monkeypatch.setattr(torch_setup, "usable_cores", lambda: 3)
    folder = millrace.train("CartPole-v1", run_dir=str(tmp_path), steps=64, **settings).path
    assert "torch_threads = 3" in (folder / "config.toml").read_text()
    monkeypatch.setattr(torch_setup, "usable_cores", lambda: 7)
    millrace.train(resume=folder, steps=128)
    again = millrace.train(config=folder / "config.toml", run_dir=str(tmp_path / "again")).path
    assert used.count(3) == 3
    assert 7 not in used
    assert "torch_threads = 3" in (again / "config.toml").read_text()


def thread_counts() -> tuple[int, int]:
    """Of BLAS, which numpy and scipy each have, and of PyTorch."""
    (blas,) = {
        pool["num_threads"] for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"
    }  # scipy has its own
    return blas, torch.get_num_threads()


class CountsThreads(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Notes at each reset how many threads this process has: with inproc, the learner's."""

    noted: ClassVar[set[tuple[int, int]]] = set()

    def reset(self, **keywords: Any) -> Any:
        self.noted.add(thread_counts())
        return super().reset(**keywords)


@pytest.mark.parametrize("inference", ["workers", "learner"])
def test_a_run_has_its_own_threads_whoever_imported_numpy(inference: Literal["workers", "learner"], tmp_path: Path) -> None:
    """So a script gets the bits of the command line, and its speed beside other processes. It keeps its threads."""
    settings: dict[str, Any] = {"rollout_steps": 64, "envs": 4, "eval_episodes": 1, "net": (256, 256), "steps": 256}
    CountsThreads.noted.clear()
    policies = []
    before = torch.get_num_threads()
    try:
        for count in (2, 1):
            torch.set_num_threads(count)
            with threadpoolctl.threadpool_limits(count, "blas"):
                run = millrace.train(
                    "CartPole-v1",
                    wrappers=[CountsThreads],
                    run_dir=str(tmp_path / str(count)),
                    transport="inproc",
                    inference=inference,
                    progress=False,
                    **settings,
                )
                assert CountsThreads.noted == {(1, 1)}
                CountsThreads.noted.clear()
                run.evaluate(episodes=2, inference=inference, transport="inproc", progress=False)
                assert {blas for blas, _ in CountsThreads.noted} == {1}
                CountsThreads.noted.clear()
                assert thread_counts() == (count, count), "as the program had them"
            policies.append((run.path / POLICY_ARRAYS["final"]).read_bytes())
    finally:
        torch.set_num_threads(before)
    assert policies[0] == policies[1]


@pytest.mark.parametrize(
    ("max_lag", "torch_threads", "cores", "all_of_them"),
    [(1, 2, 2, True), (1, 4, 2, True), (0, 2, 2, False), (1, 1, 2, False), (1, 2, 4, False), (1, 1, 1, False)],
)
def test_updates_use_all_cores_while_workers_collect(
    max_lag: int, torch_threads: int, cores: int, all_of_them: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch_setup, "usable_cores", lambda: cores)
    config = resolve("CartPole-v1", max_lag=max_lag, torch_threads=torch_threads, device="cpu")
    assert torch_setup.updates_use_all_cores(config) is all_of_them


def test_updates_on_a_gpu_leave_workers_all_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch_setup, "usable_cores", lambda: 2)
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    for device, all_cores in [("cpu", True), ("cuda", False), ("auto", False)]:
        config = resolve("CartPole-v1", max_lag=1, torch_threads=2, device=device)
        assert torch_setup.updates_use_all_cores(config) is all_cores
