"""The env copies that this process makes: which one it is making now, and the slots that they hold.

Rule: a copy holds its slot from before it is made until after it was closed, so no two live copies have the same one. If
its constructor raises, it may have started something: then the slot is free when the process and its children have ended.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

from protocol.envs.env_copy import EnvCopy, being_made
from protocol.errors import UsageError
from workers.slots import slots

_held: list[int] = []  # the slots of this process's open copies


class CopySlots:
    """The slots of copies that are closed together."""

    def __init__(self) -> None:
        self._slots: list[int] = []

    @contextmanager
    def making(self, copy: EnvCopy) -> Iterator[None]:
        """Within it, this copy is made, with a slot of its own."""
        slot = slots().take()
        self._slots.append(slot)
        _held.append(slot)
        token = being_made.set(replace(copy, slot=slot))
        try:
            yield
        except BaseException:
            self._slots.remove(slot)
            _held.remove(slot)
            raise
        finally:
            being_made.reset(token)

    def give_back(self) -> None:
        """The copies are closed."""
        for slot in [*self._slots]:
            self._give_back(slot)

    def _give_back(self, slot: int) -> None:
        self._slots.remove(slot)
        _held.remove(slot)
        slots().give_back(slot)


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
    if _held:
        raise UsageError(
            "env_copy: this thread is not making an env copy now; ask in the environment's constructor, and keep the answer"
        )
    return _of_process(os.getpid())


@cache
def _of_process(pid: int) -> EnvCopy:
    """The copy of a process that makes its environment itself; a fork has another one."""
    return EnvCopy(slot=slots().take())
