"""How cores are counted and shared out between a learner and its workers."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, ClassVar, Literal

import gymnasium
import pytest
import threadpoolctl
import torch

import millrace
from learner import torch_setup
from learner.config.layers import resolve
from learner.run_folder.run_format import POLICY_ARRAYS
from learner.torch_setup import one_thread, threads
from millrace.launch.local_worker_options import worker_cores
from protocol.specs import ActionSpec, Leaf, PolicySpec

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


@pytest.mark.parametrize(
    ("policy", "max_lag", "workers", "count"),
    [
        (SMALL, 0, 2, 1),
        (RECURRENT, 0, 2, 1),
        (FEATURES, 0, 2, 1),
        (WIDE, 0, 2, 1),
        (LARGE, 0, 2, 8),  # workers wait while it learns
        (IMAGES, 0, 2, 8),
        (IMAGES, 1, 2, 6),
        (IMAGES, 1, 0, 8),  # they are elsewhere
        (IMAGES, 1, 3, 5),
        (
            IMAGES,
            1,
            4,
            8,
        ),  # workers wait most of the time: the learner on half of the cores would be slower than without lag
        (IMAGES, 1, 8, 8),
        (IMAGES, 1, 20, 8),
    ],
)
def test_the_learner_takes_the_cores_that_workers_leave(
    monkeypatch: pytest.MonkeyPatch, policy: PolicySpec, max_lag: int, workers: int, count: int
) -> None:
    monkeypatch.setattr(torch_setup, "usable_cores", lambda: 8)
    assert threads(policy, max_lag, workers) == count


def test_a_run_keeps_the_number_of_threads_that_it_began_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever resumes or repeats it with its config.toml on a machine of another size gets the same bits."""
    settings: dict[str, Any] = {
        "rollout_steps": 8,
        "envs": 4,
        "eval_episodes": 1,
        "transport": "inproc",
        "net": (512, 512),
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
