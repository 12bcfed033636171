"""Mistakes made on purpose in the vector environment's conversation, one at a time, to see whether the checker finds them.

`python -m tests.model.vector_env.mutations NAME` explores small runs with this mistake. Exit code 1: a rule is broken.

Not in the list, because runs of this size do not show them: a lost lane that keeps its incarnation (it must come back to a
worker that has not heard that it was moved away), and a copy of an old reply to a heartbeat that takes a lane away (the lane
must have come between the two).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from millrace.protocol.rules import Rule
from tests.model.mutations import HELD, SESSION, Mutation, play

if TYPE_CHECKING:
    from tests.model.conversation import Conversation

COORDINATOR = "millrace.learner.vector_env.order_coordinator"
MEMBERS = "millrace.learner.members.coordinator"
LOST = "millrace.learner.vector_env.lost_lanes"
SENT = "millrace.learner.vector_env.sent_lanes"
SEND_RECV = "millrace.learner.vector_env.send_recv"

MUTATIONS = {
    "a lost order is not sent again": Mutation(
        Rule.ORDER_AGAIN, COORDINATOR, "return [(member.peer, orders[ticket]) for ticket in lost]", "return []"
    ),
    "heartbeats of a vector environment are answered alike": Mutation(
        Rule.SENT_BEFORE, MEMBERS, "member.replies += 1", "member.replies += 0"
    ),
    "a lost lane is not reported": Mutation(None, COORDINATOR, "if self.lanes[lane].started:", "if False:"),
    "an order does not start its lane": Mutation(None, COORDINATOR, "lane.started = True", "pass"),
    "the order of a lost worker is kept": Mutation(None, COORDINATOR, "if isinstance(self.order, SentOrder):", "if False:"),
    "an answer leaves its order open": Mutation(None, COORDINATOR, "del member.tickets[message.ticket]", "pass"),
    "an order that was sent waits on": Mutation(None, COORDINATOR, "lane.order = SentOrder(order)", "pass"),
    "an order that was replaced stays with its worker": Mutation(
        None, COORDINATOR, "member.tickets.pop(record.order.order.ticket, None)", "pass"
    ),
    "a loss is reported only after the answer to an earlier order": Mutation(
        None, COORDINATOR, "return wanted", "return True"
    ),
    "a lane is stepped before its loss is reported": Mutation(None, SEND_RECV, "if lane in unreported:", "if False:"),
    "new copies are stepped before they are reset": Mutation(None, SEND_RECV, "if lane in awaiting_reset:", "if False:"),
    "a reset that lost its worker is not sent again": Mutation(
        None, SEND_RECV, "last_observations)\n        self._hub.send_order(lane, reset.order())", "last_observations)"
    ),
    "a lane comes back before its answer": Mutation(
        None, SENT, "dict.fromkeys(lanes, sent)", 'dict.fromkeys(lanes, sent); self._results |= dict.fromkeys(lanes, b"")'
    ),
    "a lane that was reset is reset again": Mutation(None, LOST, "self._awaiting_reset -= lanes", "pass"),
    "a lane whose loss was reported is not reset": Mutation(None, LOST, "self.expect_reset(reported)", "pass"),
    "a repeated order is executed again": Mutation(
        Rule.ORDER_ONCE, HELD, "order.ticket > lane.newest:", "order.ticket >= lane.newest:"
    ),
    "an answer is not sent again": Mutation(Rule.ORDER_ONCE, HELD, "return self.answered.get(ticket)", "return None"),
    "two processes count their attempts to join alike": Mutation(
        Rule.HELLO, SESSION, "self._attempt = identity.process_nonce", "self._attempt = 0"
    ),
    "an executed order stays": Mutation(
        Rule.ORDER_ONCE, HELD, "self.asked.pop(answer.ticket, None)", "self.asked.get(answer.ticket)"
    ),
    "an answer is not kept": Mutation(Rule.ORDER_ONCE, HELD, "self.answered[answer.ticket] = answer", "pass"),
    "replies to heartbeats are not counted": Mutation(Rule.HEARTBEAT_REPLIES, SESSION, "current.replies = number", "pass"),
    "an answered order stays in progress": Mutation(Rule.ORDER_ANSWERED, SESSION, "current.in_progress = False", "pass"),
}


def runs() -> list[Conversation]:
    """Small runs, the smallest first."""
    from tests.model.vector_env.stepping import Stepping

    return [
        Stepping(workers=1, lanes=1, calls=("reset", "step", "step", "step"), faults=1),
        Stepping(workers=1, lanes=2, calls=("reset", "step"), faults=1),
        Stepping(workers=2, lanes=1, calls=("reset", "step", "step"), faults=1),
        Stepping(workers=1, lanes=1, calls=("reset", "step"), faults=2),
        Stepping(workers=1, lanes=1, calls=("reset", "interrupted reset", "reset", "step"), faults=1),
        Stepping(workers=1, lanes=1, calls=("reset", "abandoned reset", "step"), faults=1),
    ]


if __name__ == "__main__":
    play(MUTATIONS, runs)
