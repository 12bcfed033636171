"""A step without the ceremony has the bits of the optimizer's own, and leaves a state that the optimizer goes on from."""

from __future__ import annotations

import copy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from torch import Tensor
from torch.optim import SGD, Adam, AdamW, Optimizer, RMSprop

from millrace.learner.algorithms.kernels import optimizer_step
from millrace.learner.algorithms.kernels.optimizer_step import take_step

KINDS: dict[str, Callable[[list[Tensor]], Optimizer]] = {
    "adam": lambda flat: Adam(flat, lr=1e-2, eps=1e-5, fused=True),
    "amsgrad": lambda flat: Adam(flat, lr=1e-2, amsgrad=True, fused=True),
    "adamw": lambda flat: AdamW(flat, lr=1e-2, fused=True),
    "adamw amsgrad": lambda flat: AdamW(flat, lr=1e-2, amsgrad=True, fused=True),
    "rmsprop": lambda flat: RMSprop(flat, lr=1e-2, alpha=0.99, eps=1e-5),
    "any other": lambda flat: SGD(flat, lr=1e-2),
}


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_bits_are_the_optimizers(kind: str) -> None:
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(1001, generator=generator)
    flats = [start.clone() for _ in range(2)]
    optimizers = [KINDS[kind]([flat]) for flat in flats]
    for step in range(30):
        gradient = torch.randn(1001, generator=generator)
        for flat in flats:
            flat.grad = gradient.clone()
        for optimizer in optimizers:
            optimizer.param_groups[0]["lr"] = 1e-2 / (1 + step)
        optimizers[0].step()
        take_step(optimizers[1])
        assert torch.equal(*flats)
    ours, theirs = (optimizer.state_dict() for optimizer in reversed(optimizers))
    torch.testing.assert_close(ours["state"], theirs["state"], rtol=0, atol=0)
    assert not torch.equal(flats[0], start)
    resumed = KINDS[kind]([flats[1]])
    resumed.load_state_dict(copy.deepcopy(ours))
    optimizers[0].step()
    take_step(resumed)
    assert torch.equal(*flats)


class _TorchWith:
    """torch as the module under test sees it, with other private functions, or with none."""

    def __init__(self, private: Callable[..., None] | None) -> None:
        self._private = private

    def __getattr__(self, name: str) -> Any:
        return self._private if name in {"_fused_adam_", "_fused_adamw_"} else getattr(torch, name)


def _takes_other_arguments(*, parameters: list[Tensor]) -> None:
    raise AssertionError(parameters)


def _does_something_else(flats: list[Tensor], *_: object, **__: object) -> None:
    flats[0].zero_()


def _is_refused(*_: object, **__: object) -> None:
    raise RuntimeError("torch does not know these arguments")


@pytest.mark.parametrize("kind", ["adam", "amsgrad", "adamw", "adamw amsgrad"])
@pytest.mark.parametrize("private", [None, _takes_other_arguments, _does_something_else, _is_refused])
def test_without_torchs_private_functions_steps_are_the_optimizers_own(
    kind: str, private: Callable[..., None] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Torch itself still has them here, so the bits are the same; from the first step or after steps by the kernel."""
    generator = torch.Generator().manual_seed(0)
    start, gradients = torch.randn(1001, generator=generator), torch.randn(6, 1001, generator=generator)
    found = []
    for kernel_steps in (6, 3, 0):
        flat = start.clone()
        optimizer = KINDS[kind]([flat])
        own_step = Mock(wraps=optimizer.step)
        monkeypatch.setattr(optimizer, "step", own_step)
        for i, gradient in enumerate(gradients):
            flat.grad = gradient.clone()
            with pytest.MonkeyPatch.context() as patch:
                if i >= kernel_steps:
                    patch.setattr(optimizer_step, "torch", _TorchWith(private))
                take_step(optimizer)
        assert own_step.call_count == 6 - kernel_steps
        found.append((flat, optimizer.state_dict()["state"]))
    for flat, state in found[1:]:
        assert torch.equal(flat, found[0][0])
        torch.testing.assert_close(state, found[0][1], rtol=0, atol=0)


@pytest.mark.parametrize("kind", ["adam", "amsgrad", "adamw", "rmsprop"])
def test_moments_that_fade_are_zero_before_they_are_denormal_and_only_they(kind: str) -> None:
    flat = torch.zeros(100)
    optimizer = KINDS[kind]([flat])
    flat.grad = torch.full((100,), 1e-20)
    take_step(optimizer)
    flat.grad.zero_()
    for _ in range(1500):
        take_step(optimizer)
    smallest = torch.finfo(torch.float32).tiny
    for moment in optimizer.state[flat].values():
        assert not ((moment > 0) & (moment < smallest)).any()
    denormal = torch.tensor(smallest) / 2
    assert 0 < denormal * 1 < smallest  # to whatever runs in this thread afterwards


def test_runs_that_compile_nothing_do_not_import_the_compiler(tmp_path: Path) -> None:
    program = f"""
import sys, millrace
for algo, steps in (("ppo", 300), ("a2c", 300), ("dqn", 2000)):
    settings = {{"run_dir": {str(tmp_path)!r}, "transport": "inproc", "eval_episodes": 1}}
    run = millrace.train("CartPole-v1", algo=algo, steps=steps, **settings)
    assert run.summary.updates > 0
    assert "torch" in sys.modules
    assert "torch._dynamo" not in sys.modules, algo
"""
    root = Path(__file__).parents[4]
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=root, capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr
