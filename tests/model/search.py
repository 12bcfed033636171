"""Breadth-first search over all states, and whether the run reaches its target from each of them.

Rule of safety: no state is broken. Rule of liveness: from every state in which nothing goes wrong any more, or one worker
or its link is gone for ever, two runs reach the target: in one the first thing that can happen always happens next, in the
other the last thing. So both fair and unfair orders of turns reach it, and the target can be reached from everywhere.
"""

from __future__ import annotations

import resource
import time
from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tests.model.conversation import Conversation
from tests.model.story import sentences
from tests.model.world import Action, Move, State, World

TARGET = -1  # in place of the number of a state in which the run has reached its target
UNKNOWN = -2  # in place of the number of a state that nothing follows


class RuleBroken(AssertionError):
    """A rule of safety or liveness does not hold. The text tells what happened."""


@dataclass(frozen=True)
class Report:
    """What was explored."""

    conversation: Conversation
    states: int
    """without those in which the run has reached its target"""
    depth: int
    """number of actions to the farthest state"""
    complete: bool
    parts: int
    seconds: float
    """of processor time"""
    memory_mb: int
    """most memory of this process so far"""

    def __str__(self) -> str:
        extent = f"{self.states:,} states, {'all' if self.complete else 'not all'}, to depth {self.depth}"
        return (
            f"{self.conversation}: {extent}; {self.parts:,} parts; {self.seconds:.0f} s of one core; {self.memory_mb:,} MB"
        )


def explore(conversation: Conversation, *, reduced: bool = True, most_states: float = float("inf")) -> Report:
    """Explore all states, or stop when there are `most_states`. Raises `RuleBroken`."""
    return Search(World(conversation, reduced=reduced)).run(most_states)


class Search:
    """One search."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.states: list[State] = []
        self._numbers: dict[State, int] = {}
        self._before = array("i")  # for each state the number of the one from which it was found
        self._first, self._last = array("i"), array("i")  # the number of the one that is next in the two runs

    def run(self, most_states: float = float("inf")) -> Report:
        world, began_s = self.world, time.process_time()
        try:
            self._add(world.start(), -1)
        except AssertionError as error:
            raise RuleBroken(f"\nThen: {error}, at the start") from error
        depth, end_of_layer = 0, 1
        for number, state in enumerate(self.states):
            if number == end_of_layer:
                if number >= most_states:
                    break
                depth, end_of_layer = depth + 1, len(self.states)
            self._expand(number, state)
        complete = len(self._first) == len(self.states)
        for following in (self._first, self._last):
            self._check_liveness(following)
        seconds, memory_mb = time.process_time() - began_s, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        return Report(world.conversation, len(self.states), depth, complete, len(world.parts), seconds, memory_mb)

    def _expand(self, number: int, state: State) -> None:
        world = self.world
        moves = world.moves(state)
        after = [self._found(number, move) for move in moves]
        for move in (*world.faults(state), *world.ends_of_faults(state)):
            self._found(number, move)
        if state[-1] > 0:
            after = []  # something can still go wrong
        elif moves[-1][0].what == "time" and len(moves) > 1:
            after = [after[0], after[-2]]  # time passes only after everything else
        self._first.append(after[0] if after else UNKNOWN)
        self._last.append(after[-1] if after else UNKNOWN)
        if state[-1] == world.conversation.faults or (world.conversation.few_losses and state[-1] >= 0):
            for action, later in moves:
                if world.gave_up(state, later):
                    raise self._broken(
                        number, "a worker was given up, or gave up, although at most two messages were lost", action
                    )

    def _found(self, before: int, move: Move) -> int:
        """The number of the state after this move."""
        world = self.world
        if world.reached(move[1]):
            return TARGET
        state = world.canonical(move[1])
        number = self._numbers.get(state)
        if number is None:
            number = self._add(state, before)
            if why := world.why_broken(state):
                raise self._broken(number, why)
        return number

    def _add(self, state: State, before: int) -> int:
        number = self._numbers[state] = len(self.states)
        self.states.append(state)
        self._before.append(before)
        return number

    def _check_liveness(self, following: array[int]) -> None:
        """Every state leads to the target, if the next state is always the one that is given here.

        Nothing else shows that rule WORKER_TIMEOUT is broken.
        """
        end = len(self.states)
        jump = np.full(end + 1, end, dtype=np.int32)
        jump[: len(following)] = following
        jump[jump < 0] = end
        for _ in range(end.bit_length()):
            jump = jump[jump]
        stuck = np.flatnonzero(jump != end)
        if stuck.size:
            number = int(stuck[0])
            onwards = [number]
            while (number := following[number]) not in onwards:
                onwards.append(number)
            raise self._broken(onwards[0], "and so on: the run never reaches its target", onwards=[*onwards[1:], number])

    def _broken(self, number: int, why: str, action: Action | None = None, onwards: Sequence[int] = ()) -> RuleBroken:
        path = [number]
        while (before := self._before[path[0]]) >= 0:
            path.insert(0, before)
        told = sentences(self.world, [self.states[each] for each in (*path, *onwards)], action)
        return RuleBroken("\n".join([*told, f"Then: {why}"]))
