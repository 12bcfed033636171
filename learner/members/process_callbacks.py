"""The learner's interface to the worker processes that this program started."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class ProcessCallbacks:
    """The worker processes of this program; by default there are none."""

    ended: Callable[[], Iterable[tuple[str, str]]] = lambda: ()
    """Returns (name, reason) of the workers whose processes have ended since the last call. It may raise."""
    count: Callable[[], int] | None = None
    """Returns the number of processes that step the environment. None: one per member."""
    expected: int = 0
    """Number of processes that the user asked for. 0: any number."""
