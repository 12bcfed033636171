"""PyTorch's original defaults, which a program, or an environment, may have changed for its own purposes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch


@contextmanager
def defaults_of_thread() -> Iterator[None]:
    """A context with PyTorch's original thread-local defaults: gradients are on, autocast is off, tensors are on the CPU."""
    with ExitStack() as stack:
        stack.enter_context(torch.inference_mode(False))
        stack.enter_context(torch.enable_grad())
        if torch.get_default_device().type != "cpu":
            stack.enter_context(torch.device("cpu"))  # entered only if needed, because it slows every call to torch
        for device in ("cpu", "cuda"):
            if torch.is_autocast_enabled(device):
                stack.enter_context(torch.autocast(device, enabled=False))
        yield
