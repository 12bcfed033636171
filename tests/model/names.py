"""Numbers that only identify something, and their renaming in states of the model.

Rule: the program compares tickets, sessions, incarnations and the like, or takes the next one. Their size means nothing. So
the model numbers them anew, in the same order, from 0: two states that differ in nothing else are one. `OLD` names are of
things that only a memory of the past lists; they go when nothing else names the same thing.
(After a learner restart the numbers of tickets and incarnations start again below old ones. Then renaming may change which
of the later numbers repeats an old one.)
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum
from typing import Any

from millrace.learner.members.describe_coordinator import FIRST_TICKET as DESCRIPTIONS
from millrace.learner.rollouts.evaluation_dealer import FIRST_TICKET as EVALUATIONS

BITS = 20
MASK = (1 << BITS) - 1

ATTEMPTS = 1 << 8  # so far apart are the nonces of the processes of a worker: none starts to join so often


class Kind(IntEnum):
    """What a name names. Kinds with a scope come after the kind of their scope."""

    WORKER = 1
    """number of a worker"""
    SESSION = 2
    TICKET = 3
    INCARNATION = 4
    """scope: the lane"""
    REPLIES = 5
    """number of heartbeat replies; 0 stays 0, because each session begins with it; scope: the session"""
    NONCE = 6
    """process of a worker, a multiple of `ATTEMPTS`; scope: the worker"""
    ATTEMPT = 7
    """counted from the nonce of the process, from which it keeps its distance; scope: the worker"""
    OLD_SESSION = 8
    OLD_TICKET = 9
    EVALUATION = 10
    """ticket of an evaluation, counted from the first one; keeps its value, which says what it is a ticket for"""
    DESCRIPTION = 11
    """ticket of a description, counted from the first one; keeps its value, too"""


SCOPED = {Kind.REPLIES: Kind.SESSION, Kind.ATTEMPT: Kind.WORKER, Kind.NONCE: Kind.WORKER}
OF_WORKER = {kind for kind, scope in SCOPED.items() if scope is Kind.WORKER}
FIRST_OF = {Kind.EVALUATION: EVALUATIONS, Kind.DESCRIPTION: DESCRIPTIONS}
"""The first ticket of a kind whose tickets do not begin with 0."""
OLD = {Kind.OLD_SESSION: Kind.SESSION, Kind.OLD_TICKET: Kind.TICKET}


class Name(int):
    """Kind, scope and value in one integer, so that names sort by kind and scope."""

    @property
    def kind(self) -> Kind:
        return Kind(self >> 2 * BITS)

    @property
    def scope(self) -> int:
        return self >> BITS & MASK

    @property
    def value(self) -> int:
        return FIRST_OF.get(self.kind, 0) + (self & MASK)

    def __repr__(self) -> str:
        scope = f"{self.scope}:" if self.kind in SCOPED or self.kind is Kind.INCARNATION else ""
        return f"{self.kind.name.lower()} {scope}{self & MASK}"


def name(kind: Kind, value: int, scope: int = 0) -> Name:
    assert 0 <= value <= MASK, f"{kind.name} {value}: too large for the model"
    return Name(kind << 2 * BITS | scope << BITS | value)


def names_in(content: Any, found: set[Name]) -> set[Name]:
    """All names in nested tuples. An attempt to join also names the process."""
    if isinstance(content, Name):
        found.add(content)
        if content.kind is Kind.ATTEMPT:
            found.add(name(Kind.NONCE, content.value - content.value % ATTEMPTS, content.scope))
    elif isinstance(content, tuple):
        for each in content:
            names_in(each, found)
    return found


def renamed(content: Any, new: dict[Name, Name | None]) -> Any:
    """Nested tuples under new names. An entry of a tuple whose new name is None is dropped."""
    if isinstance(content, Name):
        return new.get(content, content)
    if isinstance(content, tuple):
        return tuple(renamed(each, new) for each in content if not (isinstance(each, Name) and new.get(each, each) is None))
    return content


def renaming(names: Iterable[int], workers: dict[int, int]) -> dict[Name, Name | None]:
    """New names, in the same order, from 0, for those that change. `workers`: the new number of each worker."""
    new: dict[int, int] = {}
    changed: dict[Name, Name | None] = {}
    group, following = -1, 0
    for old in sorted(names):
        if old >> BITS != group:
            group = old >> BITS
            following = int(old >> 2 * BITS == Kind.REPLIES and old & MASK > 0)
            kind, scope = Kind(group >> BITS), group & MASK
            if kind in SCOPED:
                scope = workers[scope] if SCOPED[kind] is Kind.WORKER else new[SCOPED[kind] << 2 * BITS | scope] & MASK
            base = kind << 2 * BITS | scope << BITS
        if kind is Kind.WORKER:
            to = base | workers[old & MASK]
        elif kind in FIRST_OF:
            to = base | old & MASK
        elif kind is Kind.ATTEMPT:
            attempt = (old & MASK) % ATTEMPTS
            to = base | (new[old - attempt - (1 << 2 * BITS)] & MASK) + attempt
        elif kind in OLD:
            same = new.get(OLD[kind] << 2 * BITS | old & MASK)
            if same is None:
                changed[Name(old)] = None
                continue
            to = base | same & MASK
        else:
            to = base | following
            following += ATTEMPTS if kind is Kind.NONCE else 1
        new[old] = to
        if to != old:
            changed[Name(old)] = Name(to)
    return changed
