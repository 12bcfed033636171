"""Explores all states of a model, in several processes, and tells as sentences how a rule was broken.

Rule: layer after layer, each process looks at its share of the states and sends on those that belong to another share.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from tests.model.conversation import Action, Conversation
from tests.model.search import Broken, Share
from tests.model.world import State, Violation, World


class RuleBroken(AssertionError):
    """A rule of safety or liveness does not hold. The text tells what happened."""


@dataclass(frozen=True)
class Report:
    """What was explored."""

    conversation: Conversation
    states: int
    depth: int
    """number of actions to the farthest state"""
    complete: bool
    in_fair_runs: int
    """states in fair runs to the target, by which liveness was proven"""
    parts: int
    seconds: float

    def __str__(self) -> str:
        extent = "complete" if self.complete else "not complete"
        states = f"{self.states:,} states to depth {self.depth}, {extent}; {self.in_fair_runs:,} in fair runs"
        return f"{self.conversation}: {states}; {self.parts:,} parts; {self.seconds:.1f} s"


def explore(
    conversation: Conversation, *, liveness: bool = True, processes: int = 1, most_states: float = float("inf")
) -> Report:
    """Explore all states, or layer after layer until there are `most_states`. Raises `RuleBroken`."""
    began_s, depth, size = time.monotonic(), 0, 1
    with ExitStack() as stack:
        shares = [stack.enter_context(_share(conversation, number, processes, liveness)) for number in range(processes)]
        try:
            while size and sum(counts[0] for counts in _all(shares, "counts")) < most_states:
                batches = _all(shares, "expand")
                size = sum(_all(shares, "take", [[each[number] for each in batches] for number in range(processes)]))
                depth += bool(size)
        except Broken as broken:
            raise RuleBroken("\n".join(_story(conversation, shares, broken))) from None
        states, in_fair_runs, parts = (sum(column) for column in zip(*_all(shares, "counts"), strict=True))
    return Report(conversation, states, depth, not size, in_fair_runs, parts, time.monotonic() - began_s)


# -------------------------------------------------------------------- processes


class _Here:
    """A share in this process, with the interface of a connection to it."""

    def __init__(self, share: Share) -> None:
        self._share, self._answer = share, None

    def send(self, call: tuple[Any, ...]) -> None:
        self._answer = getattr(self._share, call[0])(*call[1:])

    def recv(self) -> Any:
        return self._answer


@contextmanager
def _share(conversation: Conversation, number: int, processes: int, liveness: bool) -> Iterator[Any]:
    if processes == 1:
        yield _Here(Share(conversation, number, processes, liveness))
        return
    here, there = multiprocessing.Pipe()
    context = multiprocessing.get_context("fork")
    process = context.Process(target=_serve, args=(there, conversation, number, processes, liveness), daemon=True)
    process.start()
    there.close()
    try:
        yield here
    finally:
        here.close()
        process.terminate()
        process.join()


def _serve(link: Connection, conversation: Conversation, number: int, processes: int, liveness: bool) -> None:
    share = Share(conversation, number, processes, liveness)
    while True:
        call = link.recv()
        try:
            link.send(getattr(share, call[0])(*call[1:]))
        except Broken as broken:
            link.send(broken)


def _all(shares: list[Any], method: str, arguments: list[Any] | None = None) -> list[Any]:
    for number, share in enumerate(shares):
        share.send((method,) if arguments is None else (method, arguments[number]))
    answers = [share.recv() for share in shares]
    for answer in answers:
        if isinstance(answer, Broken):
            raise answer
    return answers


# -------------------------------------------------------------------- telling what happened


def _story(conversation: Conversation, shares: list[Any], broken: Broken) -> Iterator[str]:
    """Sentences that tell how this state was reached, what happened then, and how it ended."""
    keys: list[int] = []
    share, number = broken.met
    while share >= 0:
        shares[share].send(("met", number))
        key, share, number = shares[share].recv()
        keys.insert(0, key)
    world = World(conversation)
    state = world.start()
    for key in keys[1:]:
        sentence, state = _step(world, state, key)
        yield sentence
    if broken.keys:
        yield "From here on nothing goes wrong any more, or one thing for ever:"
        state = state._replace(faults=0)
    for key in broken.keys:
        if world.key(world.canonical(state)) not in (key, key ^ 1):
            sentence, state = _step(world, state, key)
            yield sentence
    for action in _every_action(world, state):
        try:
            world.after(state, action)
        except Violation:
            yield _sentence(world, state, action)
            break
    yield f"Then: {broken.why}"


def _every_action(world: World, state: State) -> list[Action]:
    stays = [(what, n) for what in ("dead for ever", "cut off for ever") for n in range(len(state.seats))]
    return [*world.actions(state), *world.faults(state), *stays]


def _step(world: World, state: State, key: int) -> tuple[str, State]:
    """The action that leads to the state of this key, as a sentence, and the state, under the names of this one."""
    for action in _every_action(world, state):
        for cost in (0, 1):
            try:
                after = world.after(state, action, cost)
            except Violation:
                continue
            if world.key(world.canonical(after)) in (key, key ^ 1):
                return _sentence(world, state, action), after
    raise AssertionError("no action leads to the next state")


def _sentence(world: World, state: State, action: Action) -> str:
    def message(channel: str) -> str:
        kind, *fields = world.parts[getattr(state.seats[action[1]], channel)[0]].content
        return f"{kind}{tuple(fields)}"

    match action:
        case "up" | "drop up" | "repeat up" as what, worker:
            fate = {"up": "arrives", "drop up": "is lost", "repeat up": "arrives, and will arrive again"}[what]
            return f"{message('up')} of worker {worker} {fate}."
        case "down" | "drop down" | "repeat down" as what, worker:
            fate = {"down": "arrives", "drop down": "is lost", "repeat down": "arrives, and will arrive again"}[what]
            return f"{message('down')} to worker {worker} {fate}."
        case "late up" | "late down" as what, worker, part:
            kind, *fields = world.parts[part].content
            return f"{kind}{tuple(fields)} {'of' if what == 'late up' else 'to'} worker {worker} arrives again."
        case "start", worker:
            return f"A process of worker {worker} starts."
        case "finish", worker:
            return f"Worker {worker} has collected what it was collecting."
        case "freeze" | "thaw" as what, worker:
            return f"Worker {worker} {'freezes' if what == 'freeze' else 'goes on'}."
        case "kill", worker:
            return f"Worker {worker} is killed."
        case "kill, reported", worker:
            return f"Worker {worker} is killed, and the learner is told."
        case "revoke", worker:
            return f"The key of worker {worker} is revoked."
        case "told", worker:
            return f"Worker {worker} hears from the endpoint that its key is revoked."
        case "restart", version:
            return f"The learner restarts from its checkpoint of version {version}."
        case ("publish",):
            return "The learner publishes new weights."
        case ("time",):
            return "Time passes: one tick."
        case ("delay",):
            return "Time passes, one tick, while something is under way."
        case what, worker:
            return f"Worker {worker} is {what}."
    raise AssertionError(action)
