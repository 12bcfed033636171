"""Mistakes made on purpose in the conversation before a run, one at a time, to see whether the checker finds them.

`python -m tests.model.describing.mutations NAME` explores small runs with this mistake. Exit code 1: a rule is broken.

Not in the list: an order to describe that stays when the run begins, because the workers of the model begin it at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from millrace.protocol.rules import Rule
from tests.model.mutations import HELD, MEMBERSHIP, PLACEMENT, SESSION, Mutation, play

if TYPE_CHECKING:
    from tests.model.conversation import Conversation

COORDINATOR = "millrace.learner.members.describe_coordinator"
MEMBER = "millrace.learner.members.member"

MUTATIONS = {
    "all workers describe": Mutation(
        Rule.ONE_DESCRIBES, COORDINATOR, "in others[: max(0, self._at_once - len(asked))]", "in others"
    ),
    "the next environment is described by who hangs": Mutation(
        Rule.ONE_DESCRIBES, COORDINATOR, "return bool(member.tickets), member.hello", "return False, member.hello"
    ),
    "lanes go to workers that still describe": Mutation(
        Rule.BEGINS, PLACEMENT, "each.hello.evaluates or each.describes", "each.hello.evaluates"
    ),
    "who describes is forgotten when the run begins": Mutation(
        Rule.BEGINS, MEMBERSHIP, "member.describes = bool(member.tickets)", "member.describes = False"
    ),
    "a worker that has described never gets lanes": Mutation(
        Rule.BEGINS, MEMBER, "            self.describes = False\n", "            pass\n"
    ),
    "a worker that is asked counts as free": Mutation(
        Rule.ONE_DESCRIBES, COORDINATOR, "member.tickets[self._tickets] = SentTicket(member.replies)\n", "pass\n"
    ),
    "a lost order to describe is not sent again": Mutation(
        Rule.ORDER_AGAIN, COORDINATOR, "            del member.tickets[ticket]  # so", "            pass  # so"
    ),
    "a description is not taken": Mutation(Rule.FIRST_DESCRIPTION, COORDINATOR, "self.described = described\n", "pass\n"),
    "nobody is asked in place of a lost worker": Mutation(
        Rule.ONE_DESCRIBES, COORDINATOR, "if self._unknown is None or", "if self._at_once > 1 or self._unknown is None or"
    ),
    "the Welcome that brings the run is not sent again": Mutation(
        Rule.WELCOME_AGAIN, MEMBERSHIP, "return [self._welcome(member)] if lost else []", "return []"
    ),
    "the run begins in other sessions": Mutation(
        Rule.BEGINS,
        MEMBERSHIP,
        "            member.tickets = {}\n",
        "            member.tickets = {}\n            member.session += 1\n",
    ),
    "replies are counted anew when the run begins": Mutation(
        Rule.BEGINS, MEMBERSHIP, "            member.tickets = {}\n", "            member.tickets, member.replies = {}, 0\n"
    ),
    "no environment is described": Mutation(
        Rule.DESCRIBE, SESSION, "case Describe() if isinstance(self.run, WaitSpec):", "case Describe() if False:"
    ),
    "the second Welcome is taken for a repeat": Mutation(
        Rule.BEGINS, SESSION, "if not isinstance(self.run, WaitSpec) or isinstance(run, WaitSpec):", "if True:"
    ),
    "a late copy of the first Welcome ends the run": Mutation(
        Rule.REPEATED_WELCOME, SESSION, "if not isinstance(self.run, WaitSpec) or isinstance(run, WaitSpec):", "if False:"
    ),
    "a worker does not say that it waits": Mutation(
        Rule.HEARTBEAT_WAITS, SESSION, "waits=isinstance(self.run, WaitSpec)", "waits=False"
    ),
    "a description is not sent": Mutation(Rule.DESCRIBE, SESSION, "return self.descriptions.keep(answer)", "return False"),
    "a description that is asked for again is made again": Mutation(
        Rule.DESCRIBE_AGAIN, HELD, "if ticket > newest:", "if ticket >= newest:"
    ),
}


def runs() -> list[Conversation]:
    """Small runs, the smallest first."""
    from tests.model.describing.describing import Describing

    return [
        Describing(workers=1, lanes=1, updates=1, faults=0),
        Describing(workers=2, lanes=1, updates=1, faults=0),
        Describing(workers=1, lanes=1, updates=1, faults=1),
        Describing(workers=2, lanes=1, updates=1, faults=1),
        Describing(workers=2, lanes=1, updates=1, faults=1, environments=2),
        Describing(workers=1, lanes=1, updates=1, faults=2),
    ]


if __name__ == "__main__":
    play(MUTATIONS, runs)
