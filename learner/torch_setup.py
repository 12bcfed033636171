"""Device and number of threads that PyTorch uses in the learner."""

from __future__ import annotations

import torch

from learner.algorithms.kernels.fused import can_fuse
from learner.config.config import Config
from protocol.cpu_cores import usable_cores
from protocol.errors import UsageError
from protocol.specs import PolicySpec


def torch_device(config: Config) -> str:
    """Device that the settings ask for: cpu or cuda. Raises `UsageError` if there is no such device."""
    if config.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("device cuda: PyTorch sees no GPU here; use --device cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if config.device == "auto" else config.device


def threads(config: Config, policy: PolicySpec, workers: int) -> int:
    """Number of threads. `workers` is the number of worker processes on this machine.

    A small MLP learns without autograd and gains nothing from a second thread. Other networks use the cores that no worker
    needs while the learner learns.
    """
    if config.torch_threads is not None:
        return config.torch_threads
    if can_fuse(policy):
        return 1
    return max(1, usable_cores() - (workers if config.max_lag else 0))
