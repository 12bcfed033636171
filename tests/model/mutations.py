"""Mistakes that are made on purpose in the program, one at a time, to see whether the checker finds them.

Rule: a mutation replaces one piece of text, which stands exactly once in its file. `python -m tests.model.mutations NAME`
explores small runs of the program with this mistake, and exits with 1 if a rule is broken; with `--fuzz` it plays the random
cases of tests/learner/rollouts/test_conversation.py instead.

Not in the list: a Welcome to an earlier Hello that is accepted. It can harm only if the worker looks for its learner anew
while the learner keeps the session, and the new Hello is lost; for a connection keeps the order, so else the Hello ends that
session before anything of it arrives. With the repeated Welcome these are at least five faults.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import spec_from_loader
from pathlib import Path
from types import CodeType, ModuleType
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tests.model.conversation import Conversation

ROOT = Path(__file__).parent.parent.parent
COORDINATOR = "learner.rollouts.ticket_coordinator"
LANES = "learner.rollouts.lanes"
MEMBERSHIP = "learner.members.membership"
PLACEMENT = "learner.members.lane_placement"
SESSION = "workers.conversation.session"
HELD = "workers.conversation.held"


@dataclass(frozen=True)
class Mutation:
    """A mistake."""

    module: str
    right: str
    wrong: str


MUTATIONS = {
    "one update too far ahead": Mutation(COORDINATOR, "while room > 0:", "while room >= 0:"),
    "a stale rollout is used": Mutation(
        COORDINATOR, "if self.version - self._oldest_ready > self.max_lag:", "if self.version - self._oldest_ready > 9:"
    ),
    "the bound of staleness is off by one": Mutation(
        COORDINATOR,
        "stale = [arrived.rollout for arrived in self.ready if self.version - arrived.rollout.version > self.max_lag]",
        "stale = [arrived.rollout for arrived in self.ready if self.version - arrived.rollout.version >= self.max_lag]",
    ),
    "a rollout is taken twice": Mutation(
        COORDINATOR,
        "self.ready[: self.rollouts_per_update], self.ready[self.rollouts_per_update :]",
        "self.ready[: self.rollouts_per_update], self.ready[self.rollouts_per_update - 1 :]",
    ),
    "a late rollout is not counted": Mutation(
        COORDINATOR, "self.ledger.transitions_late += message.env_steps", "self.ledger.transitions_late += 0"
    ),
    "a repeated rollout is not counted": Mutation(
        COORDINATOR, "self.ledger.transitions_duplicate += rollout.env_steps", "self.ledger.transitions_duplicate += 0"
    ),
    "the arrival of a rollout is not recorded": Mutation(
        COORDINATOR,
        "        lane.arrived(rollout.sequence)\n        self._placement",
        "        self._placement",
    ),
    "a lost Collect is not sent again": Mutation(COORDINATOR, "out += self._collect(member, lost)", "pass"),
    "lost weights are not sent again": Mutation(
        COORDINATOR,
        "seen > member.sending_since:\n            member.sending = None",
        "seen > member.sending_since:\n            pass",
    ),
    "heartbeats are answered with the same number": Mutation(COORDINATOR, "member.replies += 1", "member.replies += 0"),
    "tickets of a lost worker are kept": Mutation(COORDINATOR, "for number in list(member.tickets):", "for number in ():"),
    "a lost ticket still counts as an advance": Mutation(COORDINATOR, "self._queue.set_back(lane)\n", "pass\n"),
    "a lane that was dealt a ticket does not count as started": Mutation(COORDINATOR, "lane.started = True", "pass"),
    "a checkpoint repeats an incarnation": Mutation(
        COORDINATOR, "lane.incarnation + lane.started for", "lane.incarnation + 0 for"
    ),
    "a ticket does not advance its lane": Mutation(COORDINATOR, "self._queue.advance(lane)", "pass"),
    "lanes are placed after tickets are dealt": Mutation(
        COORDINATOR, "out = self._placement.place(self.members.values())", "out: list[Outgoing] = []"
    ),
    "a repeated Welcome starts the session again": Mutation(
        SESSION, "self.state is State.READY and message.session == self.session", "False"
    ),
    "a worker that joins again repeats its Hello": Mutation(
        SESSION, "self._attempt += 1", "self._attempt = self.identity.process_nonce + 1"
    ),
    "finished work stays in progress": Mutation(SESSION, "current.in_progress = False", "pass"),
    "a worker takes work while it works": Mutation(SESSION, "self._current.in_progress = work is not None", "pass"),
    "replies to heartbeats are not counted": Mutation(SESSION, "current.replies = number", "pass"),
    "new weights are acknowledged again and again": Mutation(
        SESSION, "current.acknowledged_version = current.version\n", "pass\n"
    ),
    "a Collect confirms nothing": Mutation(
        SESSION,
        "current.rollouts.forget_received(received)\n                again",
        "again",
    ),
    "an asked-for rollout is not sent again": Mutation(
        SESSION, "return [Send(answer) for answer in again if answer is not None]", "return []"
    ),
    "a finished ticket is forgotten": Mutation(HELD, " or permit.ticket in lane.finished:", ":"),
    "a rollout that has not arrived is forgotten": Mutation(
        HELD, "rollout.sequence < of_lane.next_sequence or", "rollout.sequence <= of_lane.next_sequence or"
    ),
    "rollouts of a lane are not counted": Mutation(HELD, "self.sequence += kept", "pass"),
    "the lane of a lost worker is not placed anew": Mutation(PLACEMENT, "self._unplaced |= member.lanes", "pass"),
    "a silent worker is never removed": Mutation(MEMBERSHIP, "if now - member.alive_s > timeout_s]", "if False]"),
    "messages of an earlier session are accepted": Mutation(
        SESSION, 'getattr(message, "session", self.session) != self.session:', "False:"
    ),
    "heartbeats are due only with new weights": Mutation(
        SESSION, "if now < self.due_s and self._current.acknowledged_version", "if self._current.acknowledged_version"
    ),
    "heartbeats at half the rate needed": Mutation(
        SESSION,
        "self.due_s = now + self.run.heartbeat_s",
        "self.due_s = now + 2 * self.run.heartbeat_s",
    ),
    "a lost Release is never said again": Mutation(SESSION, "return current.release_unlisted(received)", "return []"),
    "a lane reopened on a new incarnation keeps the old lane's state": Mutation(
        HELD,
        "lane = self._lanes[number] = self._kind(incarnation)",
        "lane = self._lanes[number] = lane or self._kind(0)\n            lane.incarnation = incarnation",
    ),
    "a lane keeps its incarnation": Mutation(LANES, "self.incarnation += 1", "self.incarnation += 0"),
}


class Mutator(MetaPathFinder):
    """Imports one module with a mistake."""

    def __init__(self, mutation: Mutation) -> None:
        self._mutation = mutation

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name != self._mutation.module:
            return None
        found = PathFinder.find_spec(name, path, target)
        assert found is not None
        assert found.origin is not None
        return spec_from_loader(name, _MutatedLoader(name, found.origin, self._mutation))


class _MutatedLoader(SourceFileLoader):
    def __init__(self, name: str, path: str, mutation: Mutation) -> None:
        super().__init__(name, path)
        self._mutation = mutation

    def get_code(self, fullname: str) -> CodeType:
        text = Path(self.path).read_text()
        count = text.count(self._mutation.right)
        assert count == 1, f"{self.path}: expected this once, found it {count} times: {self._mutation.right}"
        return compile(text.replace(self._mutation.right, self._mutation.wrong), self.path, "exec")


def runs() -> list[Conversation]:
    """Small runs, the smallest first."""
    from tests.model.training import Training

    return [
        Training(workers=1, lanes=1, updates=2, faults=1),
        Training(workers=1, lanes=1, updates=1, faults=2, only=("drop up", "drop down")),
        Training(workers=2, lanes=1, updates=1, faults=1),
        Training(workers=1, lanes=2, updates=3, faults=1, max_lag=1, per_update=1),
        Training(workers=1, lanes=1, updates=2, faults=2),
        Training(workers=2, lanes=2, updates=2, faults=1, only=("drop down",)),
        Training(workers=2, lanes=2, updates=1, faults=1),
        Training(workers=2, lanes=1, updates=2, faults=2, max_lag=1, only=("repeat down", "freeze")),
        Training(workers=2, lanes=2, updates=2, faults=2, only=("drop down", "kill, reported")),
    ]


def _fuzz() -> str:
    """Play the random cases. Returns what is broken; empty: nothing was found."""
    from tests.learner.rollouts.test_conversation import BLOCKS, test_every_rule_holds_over_a_hostile_network

    for block in range(BLOCKS):
        try:
            test_every_rule_holds_over_a_hostile_network(block)
        except AssertionError as error:
            return str(error)
    return ""


def _explored(conversations: list[Conversation]) -> str:
    """Explore them. Returns what is broken; empty: nothing was found."""
    from tests.model.search import RuleBroken, explore

    for conversation in conversations:
        try:
            explore(conversation)
        except RuleBroken as broken:
            return f"{conversation}\n{broken}"
    return ""


def play(mutations: dict[str, Mutation], runs: Callable[[], list[Conversation]]) -> NoReturn:
    """The program with the mistake that the command line names. Nothing of `learner` or `workers` is imported before."""
    sys.meta_path.insert(0, Mutator(mutations[sys.argv[1]]))
    found = _fuzz() if "--fuzz" in sys.argv else _explored(runs())
    sys.stdout.write(found)
    sys.exit(1 if found else 0)


def find(name: str, module: str = "tests.model.mutations") -> str:
    """What the checker says of the program with a mistake of this module's list."""
    command = [sys.executable, "-m", module, name]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1200, check=False)
    assert result.returncode == 1, f"not found: {name}\n{result.stdout}{result.stderr}"
    assert "\nThen: " in result.stdout
    return result.stdout


def check_that_they_fit(mutations: dict[str, Mutation]) -> None:
    """The text that each of them replaces stands once in its file."""
    for name, mutation in mutations.items():
        text = (ROOT / (mutation.module.replace(".", "/") + ".py")).read_text()
        assert text.count(mutation.right) == 1, f"{name}: expected this once in {mutation.module}: {mutation.right}"


if __name__ == "__main__":
    play(MUTATIONS, runs)
