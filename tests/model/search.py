"""Breadth-first search over all states, and whether the run reaches its target from each of them.

Rule: of a state that was met only a hash and the state before it are kept. Liveness: from every state, once faults stop, a
fair run reaches the target, whoever's turn comes first; also if one worker is dead for ever, or one link is cut for ever.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from tests.model.conversation import Action, Content, Conversation
from tests.model.world import Seat, State, Violation, World

LONGEST = 400  # actions of a fair run to the target
Turn = Callable[[Iterator[Action]], Action]
Digests = tuple[int, tuple[tuple[Any, ...], ...], int]


class Broken(Exception):
    """A rule does not hold: the keys of the states on the way there, and what happened then."""

    def __init__(self, met: tuple[int, int], keys: list[int], why: str) -> None:
        """`met`: the share and number of a state that was met; `keys`: of the states of a fair run from there."""
        super().__init__(met, keys, why)
        self.met, self.keys, self.why = met, keys, why


class Batch(NamedTuple):
    """States for another share, with the parts that it may not have."""

    parts: list[Content]
    states: list[tuple[Digests, int]]
    """each with the number of the state before it"""


class Share:
    """One of several shares of all states. A state belongs to the share that its hash says."""

    def __init__(self, conversation: Conversation, number: int, shares: int, liveness: bool) -> None:
        self.world, self.conversation = World(conversation), conversation
        self.number, self.shares, self.liveness = number, shares, liveness
        self._met: set[int] = set()  # keys, also of states of other shares that were sent there
        self._keys, self._before = array("q"), array("q")  # of each state of this share; `before` = number * shares + share
        self._proven: set[int] = set()
        self._layer: list[State] = []
        self._first_of_layer = 0
        self._sent = [0] * shares  # number of parts that each share was sent
        start = self.world.canonical(self.world.start())
        if self._owner(key := self.world.key(start)) == number:
            self._add(start, key, -1)

    def counts(self) -> tuple[int, int, int]:
        """Number of states, of states in fair runs, and of parts."""
        return len(self._keys), len(self._proven), len(self.world.parts)

    def met(self, number: int) -> tuple[int, int, int]:
        """The key of a state of this share, and the share and number of the state before it; -1 for the first."""
        before = self._before[number]
        return (
            (self._keys[number], -1, -1) if before < 0 else (self._keys[number], before % self.shares, before // self.shares)
        )

    def take(self, batches: list[Batch]) -> int:
        """Take states from other shares. Returns the number of states of the next layer."""
        numbers = self.world.by_digest
        for parts, states in batches:
            for content in parts:
                self.world.part(content)
            for (learner, seats, faults), before in states:
                here = [
                    Seat(numbers[worker], *[tuple([numbers[each] for each in messages]) for messages in channels])
                    for worker, *channels in seats
                ]
                state = State(numbers[learner], tuple(here), faults)
                key = self.world.key(state)
                if key not in self._met:
                    self._add(state, key, before)
        return len(self._layer)

    def expand(self) -> list[Batch]:
        """Look at all states of this layer. Returns what belongs to each other share. Raises `Broken`."""
        world, met, shares = self.world, self._met, self.shares
        layer, self._layer = self._layer, []
        first, self._first_of_layer = self._first_of_layer, len(self._keys)
        others: list[list[tuple[Digests, int]]] = [[] for _ in range(shares)]
        for number, state in enumerate(layer, first):
            if self.liveness:
                self._prove(state, number)
            if world.reached(state):
                continue
            try:
                for _, after in world.successors(state):
                    key = world.key(after)
                    if key in met:
                        continue
                    if (owner := self._owner(key)) == self.number:
                        self._add(after, key, number * shares + self.number)
                    else:
                        met.add(key)
                        others[owner].append((world.digests(after), number * shares + self.number))
            except Violation as violation:
                raise Broken((self.number, number), [], violation.why) from violation
        return [self._batch(share, states) for share, states in enumerate(others)]

    def _owner(self, key: int) -> int:
        return (key >> 1) % self.shares

    def _add(self, state: State, key: int, before: int) -> None:
        self._met.add(key)
        self._keys.append(key)
        self._before.append(before)
        self._layer.append(state)

    def _batch(self, share: int, states: list[tuple[Digests, int]]) -> Batch:
        new = self.world.parts[self._sent[share] :] if share != self.number else []
        self._sent[share] = len(self.world.parts)
        return Batch([part.content for part in new], states)

    # ---------------------------------------------------------------- liveness

    def _prove(self, state: State, number: int) -> None:
        """The run reaches its target from here, without further faults, or with one that stays for ever."""
        world, state = self.world, state._replace(faults=0)
        self._run_fairly(state, number, _first)
        self._run_fairly(state, number, _last)
        if self.conversation.workers > 1:
            for worker in range(self.conversation.workers):
                for action, turn in ((("dead for ever", worker), _first), (("cut off for ever", worker), _last)):
                    self._run_fairly(world.canonical(world.after(state, action)), number, turn)

    def _run_fairly(self, here: State, number: int, turn: Turn) -> None:
        world, proven, passed = self.world, self._proven, dict[int, None]()
        while not world.reached(here):
            key = world.key(here)
            mark = key ^ (turn is _last)
            if mark in proven:
                break
            if mark in passed or len(passed) > LONGEST:
                raise Broken((self.number, number), [*passed, mark], "and so on: the run never reaches its target")
            passed[mark] = None
            try:
                here = world.canonical(world.after(here, turn(world.actions(here))))
            except Violation as violation:
                raise Broken((self.number, number), list(passed), violation.why) from violation
        proven.update(passed)


def _first(actions: Iterator[Action]) -> Action:
    return next(actions)


def _last(actions: Iterator[Action]) -> Action:
    """The last, but time passes only after everything else."""
    *others, last = actions
    return others[-1] if others and last == ("time",) else last
