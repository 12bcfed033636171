"""The device of PyTorch, its defaults, and how many threads PyTorch and numpy have while this process learns or acts.

Rules: a run has PyTorch's initial defaults: float32, the CPU, gradients. The calling program's own choices don't change its
bits. The numbers of threads do not depend on who imported the two first: a script, a notebook or the command line. numpy's
matrices are so small that more threads of its BLAS gain nothing, and beside other busy processes they wait for one another:
an update takes up to thirty times as long. Afterwards the calling program has its threads and defaults back.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from threading import Lock
from typing import NamedTuple

from threadpoolctl import threadpool_limits

from millrace.learner.config.config import Config
from millrace.protocol.errors import UsageError
from millrace.protocol.machine.cpu_cores import usable_cores
from millrace.protocol.policy.arithmetic import multiply_adds
from millrace.protocol.policy.layout import parameter_layout
from millrace.protocol.specs import PolicySpec

MANY_WEIGHTS = 1 << 18  # 512 x 512
WORTH_A_THREAD = 1 << 25
"""Multiply-adds of a forward pass that make a thread worthwhile. With the backward pass, a core takes 2 to 5 ms for them."""


_lock = Lock()
_inside: list[list[ExitStack]] = []
"""For each `one_thread` that was entered and not left, in this order: what restores the numbers of threads before it."""


@contextmanager
def one_thread(*, uses_torch: bool = True) -> Iterator[None]:
    """One thread for numpy's BLAS, and for PyTorch until `torch.set_num_threads` is called; later as many as before.

    PyTorch has its own defaults meanwhile; it is imported only if it `uses_torch`. Threads of the program may leave in
    another order than they entered.
    """
    own = [ExitStack()]
    with _lock:
        own[0].enter_context(threadpool_limits(1, "blas"))
        if uses_torch:
            import torch

            own[0].callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(1)
            own[0].callback(torch.set_default_dtype, torch.get_default_dtype())
            torch.set_default_dtype(torch.float32)
        _inside.append(own)
    try:
        with ExitStack() as of_this_thread:
            if uses_torch:
                from millrace.protocol.policy.networks import defaults_of_thread

                of_this_thread.enter_context(defaults_of_thread())
            yield
    finally:
        with _lock:
            later = _inside[_inside.index(own) + 1 :]
            _inside.remove(own)
            if later:  # the next to leave restores what was before this one, too
                own[0].callback(later[0][0].close)
                later[0][0] = own[0]
            else:
                own[0].close()


def torch_device(config: Config) -> str:
    """The device in the settings: cpu or cuda. Raises `UsageError` if there is no such device."""
    import torch

    if config.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("device cuda: PyTorch sees no GPU here; use --device cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if config.device == "auto" else config.device


class ThreadChoice(NamedTuple):
    """How many threads PyTorch gets, where the settings name no number."""

    number: int
    line: str
    """What was chosen and why, for the user; empty if nobody would expect another number"""


def threads(policy: PolicySpec, rows: int, max_lag: int, workers: int) -> ThreadChoice:
    """The number of threads, by the work of a pass of a minibatch of `rows`. `workers`: worker processes on this machine.

    The threads wait for one another at the end of each operation. So a thread that has little to do gains nothing, and
    loses much while another process keeps its core busy: each gets at least `WORTH_A_THREAD`. Networks of small layers have
    one, because numpy computes most of their passes.

    If workers collect meanwhile, they use the cores that are left, but only if those are more than half: where updates take
    longer than collecting, workers wait for most of the time, and their cores with them.
    """
    largest = max(math.prod(field.shape) for fields in parameter_layout(policy) for field in fields)
    if not policy.needs_torch and largest < MANY_WEIGHTS:
        return ThreadChoice(1, "")
    cores = usable_cores()
    left = cores - workers if max_lag else cores
    work = rows * multiply_adds(policy)
    count = max(1, min(left if 2 * left > cores else cores, work // WORTH_A_THREAD))
    line = (
        f"PyTorch uses {count} of {cores} cores: a pass of {rows:,} rows has {work / 1e6:,.1f} million multiply-adds, and a "
        f"thread is worthwhile for {WORTH_A_THREAD / 1e6:.0f} million; --torch-threads sets another number"
    )
    return ThreadChoice(count, line)


def updates_use_all_cores(config: Config) -> bool:
    """Whether updates use all cores while workers collect; then the workers of this machine should have a lower priority.

    Each operation of an update ends when its slowest thread has ended. If a worker holds the core of one, all wait. Updates
    with one thread leave the workers a core, and there workers decide the speed: a lower priority would cost it. Updates on
    a GPU leave them all cores.
    """
    return config.max_lag > 0 and 1 < usable_cores() <= (config.torch_threads or 1) and torch_device(config) == "cpu"
