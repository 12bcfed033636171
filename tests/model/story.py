"""Tells as sentences what happened on the way to a state. Rule: the workers keep their numbers throughout the story."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tests.model.world import Action, State, World

SENTENCES = {
    "up": "{message} of worker {number} arrives.",
    "drop up": "{message} of worker {number} is lost.",
    "repeat up": "{message} of worker {number} arrives, and will arrive again.",
    "late up": "{message} of worker {number} arrives again.",
    "down": "{message} to worker {number} arrives.",
    "drop down": "{message} to worker {number} is lost.",
    "repeat down": "{message} to worker {number} arrives, and will arrive again.",
    "late down": "{message} to worker {number} arrives again.",
    "start": "A process of worker {number} starts.",
    "finish": "Worker {number} has collected what it was collecting.",
    "freeze": "Worker {number} freezes.",
    "thaw": "Worker {number} goes on.",
    "kill": "Worker {number} is killed.",
    "kill, reported": "Worker {number} is killed, and the learner is told.",
    "revoke": "The key of worker {number} is revoked.",
    "told": "Worker {number} hears from the endpoint that its key is revoked.",
    "restart": "The learner restarts from its checkpoint of version {number}.",
    "publish": "The learner publishes new weights.",
    "time": "Time passes: one tick.",
    "delay": "Time passes, one tick, while something is under way.",
    "calm": "From here on nothing goes wrong any more.",
    "gone for ever": "Worker {number}, or its link, is gone for ever, with all that it has said.",
}


def sentences(world: World, states: Sequence[State], action: Action | None = None) -> Iterator[str]:
    """A sentence for each step from one of these canonical states to the next, and for this action after them."""
    here = states[0]
    for following in states[1:]:
        moves = [*world.all_moves(here), *world.faults(here), *world.ends_of_faults(here)]
        step, after = next(move for move in moves if world.canonical(move[1]) == following)
        yield _sentence(world, step)
        here = after
    if action is not None:
        yield _sentence(world, action)


def _sentence(world: World, action: Action) -> str:
    message = ""
    if action.message is not None:
        kind, *fields = world.parts[action.message]
        message = f"{kind}{tuple(fields)}"
    return SENTENCES[action.what].format(number=action.number, message=message)
