"""The learner's interface to the worker processes that this program started."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class ProcessCallbacks:
    """The worker processes of this program; by default there are none."""

    ended: Callable[[], Iterable[tuple[str, str]]] = lambda: ()
    """names of the workers whose processes have ended since the last call, each with the reason; it may raise"""
    count: Callable[[], int] | None = None
    """how many processes step the environment; None: as many as there are members"""
    expected: int = 0
    """how many processes the user asked for; 0: any number"""
