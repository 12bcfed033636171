"""What a program has chosen for its own use of PyTorch changes nothing in a run and in a loaded policy, and is kept."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import pytest
import torch

import millrace
from millrace.learner.torch_setup import one_thread
from millrace.protocol.policy.own_encoder import describe_encoder
from millrace.protocol.specs import ActionSpec, Leaf

SMALL: dict[str, Any] = {
    "envs": 2, "lanes": 1, "rollout_steps": 16, "steps": 64, "workers": 1, "transport": "inproc", "net": (8,),
    "eval_episodes": 1, "torch_threads": 1, "preset": "none", "progress": False,
}  # fmt: skip


@contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def default_device(device: str) -> Iterator[None]:
    torch.set_default_device(device)
    try:
        yield
    finally:
        torch.set_default_device(None)


DEFAULTS: dict[str, Callable[[], AbstractContextManager[Any]]] = {
    "float64": lambda: default_dtype(torch.float64),
    "no gradients": lambda: torch.set_grad_enabled(False),
    "inference mode": lambda: torch.inference_mode(),
    "default device": lambda: default_device("meta"),
    "device": lambda: torch.device("meta"),
    "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
}


def chosen() -> tuple[object, ...]:
    modes = torch.is_grad_enabled(), torch.is_inference_mode_enabled(), torch.is_autocast_enabled("cpu")
    return (torch.get_default_dtype(), torch.get_default_device(), *modes)


def trained(folder: Path, env: str, **settings: Any) -> bytes:
    run = millrace.train(env, run_dir=str(folder), **{**SMALL, **settings})
    return (run.path / "policy.safetensors").read_bytes()


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The policies of runs in a program that has chosen nothing."""
    folder = tmp_path_factory.mktemp("plain")
    sac = trained(folder, "Pendulum-v1", algo="sac", learning_starts=16, batch_size=8)
    return {"ppo": trained(folder, "CartPole-v1"), "sac": sac}


@pytest.mark.parametrize("name", DEFAULTS)
def test_a_run_has_the_same_bits(name: str, tmp_path: Path, plain: dict[str, bytes]) -> None:
    with DEFAULTS[name]():
        before = chosen()
        found = trained(tmp_path, "CartPole-v1")
        sac = trained(tmp_path, "Pendulum-v1", algo="sac", learning_starts=16, batch_size=8)
        assert chosen() == before
    assert {"ppo": found, "sac": sac} == plain


@pytest.fixture(scope="module")
def camera(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose policy acts with torch."""
    folder = tmp_path_factory.mktemp("camera")
    return millrace.train("tests.support.envs.toy:Frames-v0", run_dir=str(folder), **{**SMALL, "steps": 32}).path


@pytest.mark.parametrize("name", DEFAULTS)
def test_a_loaded_policy_acts_the_same(name: str, camera: Path) -> None:
    env = gymnasium.make("tests.support.envs.toy:Frames-v0")
    seen, _ = env.reset(seed=1)
    env.close()
    expected = [millrace.load(camera, deterministic=False, seed=seed)(seen) for seed in range(5)]
    before_it = millrace.load(camera, deterministic=False, seed=0)
    with DEFAULTS[name]():
        before = chosen()
        assert before_it(seen) == expected[0]
        assert [millrace.load(camera, deterministic=False, seed=seed)(seen) for seed in range(5)] == expected
        assert chosen() == before


def linear(features: int, images: list[tuple[int, ...]]) -> torch.nn.Module:
    return torch.nn.Linear(features, 3)


def of_float16(features: int, images: list[tuple[int, ...]]) -> torch.nn.Module:
    return torch.nn.Linear(features, 3, dtype=torch.float16)


def test_an_encoder_of_the_default_dtype_is_one_of_float32() -> None:
    leaves, action = (Leaf("", "box", (4,), "float32"),), ActionSpec("discrete", (), "int64", sizes=(2,), start=(0,))
    with default_dtype(torch.float64):
        assert describe_encoder(f"{__name__}:linear", leaves, action).size == 3
        with pytest.raises(millrace.UserFacingError, match="expected float32 parameters, got another dtype in weight"):
            describe_encoder(f"{__name__}:of_float16", leaves, action)


def test_runs_that_end_in_another_order_leave_the_program_its_dtype() -> None:
    with default_dtype(torch.float64):
        first, second = one_thread(), one_thread()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert torch.get_default_dtype() == torch.float32
        second.__exit__(None, None, None)
        assert torch.get_default_dtype() == torch.float64
