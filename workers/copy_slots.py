"""The env copies that this process makes: which one it is making now, and the slots that they hold.

Rule: a copy holds its slot from before it is made until after it was closed, so no two live copies have the same one. If
its constructor raises, it may have started something: then the slot is free when the process and its children have ended.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache
from typing import Any, TypeVar

from millrace.protocol.envs.which_copy import EnvCopy, being_made
from millrace.protocol.errors import UsageError
from millrace.workers.activity import CLOSING, activity
from millrace.workers.machine_slots import slots

_slots: dict[int, int] = {}  # of this process's copies that are being made or are open, by their id
Made = TypeVar("Made")


def make_copy(which: EnvCopy, make: Callable[[], Made]) -> Made:
    """What `make` returns: this copy, made with a slot of its own. `give_back` frees the slot when the copy was closed."""
    which = replace(which, slot=slots().take())
    _slots[id(which)] = which.slot
    token = being_made.set(which)
    try:
        made = make()
        _slots[id(made)] = _slots.pop(id(which))
        return made
    finally:
        being_made.reset(token)
        _slots.pop(id(which), None)  # if it could not be made, its slot stays taken


def give_back(copy: object) -> None:
    """Free the slot of a copy that was closed."""
    if (slot := _slots.pop(id(copy), None)) is not None:
        slots().give_back(slot)


def close_copy(copy: Any) -> None:
    """Close a copy; what it raises is ignored. Then its slot is free."""
    with suppress(BaseException), activity().during(CLOSING):
        copy.close()
    give_back(copy)


def env_copy() -> EnvCopy:
    """The copy that is being made now, for the constructor of an environment or a wrapper: ask there, and keep it.

    In a program that makes an environment itself, it is copy 0, with a slot that the process holds until it ends. Raises
    `UsageError` in a worker, and in a thread that the constructor starts, when this thread makes no copy.

    >>> import millrace
    >>> millrace.env_copy().number
    0
    """
    if (copy := being_made.get()) is not None:
        return copy
    if _slots:
        raise UsageError(
            "env_copy: this thread is not making an env copy now; ask in the environment's constructor, and keep the answer"
        )
    return _of_process(os.getpid())


@cache
def _of_process(pid: int) -> EnvCopy:
    """The copy of a process that makes its environment itself; a fork has another one."""
    return EnvCopy(slot=slots().take())
