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

from millrace.protocol.rules import Rule

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tests.model.conversation import Conversation

ROOT = Path(__file__).parent.parent.parent
COORDINATOR = "millrace.learner.rollouts.ticket_coordinator"
ROLLOUTS = "millrace.learner.rollouts.rollout_dealer"
WEIGHTS = "millrace.learner.rollouts.sent_weights"
MEMBERS = "millrace.learner.members.coordinator"
LANES = "millrace.learner.rollouts.lanes"
POOL = "millrace.learner.rollouts.opponent_pool"
ROUNDS = "millrace.learner.rollouts.lag_rule"
MEMBERSHIP = "millrace.learner.members.membership"
PLACEMENT = "millrace.learner.members.lane_placement"
SESSION = "millrace.workers.conversation.session"
HELD = "millrace.workers.conversation.held"


@dataclass(frozen=True)
class Mutation:
    """A mistake."""

    breaks: Rule | None
    """the rule of the wire document; None: a law of the learner alone, which its module's first lines say"""
    module: str
    right: str
    wrong: str


MUTATIONS = {
    "one round too far ahead": Mutation(
        Rule.OPEN_ROUNDS, ROUNDS, "self.next + 1 + self.max_lag)", "self.next + 2 + self.max_lag)"
    ),
    "rounds are opened twice": Mutation(
        Rule.OPEN_ROUNDS, ROUNDS, "range(self.next + len(self._versions), ", "range(self.next, "
    ),
    "a round that was taken stays open": Mutation(Rule.OPEN_ROUNDS, ROUNDS, "del self._versions[self.next]\n", "pass\n"),
    "the newest weights act in every open round": Mutation(
        Rule.ROUND_VERSION,
        ROUNDS,
        "self._versions |= {number: self._saved.pop(number, newest) for number in opened}",
        "self._versions = dict.fromkeys([*self._versions, *opened], newest)",
    ),
    "a round is dealt under the newest weights": Mutation(
        Rule.ROUND_VERSION,
        ROLLOUTS,
        "version = self.rounds.version(round_number)",
        "version = max(self.rounds._versions.values())",
    ),
    "an update counts rollouts of later rounds": Mutation(
        Rule.ROUND,
        ROLLOUTS,
        "if len(self.ready.get(self.rounds.next, ())) < len(self.lanes):",
        "if self.waiting() < len(self.lanes):",
    ),
    "an update takes the newest round": Mutation(
        Rule.ROUND,
        ROLLOUTS,
        "in sorted(self.ready.pop(self.rounds.next).items())]",
        "in sorted(self.ready.pop(max(self.ready)).items())]",
    ),
    "a rollout is taken twice": Mutation(
        Rule.ROUND, ROLLOUTS, "self.ready.pop(self.rounds.next).items()", "self.ready[self.rounds.next].items()"
    ),
    "a rollout waits for the wrong round": Mutation(
        Rule.ROUND, ROLLOUTS, "self.ready.setdefault(permit.round, {})", "self.ready.setdefault(self.rounds.next, {})"
    ),
    "a round is dealt again and again": Mutation(
        Rule.OPEN_ROUNDS, ROLLOUTS, "            lane.due.clear()\n", "            pass\n"
    ),
    "the round of a lost ticket is not dealt again": Mutation(
        Rule.LOST_TICKETS, ROLLOUTS, "insort(self._end(member, permit).due, permit.round)", "self._end(member, permit)"
    ),
    "a lane whose ticket was lost is overlooked": Mutation(
        Rule.LOST_TICKETS, ROLLOUTS, "self._to_deal.add(permit.lane)", "pass"
    ),
    "a late rollout is not counted": Mutation(
        None, ROLLOUTS, "self.ledger.transitions_late += rollout.env_steps", "self.ledger.transitions_late += 0"
    ),
    "a repeated rollout is not counted": Mutation(
        None, ROLLOUTS, "self.ledger.transitions_duplicate += rollout.env_steps", "self.ledger.transitions_duplicate += 0"
    ),
    "the arrival of a rollout is not recorded": Mutation(
        Rule.ARRIVED, ROLLOUTS, "self._end(member, permit).arrived(rollout.sequence)", "self._end(member, permit)"
    ),
    "a lost Collect is not sent again": Mutation(
        Rule.ORDER_AGAIN, COORDINATOR, "orders = self.rollouts.send(member, lost)", "orders = []"
    ),
    "lost weights are not sent again": Mutation(
        Rule.WEIGHTS_AGAIN, WEIGHTS, "for version in lost for message in", "for version in lost[:0] for message in"
    ),
    "weights that may be under way are sent again": Mutation(
        Rule.SENT_BEFORE, WEIGHTS, "if replies >= heartbeat.replies:", "if replies > heartbeat.replies:"
    ),
    "weights that are sent again are not noted": Mutation(
        Rule.SENT_BEFORE,
        WEIGHTS,
        "for message in self._send(member, version, None)]",
        "for message in [(member.peer, self.kept[version])]]",
    ),
    "weights that a heartbeat does not list count as held": Mutation(
        Rule.WEIGHTS_AGAIN, WEIGHTS, "case _ if version in heartbeat.versions:", "case _:"
    ),
    "a Collect is sent again without the weights that it names": Mutation(
        Rule.WEIGHTS_AFTER, COORDINATOR, "out + self.weights.after(orders, self.members)", "out + orders"
    ),
    "weights are never sent": Mutation(
        Rule.WEIGHTS_AFTER, WEIGHTS, "in sorted(order.versions - self.held.versions(peer)):", "in ():"
    ),
    "weights are sent with every order": Mutation(
        Rule.WEIGHTS_AFTER, WEIGHTS, "sorted(order.versions - self.held.versions(peer))", "sorted(order.versions)"
    ),
    "the newest weights are sent to whoever holds a ticket": Mutation(
        Rule.WEIGHTS_AFTER, WEIGHTS, "[(receiver, self.kept[version])]", "[(receiver, self.kept[max(self.kept)])]"
    ),
    "the learner keeps only the newest weights": Mutation(None, WEIGHTS, "if version in needed}", "if False}"),
    "the learner keeps all weights": Mutation(None, WEIGHTS, "if version in needed}", "if True}"),
    "heartbeats are answered with the same number": Mutation(
        Rule.SENT_BEFORE, MEMBERS, "member.replies += 1", "member.replies += 0"
    ),
    "tickets of a lost worker are kept": Mutation(
        Rule.LOST_TICKETS, COORDINATOR, "for number in list(member.tickets):", "for number in ():"
    ),
    "what a lost worker held counts as held": Mutation(None, COORDINATOR, "self.weights.held.forget(member.peer)", "pass"),
    "two tickets of a lane have one sequence number": Mutation(Rule.SEQUENCE, LANES, "self.dealt += 1", "self.dealt = 1"),
    "sequence numbers go on in the next incarnation": Mutation(
        Rule.SEQUENCE,
        LANES,
        "            self.dealt = 0\n            self.next_sequence = 0\n",
        "            self.next_sequence = 0\n",
    ),
    "a checkpoint repeats an incarnation": Mutation(
        Rule.SEQUENCE, ROLLOUTS, "lane.incarnation + (lane.dealt > 0) for", "lane.incarnation + 0 for"
    ),
    "lanes are placed after tickets are dealt": Mutation(
        Rule.LANE_MOVES, COORDINATOR, "out = self._placement.place(self.members.values())", "out: list[Outgoing] = []"
    ),
    "a repeated Welcome starts the session again": Mutation(
        Rule.REPEATED_WELCOME, SESSION, "self.state is WorkerState.READY and message.session == self.session", "False"
    ),
    "a worker that joins again repeats its Hello": Mutation(
        Rule.REJOIN, SESSION, "self._attempt += 1", "self._attempt = self.identity.process_nonce + 1"
    ),
    "finished work stays in progress": Mutation(Rule.LOWEST_VERSION_FIRST, SESSION, "current.in_progress = False", "pass"),
    "a worker takes work while it works": Mutation(
        Rule.LOWEST_VERSION_FIRST, SESSION, "self._current.in_progress = work is not None", "pass"
    ),
    "replies to heartbeats are not counted": Mutation(Rule.HEARTBEAT_REPLIES, SESSION, "current.replies = number", "pass"),
    "a worker acts under the newest weights": Mutation(
        Rule.VERSION,
        SESSION,
        "RolloutTask(session, self.weights[version], permits, ",
        "RolloutTask(session, self.weights[max(self.weights)], permits, ",
    ),
    "a worker drops weights that a ticket names": Mutation(
        Rule.HOLDS_WEIGHTS, SESSION, "kept = self.asked_versions().union(listed)", "kept = listed"
    ),
    "a worker drops weights when a lane closes": Mutation(
        Rule.HOLDS_WEIGHTS,
        SESSION,
        "return [CloseLanes(released)] if released else []",
        "self.keep_weights(())\n        return [CloseLanes(released)] if released else []",
    ),
    "a worker drops weights when newer ones come": Mutation(
        Rule.HOLDS_WEIGHTS,
        SESSION,
        "current.weights.setdefault(version, message)",
        "current.weights.setdefault(version, message), current.keep_weights([max(current.weights)])",
    ),
    "a worker drops weights when a ticket ends": Mutation(
        Rule.HOLDS_WEIGHTS,
        SESSION,
        "        current.in_progress = False\n        return [*map",
        "        current.keep_weights(())\n        current.in_progress = False\n        return [*map",
    ),
    "a worker keeps all weights": Mutation(
        Rule.HOLDS_WEIGHTS,
        SESSION,
        "for version, weights in self.weights.items() if version in kept}",
        "for version, weights in self.weights.items()}",
    ),
    "new weights replace all others": Mutation(
        Rule.HOLDS_WEIGHTS, SESSION, "current.weights.setdefault(version, message)", "current.weights = {version: message}"
    ),
    "a Collect confirms nothing": Mutation(
        Rule.ROLLOUT_ONCE,
        SESSION,
        "current.rollouts.forget_received(received)\n                again",
        "again",
    ),
    "an asked-for rollout is not sent again": Mutation(
        Rule.ROLLOUT_ONCE, SESSION, "return [SendMessage(answer) for answer in again if answer is not None]", "return []"
    ),
    "a finished ticket is forgotten": Mutation(
        Rule.RECEIVED, HELD, " or (permit.sequence < lane.sequence and permit.ticket not in lane.answered):", ":"
    ),
    "a rollout that has not arrived is forgotten": Mutation(
        Rule.ROLLOUT_ONCE,
        HELD,
        "rollout.sequence < of_lane.next_sequence or",
        "rollout.sequence <= of_lane.next_sequence or",
    ),
    "a rollout is collected before an earlier one has come": Mutation(
        Rule.IN_ORDER, HELD, "if asked.permit.sequence == lane.sequence and ", "if "
    ),
    "a rollout starts without its weights": Mutation(Rule.VERSION, HELD, " and asked.versions.issubset(versions):", ":"),
    "a rollout starts without the weights of its opponent": Mutation(
        Rule.OPPONENTS, HELD, "asked.versions.issubset(versions):", "asked.version in versions:"
    ),
    "a worker drops the weights of opponents": Mutation(
        Rule.HOLDS_WEIGHTS,
        HELD,
        "return {version for lane in self._lanes.values() for asked in lane.asked.values() for version in asked.versions}",
        "return {asked.version for lane in self._lanes.values() for asked in lane.asked.values()}",
    ),
    "an order does not list the weights that its worker keeps": Mutation(
        Rule.KEEP, WEIGHTS, "keep=tuple(sorted(keep))", "keep=()"
    ),
    "only the weights that act are sent after an order": Mutation(
        Rule.WEIGHTS_AFTER, WEIGHTS, "sorted(order.versions -", "sorted({order.version} -"
    ),
    "the weights of opponents do not count as named": Mutation(
        Rule.KEEP, LANES, "return versions_of(self.version, [self.permit.opponent])", "return {self.version}"
    ),
    "what the earlier tickets of a worker name is forgotten": Mutation(
        Rule.KEEP, WEIGHTS, "keep = member.needs(member.tickets)", "keep = order.versions"
    ),
    "the weights of opponents are dropped": Mutation(None, COORDINATOR, "needed.update(opponents.versions)", "pass"),
    "an opponent is forgotten while a version can meet it": Mutation(
        None, POOL, " - settings.window - settings.max_lag", " - settings.window"
    ),
    "an opponent is drawn from versions that came later": Mutation(None, POOL, " if each <= version]", "]"),
    "an order does not name its opponent": Mutation(
        Rule.OPPONENT, LANES, "round_number, opponent, past)\n", "round_number, None, past)\n"
    ),
    "an order does not bring the past of its lane": Mutation(
        Rule.PAST, LANES, "round_number, opponent, past)\n", "round_number, opponent)\n"
    ),
    "a lane continues without the rollouts that wait": Mutation(
        Rule.PAST, ROLLOUTS, "for number in range(self.rounds.next, first)]", "for number in range(0)]"
    ),
    "what came after a lost rollout is kept": Mutation(
        Rule.PAST, ROLLOUTS, "                self._drop_after(lane, lane.due[0])\n", "                pass\n"
    ),
    "a checkpoint counts its rounds from 0": Mutation(
        Rule.PAST, COORDINATOR, "RoundsState(rounds.next, ", "RoundsState(0, "
    ),
    "a worker forgets what a lane continues": Mutation(
        Rule.PAST,
        HELD,
        "Permitted(permit, version)",
        "Permitted(Permit(*(getattr(permit, name) for name in permit.__struct_fields__[:-1])), version)",
    ),
    "later rollouts are collected first": Mutation(
        Rule.LOWEST_VERSION_FIRST, HELD, "version = min(startable, default=-1)", "version = max(startable, default=-1)"
    ),
    "rollouts of a lane are not counted": Mutation(Rule.IN_ORDER, HELD, "self.sequence += kept", "pass"),
    "the lane of a lost worker is not placed anew": Mutation(
        Rule.LOST_TICKETS, PLACEMENT, "self._unplaced |= member.lanes", "pass"
    ),
    "a silent worker is never removed": Mutation(
        Rule.WORKER_TIMEOUT, MEMBERSHIP, "if now - member.alive_s > timeout_s]", "if False]"
    ),
    "messages of an earlier session are accepted": Mutation(
        Rule.OTHER_SESSION, SESSION, 'getattr(message, "session", self.session) != self.session:', "False:"
    ),
    "heartbeats are always due": Mutation(
        Rule.HEARTBEAT,
        SESSION,
        " or now < self.due_s:\n            return []\n        self.due_s",
        ":\n            return []\n        self.due_s",
    ),
    "heartbeats are never due": Mutation(
        Rule.HEARTBEAT,
        SESSION,
        " or now < self.due_s:\n            return []\n        self.due_s",
        " or True:\n            return []\n        self.due_s",
    ),
    "heartbeats at half the rate needed": Mutation(
        Rule.HEARTBEAT,
        SESSION,
        "self.due_s = now + self.run.heartbeat_s",
        "self.due_s = now + 2 * self.run.heartbeat_s",
    ),
    "a lost Release is never said again": Mutation(
        Rule.UNLISTED, SESSION, "return current.release_unlisted(received)", "return []"
    ),
    "a lane reopened on a new incarnation keeps the old lane's state": Mutation(
        Rule.INCARNATION,
        HELD,
        "lane = self._lanes[number] = self._kind(incarnation)",
        "lane = self._lanes[number] = lane or self._kind(0)\n            lane.incarnation = incarnation",
    ),
    "a lane keeps its incarnation": Mutation(Rule.LANE_MOVES, LANES, "self.incarnation += 1", "self.incarnation += 0"),
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
        Training(workers=1, lanes=1, updates=3, faults=1, opponents=3),
        Training(workers=1, lanes=1, updates=1, faults=2, only=("drop up", "drop down")),
        Training(workers=2, lanes=1, updates=1, faults=1),
        Training(workers=1, lanes=1, updates=2, faults=1, max_lag=1),
        Training(workers=1, lanes=1, updates=4, faults=1, max_lag=1, opponents=2),
        Training(workers=2, lanes=2, updates=5, faults=0, max_lag=1, opponents=3),
        Training(workers=1, lanes=2, updates=3, faults=1, max_lag=1),
        Training(workers=2, lanes=2, updates=2, faults=1, max_lag=1, only=("repeat down",)),
        Training(workers=1, lanes=1, updates=2, faults=3, only=("repeat down", "freeze")),
        Training(workers=1, lanes=1, updates=2, faults=2),
        Training(workers=2, lanes=2, updates=2, faults=1, only=("drop down",)),
        Training(workers=2, lanes=2, updates=1, faults=1),
        Training(workers=2, lanes=2, updates=2, faults=2, only=("drop down", "kill, reported")),
        Training(workers=1, lanes=1, updates=3, faults=2, max_lag=1, only=("drop up", "kill, reported")),
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
