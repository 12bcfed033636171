"""The env copies that this process makes: which one is being made now, and their slots.

Rule: a copy holds its slot from before it is made until after it was closed, so no two live copies have the same slot. If a
copy's constructor raises, it may already have started a process, so the slot becomes free only when this process and its
children have ended.

Rule: a copy that was only described is reused as the next copy that its thread makes, if the new copy would be the same.
Otherwise, the described copy is closed before the new one is made. A worker also closes it if the worker has made no copy in
the first `UNUSED_S` seconds of a run, because the run may not need this worker. Thus, no worker keeps an unneeded copy for
long.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, TypeVar

import gymnasium

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.which_copy import FIRST_COPY, EnvCopy, being_made, making
from millrace.protocol.errors import UsageError
from millrace.workers.activity import CLOSING, activity
from millrace.workers.machine_slots import slots

UNUSED_S = 60.0  # counted from the beginning of the run; long enough for other workers to join before the first order

_slots: dict[int, int] = {}  # slots of this process's open copies and the one being made, by id
Made = TypeVar("Made")
Dress = Callable[[Made, EnvCopy], Made]
"""Takes a copy and its identity, and returns the object to use in place of the copy. May raise."""


@dataclass(frozen=True)
class EnvMaker:
    """Makes copies of an environment. Equal makers make equal copies, unless the environment asks which copy it is."""

    env: EnvSpec
    render_mode: str | None = None

    def __call__(self) -> gymnasium.Env[Any, Any]:
        """Make one copy. Raises `UsageError` if it can't be made."""
        return self.env.make(self.render_mode)


@dataclass(frozen=True)
class DescribedCopy:
    """A copy that was described, but not reset or stepped."""

    copy: gymnasium.Env[Any, Any]
    maker: EnvMaker
    asked: bool
    """Whether the environment asked which copy it is, and was told that it is the first."""

    def is_as_new(self, which: EnvCopy, make: Callable[[], Any]) -> bool:
        """Whether calling `make` for the copy `which` would give an equal copy."""
        return make == self.maker and (which == FIRST_COPY or not self.asked)


class _OfThread(threading.local):
    described: DescribedCopy | None = None  # the copy that this thread has described, if it is still unused


_of_thread = _OfThread()


def make_to_describe(make: EnvMaker) -> DescribedCopy:
    """Make a copy to be described. Then call `keep_described`, or `close_copy` if it cannot be described."""
    close_described()
    copy, asked = _made(FIRST_COPY, make)
    return DescribedCopy(copy, make, asked)


def keep_described(described: DescribedCopy) -> None:
    """Keep this copy for the next `make_copy` of this thread, or until `close_described`."""
    _of_thread.described = described


def close_described() -> None:
    """Close the copy that this thread has described, unless it was used."""
    described = _of_thread.described
    _of_thread.described = None
    if described is not None:
        close_copy(described.copy)


def as_made(copy: Made, which: EnvCopy) -> Made:
    """The copy itself: a `Dress` that changes nothing."""
    return copy


def make_copy(which: EnvCopy, make: Callable[[], Made], dress: Dress[Made] = as_made) -> Made:
    """Make a copy with a slot of its own: call `make`, or reuse the described copy, and apply `dress` to it.

    If `dress` raises, the copy is closed. After you have closed the copy, `give_back` frees its slot.
    """
    described = _of_thread.described
    if described is not None and described.is_as_new(which, make):
        _of_thread.described = None
        made: Any = described.copy
    else:
        close_described()
        made, _ = _made(which, make)
    try:
        dressed = dress(made, which)
    except BaseException:
        close_copy(made)
        raise
    _slots[id(dressed)] = _slots.pop(id(made))
    return dressed


def _made(which: EnvCopy, make: Callable[[], Made]) -> tuple[Made, bool]:
    """Call `make` with a slot taken for it. Returns the copy, and whether its environment asked which copy it is."""
    slot = slots().take()
    with making(replace(which, slot=slot)) as under_way:
        _slots[id(under_way)] = slot
        try:
            made = make()
            _slots[id(made)] = _slots.pop(id(under_way))
            return made, under_way.asked
        finally:
            _slots.pop(id(under_way), None)  # if `make` has raised, the slot stays taken


def give_back(copy: object) -> None:
    """Free the slot of a copy that was closed. Does nothing if the copy has no slot."""
    if (slot := _slots.pop(id(copy), None)) is not None:
        slots().give_back(slot)


def close_copy(copy: Any) -> None:
    """Close a copy, ignoring exceptions, and free its slot."""
    with suppress(BaseException), activity().during(CLOSING):
        copy.close()
    give_back(copy)


def env_copy() -> EnvCopy:
    """The env copy that is being made now. Call this in the constructor of an environment or a wrapper, and keep the result.

    In a program that makes an environment itself, the environment is copy 0, with a slot that the process holds until it
    ends. In a worker, raises `UsageError` if the calling thread isn't making a copy, for example because the constructor
    started it.

    >>> import millrace
    >>> millrace.env_copy().number
    0
    """
    if (copy := being_made()) is not None:
        return copy
    if _slots:
        raise UsageError(
            "env_copy: this thread is not making an env copy now; ask in the environment's constructor, and keep the answer"
        )
    return _of_process(os.getpid())


@cache
def _of_process(pid: int) -> EnvCopy:
    """The `EnvCopy` for a process that makes its environment itself. A fork of the process has another slot."""
    return EnvCopy(slot=slots().take())
