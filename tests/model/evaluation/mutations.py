"""Mistakes made on purpose in the program's evaluations, one at a time, to see whether the checker finds them.

`python -m tests.model.evaluation.mutations NAME` explores small runs with this mistake. Exit code 1: a rule is
broken.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from millrace.protocol.rules import Rule
from tests.model.mutations import COORDINATOR, HELD, PLACEMENT, SESSION, WEIGHTS, Mutation, play

if TYPE_CHECKING:
    from tests.model.conversation import Conversation

TICKETS = "millrace.learner.rollouts.evaluation_dealer"

MUTATIONS = {
    "an evaluation of the version before": Mutation(
        None, TICKETS, "version=self.version,", "version=max(0, self.version - 1),"
    ),
    "a ticket that was put back is lost": Mutation(
        None, TICKETS, "heapq.heappush(self._undealt, number - self._first)", "pass"
    ),
    "tickets for rollouts are dealt during an evaluation": Mutation(
        None,
        COORDINATOR,
        "if evaluation is None or evaluation.beside:",
        "if True:",
    ),
    "the weights of an evaluation are not sent after its orders": Mutation(
        Rule.WEIGHTS_AFTER,
        COORDINATOR,
        "        return self.weights.after(out, self.members)",
        "        return self.weights.after(out, self.members) if evaluation is None else out",
    ),
    "the lost weights of an evaluation are not sent again": Mutation(
        Rule.WEIGHTS_AGAIN, TICKETS, "SentTicket(member.replies, order.versions)", "SentTicket(member.replies)"
    ),
    "a lost order to evaluate is not sent again": Mutation(
        Rule.ORDER_AGAIN, COORDINATOR, "orders += self.evaluation.pending.send(member, lost)", "pass"
    ),
    "the evaluation's tickets of a lost worker are kept": Mutation(
        None, COORDINATOR, "self.evaluation.pending.lose(member, number)", "pass"
    ),
    "two evaluations number their tickets alike": Mutation(
        Rule.TICKET_NUMBERS, TICKETS, "self._next_ticket += len(self.pending.seeds)", "pass"
    ),
    "a ticket of an evaluation is dealt twice": Mutation(
        Rule.TICKET_NUMBERS, TICKETS, "heapq.heappop(self._undealt)", "self._undealt[0]"
    ),
    "an answer leaves its ticket with the worker": Mutation(
        None, TICKETS, "        del member.tickets[number]\n        self._rows", "        self._rows"
    ),
    "rows of a lost worker are kept": Mutation(
        None, TICKETS, "self._rows.pop((number - self._first, member.peer), None)", "pass"
    ),
    "an answer counts without its rows": Mutation(
        Rule.ROWS_FIRST, TICKETS, "!= [one.length for one in answer.episodes]:", "== []:"
    ),
    "an evaluation that was played again is forgotten": Mutation(
        None,
        TICKETS,
        "self.lose(member, answer.ticket)  # a message",
        "self._forget(self.playing.pop(answer.ticket)[0], answer.ticket)  # a message",
    ),
    "an answer to an order to evaluate is not sent again": Mutation(
        Rule.EVALUATE_ONCE, HELD, "return self.answered.get(ticket)", "return None"
    ),
    "an order to evaluate is executed when it is repeated": Mutation(
        Rule.EVALUATE_ONCE, HELD, "if ticket not in self.answered:", "if True:"
    ),
    "an evaluation under any weights": Mutation(
        Rule.EVALUATE_VERSION, HELD, "if order.versions.issubset(versions)]", "if True]"
    ),
    "an executed order to evaluate stays": Mutation(
        Rule.EVALUATE_VERSION, HELD, "self.asked.pop(answer.ticket, None)", "self.asked.get(answer.ticket)"
    ),
    "an answer is kept although rows belong to it": Mutation(
        Rule.EVALUATE_ONCE, HELD, "(order.send_rows or order.send_frames):", "False:"
    ),
    "a worker that evaluates takes other work": Mutation(
        Rule.LOWEST_VERSION_FIRST, SESSION, "self._current.in_progress = work is not None", "pass"
    ),
    "an evaluation of an earlier session goes on": Mutation(
        Rule.FORGETS, SESSION, "return self.state not in goes_on or work.session != self.session", "return False"
    ),
    "a worker that only evaluates gets a lane": Mutation(
        Rule.EVALUATES, PLACEMENT, "if not (each.hello.evaluates or each.describes)", "if not each.describes"
    ),
    "all play an evaluation beside training": Mutation(
        None, TICKETS, "if member.hello.evaluates or not self.beside]", "if True]"
    ),
    "only those that only evaluate ever play": Mutation(
        None, TICKETS, "if member.hello.evaluates or not self.beside]", "if member.hello.evaluates]"
    ),
    "rollouts wait for an evaluation beside training": Mutation(
        None, COORDINATOR, "if evaluation is None or evaluation.beside:", "if evaluation is None:"
    ),
    "an evaluation waits for a lost worker that only evaluates": Mutation(
        None, COORDINATOR, "        evaluation.all_play()\n", "        pass\n"
    ),
    "all play an evaluation although a worker is there that only evaluates": Mutation(
        None, COORDINATOR, " or any(member.hello.evaluates for member in self.membership.active()):", ":"
    ),
    "the weights of a pending evaluation are not kept": Mutation(
        None, COORDINATOR, "needed.add(self.evaluation.pending.version)", "pass"
    ),
    "what a worker has dropped counts as held": Mutation(
        Rule.KEEP,
        WEIGHTS,
        "for version, standing in mine.items() if version in versions}",
        "for version, standing in mine.items()}",
    ),
    "weights that a ticket names count as dropped": Mutation(
        Rule.KEEP, WEIGHTS, "self.held.keep_only(peer, keep)", "self.held.keep_only(peer, order.versions)"
    ),
    "a worker drops weights that an evaluation names": Mutation(
        Rule.HOLDS_WEIGHTS, SESSION, "self.rollouts.versions() | self.evaluations.versions()", "self.rollouts.versions()"
    ),
    "an evaluation that is over goes on when the next one begins": Mutation(
        Rule.EVALUATE_ENDS, HELD, "if order.version == self.asked[newest].version}", "if True}"
    ),
    "a late order of an earlier evaluation ends the next one": Mutation(
        Rule.EVALUATE_ENDS, HELD, "newest = max(self.asked, default=ticket)", "newest = min(self.asked, default=ticket)"
    ),
}


def runs() -> list[Conversation]:
    """Small runs, the smallest first."""
    from tests.model.evaluation.evaluating import Evaluating

    return [
        Evaluating(workers=2, lanes=1, updates=2, faults=0, episodes=1, evaluators=1),
        Evaluating(workers=2, lanes=1, updates=2, faults=0, evaluators=0),
        Evaluating(workers=1, lanes=1, updates=1, faults=1),
        Evaluating(workers=1, lanes=1, updates=1, faults=1, episodes=1, rows=True),
        Evaluating(workers=1, lanes=1, updates=1, faults=1, evaluated=(0, 1)),
        Evaluating(workers=1, lanes=1, updates=1, faults=1, episodes=1, rows=True, evaluated=(0, 1)),
        Evaluating(workers=1, lanes=1, updates=2, faults=1, max_lag=1, evaluated=(1,)),
        Evaluating(workers=1, lanes=1, updates=1, faults=2, episodes=1, rows=True),
        Evaluating(workers=2, lanes=1, updates=1, faults=1),
    ]


if __name__ == "__main__":
    play(MUTATIONS, runs)
