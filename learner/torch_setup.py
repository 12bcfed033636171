"""PyTorch's device and defaults, and the number of threads that PyTorch and numpy use while this process learns or acts.

Rules: a run has PyTorch's initial defaults (float32, the CPU, gradients on), so the calling program's own choices don't
change the run's results. Nor do the numbers of threads depend on what imported PyTorch and numpy first: a script, a notebook
or the command line. numpy gets one BLAS thread, because its matrices are so small that more threads gain nothing. If other
processes were busy, several threads would wait for one another, and an update could take thirty times as long. After the
run, the calling program gets its threads and defaults back.
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
"""How many multiply-adds in a forward pass make a thread worthwhile. A core takes 2 to 5 ms for both passes."""


_lock = Lock()
_inside: list[list[ExitStack]] = []
"""Each open `one_thread` context, in order of entry, as a stack that restores the previous numbers of threads."""


@contextmanager
def one_thread(*, uses_torch: bool = True) -> Iterator[None]:
    """Inside this context, numpy's BLAS has one thread, and so has PyTorch until you call `torch.set_num_threads`.

    PyTorch also has its initial defaults; it is imported only if `uses_torch`. On exit, the numbers of threads and the
    defaults are restored. Several threads of the program may enter this context, and leave it in any order.
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
                from millrace.protocol.policy.torch_defaults import defaults_of_thread

                of_this_thread.enter_context(defaults_of_thread())
            yield
    finally:
        with _lock:
            later = _inside[_inside.index(own) + 1 :]
            _inside.remove(own)
            if later:  # the next context to be entered restores the numbers from before this one
                own[0].callback(later[0][0].close)
                later[0][0] = own[0]
            else:
                own[0].close()


def torch_device(config: Config) -> str:
    """The device that the settings name or imply: cpu or cuda. Raises `UsageError` if this device doesn't exist."""
    import torch

    if config.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("device cuda: PyTorch sees no GPU here; use --device cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if config.device == "auto" else config.device


class ThreadChoice(NamedTuple):
    """The number of PyTorch's threads, chosen because the settings give none."""

    number: int
    line: str
    """a line that tells the user what was chosen and why; empty if nobody would expect another number"""


def threads(policy: PolicySpec, rows: int, max_lag: int, workers: int) -> ThreadChoice:
    """The number of threads for minibatches with `rows` rows. `workers` is the number of local worker processes.

    Threads wait for one another at the end of each operation. A thread that has little to do therefore gains nothing, and
    costs much time if another process keeps its core busy, so each thread gets at least `WORTH_A_THREAD` multiply-adds.
    Networks with only small layers get one thread, because numpy computes most of their passes.

    If workers collect during updates, one core is left free for each of them, but only if the threads still get more than
    half of the cores. Otherwise, updates would take longer than collecting, and the workers and their cores would mostly sit
    idle.
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
    """Whether updates use all cores while workers collect, so local workers should have a lower priority.

    Each operation of an update ends when its slowest thread has finished, so if a worker occupies one thread's core, all
    threads wait. Updates with one thread leave the other cores to the workers. The workers then limit the speed of the run,
    so a lower priority would slow the run down. Updates on a GPU leave all cores to the workers.
    """
    return config.max_lag > 0 and 1 < usable_cores() <= (config.torch_threads or 1) and torch_device(config) == "cpu"
