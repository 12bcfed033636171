"""Rules that apply to every message in a session, whichever check is running. Pure: messages and `now` in, `Broken` out.

The watch records what the learner has sent in this session, and sees each message of the client before the check does.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from millrace.extras.conformance.lane_rows import LaneRows
from millrace.extras.conformance.played_rows import PlayedRows
from millrace.extras.conformance.script import Broken, brief
from millrace.protocol.errors import BadRollout
from millrace.protocol.messages import (
    Answer,
    Call,
    Collect,
    Describe,
    Described,
    Drain,
    EpisodeRows,
    Evaluate,
    Evaluated,
    Failure,
    Goodbye,
    Heartbeat,
    HeartbeatReply,
    Order,
    Permit,
    Received,
    Refuse,
    Release,
    Reset,
    Returned,
    Rollout,
    Step,
    Stepped,
    ToLearner,
    ToWorker,
    Weights,
    Welcome,
)
from millrace.protocol.rows.rollout_checks import validate
from millrace.protocol.rows.stepped import wrong_rows
from millrace.protocol.rules import Rule
from millrace.protocol.specs import RunSpec, StepSpec, WaitSpec

HEARTBEATS_LATE = 2.0  # a Heartbeat may be late by this many intervals,
LATE_S = 1.5  # and by this many seconds more, because the machine may be busy
OTHER_SESSION = Rule.OTHER_SESSION, "its session was another"
UNREADABLE = Rule.IGNORE_UNREADABLE, "no message that names it can be read"


class Dealt(NamedTuple):
    """A permit, and the version that its Collect names."""

    permit: Permit
    version: int


class WatchedSession:
    """One session, as the learner sees it."""

    def __init__(self, welcome: Welcome, now: float, steps: int = 0, *, is_first: bool = True) -> None:
        """`steps`: number of env steps that the client's process reported in earlier sessions. `is_first`: whether this is
        the first session of the process.
        """
        self.welcome = welcome
        """the newest Welcome"""
        self.session = welcome.session
        self.run = welcome.run
        self._is_first_session = is_first
        self.heard_heartbeat_s = now
        self.heartbeat: Heartbeat | None = None
        """the newest Heartbeat"""
        self.replies = 0
        """number of the last HeartbeatReply that was sent"""
        self.confirms = True
        """whether the learner confirms that rollouts have arrived"""
        self.versions: dict[int, Weights] = {}
        """the weights sent, by version"""
        self.descriptions: dict[int, Describe] = {}
        """the orders to describe the environment, by ticket"""
        self.orders: dict[int, Order | Evaluate] = {}
        """the other orders, by ticket"""
        self.permits: dict[int, Dealt] = {}
        """the permits, by ticket"""
        self.answers: dict[int, Answer | Rollout] = {}
        """the first answer to each order, and the first rollout of each permit, by ticket"""
        self.played: dict[int, PlayedRows] = {}
        """the newest answer to each Evaluate, by ticket"""
        self.said_goodbye = False
        self._refused = self._drains = False  # whether the learner has sent Refuse, or Drain
        self._welcomed = -1  # number of the last reply before the Welcome with the run; -1 if the first Welcome had the run
        self._described: dict[int, Described] = {}  # the first answer to each Describe
        self._ignored: dict[int, tuple[Rule, str]] = {}  # tickets that must not be answered: the rule, and why
        self._lanes: dict[int, int] = {}  # the highest incarnation of each of the client's lanes
        self._asked = Counter[int]()  # how often each ticket was sent
        self._answered = Counter[int]()  # how often each ticket was answered
        self._results: dict[int, Evaluated] = {}  # the first answer to each Evaluate
        self._due: dict[int, int] = {}  # for each ticket, the number of the last HeartbeatReply that was sent before it
        self._missing = set[int]()  # tickets that the last Heartbeat should have listed, but didn't
        self._next_sequence: dict[tuple[int, int], int] = {}
        self._rows: dict[tuple[int, int], LaneRows] = {}
        self.steps = steps
        """the largest number of env steps that a Heartbeat has reported"""

    def to_keep(self, *named: int) -> tuple[int, ...]:
        """The versions that an order tells the client to keep: `named`, and the versions of all unanswered tickets."""
        of_permits = {ticket: dealt.version for ticket, dealt in self.permits.items()}
        of_orders = {ticket: order.version for ticket, order in self.orders.items() if isinstance(order, Evaluate)}
        answered = self.answers.keys() | self._results.keys()
        outstanding = {version for ticket, version in (of_permits | of_orders).items() if ticket not in answered}
        return tuple(sorted(outstanding.union(named)))

    # ------------------------------------------------------------------------------------------ what the learner says

    def sent(self, message: ToWorker) -> None:
        """Record that the learner has sent this message, which may be lost."""
        match message:
            case Welcome(session, _, RunSpec() | StepSpec() as run) if session == self.session:
                if isinstance(self.run, WaitSpec):
                    self.welcome = message
                    self.run = run
                    self._welcomed = self.replies
                    self._due.clear()  # descriptions that haven't arrived are no longer needed
            case Describe() if message.session != self.session:
                self._ignored[message.ticket] = OTHER_SESSION
            case Describe():
                self.descriptions[message.ticket] = message
                self._counts(message.ticket)
            case Weights(version):
                self.versions[version] = message
            case Reset() | Step() | Call() | Evaluate() if message.session != self.session:
                self._ignored[message.ticket] = OTHER_SESSION
            case Evaluate():
                self.orders[message.ticket] = message
                self._counts(message.ticket)
            case Reset() | Step() | Call():
                self.orders[message.ticket] = message
                self._asks(message)
            case Collect(session, _, permits) if session != self.session:
                self._ignored |= {permit.ticket: OTHER_SESSION for permit in permits}
            case Collect(_, version, permits):
                for permit in permits:
                    self.permits[permit.ticket] = Dealt(permit, version)
                    self._asks(permit)
            case Release(session, lanes) if session == self.session:
                for lane in lanes:
                    self._lanes.pop(lane.lane, None)
            case HeartbeatReply(session, number) if session == self.session:
                self.replies = max(self.replies, number)
            case Refuse():
                self._refused = True
            case Drain():
                self._drains = True

    def _counts(self, ticket: int) -> None:
        self._asked[ticket] += 1
        if not (self._drains or self._refused):
            self._due[ticket] = self.replies

    def loses(self) -> None:
        """Record that messages already sent may be lost, because the connection is cut."""
        self._due.clear()

    def _asks(self, order: Order | Permit) -> None:
        self._counts(order.ticket)
        newest = self._lanes[order.lane] = max(order.incarnation, self._lanes.get(order.lane, 0))
        if order.incarnation < newest:
            why = f"it is of incarnation {order.incarnation}, its lane is in {newest}"
            self._ignored[order.ticket] = Rule.INCARNATION, why

    def unreadable(self, ticket: int) -> None:
        """Record that the learner sends this ticket in messages that can't be read."""
        self._ignored[ticket] = UNREADABLE

    def received(self) -> tuple[Received, ...]:
        """For each lane of the client, which rollouts the learner confirms to have received."""
        arrived = self._next_sequence if self.confirms else {}
        return tuple(Received(*place, arrived.get(place, 0)) for place in sorted(self._lanes.items()))

    def reply(self, number: int) -> HeartbeatReply:
        """The HeartbeatReply with this number."""
        return HeartbeatReply(self.session, number, self.received())

    # --------------------------------------------------------------------------------------------- what the client says

    def late(self, now: float) -> None:
        """Raise `Broken` if a Heartbeat is overdue."""
        silent_s = now - self.heard_heartbeat_s
        if silent_s > HEARTBEATS_LATE * self.run.heartbeat_s + LATE_S:
            raise Broken(
                Rule.HEARTBEAT,
                f"a Heartbeat every {self.run.heartbeat_s:g} s (heartbeat_s of this session)",
                f"none for {silent_s:.1f} s",
            )

    def see(self, message: ToLearner, now: float) -> None:
        """Check one message of this session. Raises `Broken` if it breaks a rule."""
        if self.said_goodbye:
            raise Broken(Rule.AFTER_GOODBYE, "nothing after Goodbye", brief(message))
        match message:
            case Heartbeat():
                self._see_heartbeat(message, now)
            case Described() | Stepped() | Returned() | Rollout():
                if message.ticket in self._ignored:
                    rule, why = self._ignored[message.ticket]
                    raise Broken(rule, f"ticket {message.ticket} to be ignored: {why}", brief(message))
                if isinstance(message, Rollout):
                    self._see_rollout(message)
                elif isinstance(message, Described):
                    self._see_description(message)
                else:
                    self._see_answer(message)
            case Evaluated() | EpisodeRows():
                order = self.orders.get(message.ticket)
                if not isinstance(order, Evaluate):
                    raise Broken(Rule.EVALUATE, "the ticket of an Evaluate of this session", brief(message))
                self._see_played(message, order)
            case Goodbye() | Failure() if self._refused and not self._drains:  # after a Drain, this may answer the Drain
                raise Broken(Rule.AFTER_REFUSE, "no last words after Refuse", brief(message))
            case Goodbye():
                self._see_tickets(message.tickets)
                self.said_goodbye = True
            case _:
                pass

    def _see_heartbeat(self, message: Heartbeat, now: float) -> None:
        self.heard_heartbeat_s = now
        before = self.heartbeat
        self.heartbeat = message
        if message.replies > self.replies:
            raise Broken(
                Rule.HEARTBEAT_REPLIES, f"at most {self.replies}, the last reply of this session", f"{message.replies}"
            )
        if before is not None and message.replies < before.replies:
            raise Broken(Rule.HEARTBEAT_REPLIES, f"{before.replies} or more, as before", f"{message.replies}")
        if message.steps < self.steps:
            raise Broken(Rule.HEARTBEAT_STEPS, f"{self.steps} or more, as before", f"{message.steps}")
        self.steps = message.steps
        if list(message.versions) != sorted(self.versions.keys() & message.versions):
            sent = f"those sent: {sorted(self.versions)}" if self.versions else "none: no weights were sent in this session"
            raise Broken(Rule.HEARTBEAT_VERSIONS, f"versions in ascending order, of {sent}", f"{list(message.versions)}")
        self._see_if_it_waits(message)
        self._see_tickets(message.tickets)
        self._see_if_all_are_listed(message)

    def _see_if_it_waits(self, message: Heartbeat) -> None:
        expected = isinstance(self.run, WaitSpec)
        may_be_late = message.replies <= self._welcomed
        if message.waits != expected and not (message.waits and may_be_late):
            raise Broken(Rule.HEARTBEAT_WAITS, f"waits {expected} with a {type(self.run).__name__}", f"{message.waits}")

    def _see_tickets(self, tickets: Sequence[int]) -> None:
        known = self.descriptions.keys() | self.orders.keys() | self.permits.keys()
        if strange := [ticket for ticket in tickets if ticket not in known]:
            raise Broken(
                Rule.HEARTBEAT_TICKETS,
                f"tickets of this session{f', among {sorted(known)[-5:]}' if known else ', which has none yet'}",
                f"ticket {strange[0]}",
            )
        if finished := [ticket for ticket in tickets if ticket in self.answers]:
            raise Broken(
                Rule.HEARTBEAT_TICKETS, "only tickets that are not finished", f"ticket {finished[0]}, which was answered"
            )

    def _see_if_all_are_listed(self, message: Heartbeat) -> None:
        """Check that the Heartbeat lists every ticket that was sent before the last reply and isn't answered.

        A client with two threads may list a ticket one Heartbeat later.
        """
        missing = {
            ticket
            for ticket, replies in self._due.items()
            if replies < message.replies and ticket not in message.tickets and self._is_open(ticket)
        }
        if still := missing & self._missing:
            expected = f"ticket {max(still)}, which came before HeartbeatReply {message.replies} and is not finished"
            raise Broken(self.rule_of_missing(max(still), Rule.HEARTBEAT_TICKETS), expected, f"{list(message.tickets)}")
        self._missing = missing

    def rule_of_missing(self, ticket: int, otherwise: Rule) -> Rule:
        """The rule that is probably broken if the client does nothing about a ticket.

        In a later session, a client that didn't forget the previous session may mistake a lane's first permit for an old
        one.
        """
        is_old = not self._is_first_session and ticket in self.permits and not self.permits[ticket].permit.sequence
        return Rule.FORGETS if is_old else otherwise

    def _is_open(self, ticket: int) -> bool:
        """Whether the client must hold this ticket."""
        if ticket in self.answers or ticket in self._results or ticket in self._ignored:
            return False
        if ticket in self.descriptions:
            return ticket == max(self.descriptions) and ticket not in self._described
        order = self.orders.get(ticket) or self.permits[ticket].permit
        if isinstance(order, Evaluate):
            later = (each for each in self.orders.values() if isinstance(each, Evaluate) and each.ticket > ticket)
            return all(each.version == order.version for each in later)
        of_lane = (
            each.ticket for each in self.orders.values() if not isinstance(each, Evaluate) and each.lane == order.lane
        )
        return self._lanes.get(order.lane) == order.incarnation and max(of_lane, default=ticket) <= ticket

    def _see_played(self, message: Evaluated | EpisodeRows, order: Evaluate) -> None:
        assert isinstance(self.run, RunSpec)
        ticket = order.ticket
        is_answer = isinstance(message, Evaluated)
        if self._answered[ticket] == self._asked[ticket]:
            rule = Rule.EVALUATE_ONCE if is_answer else Rule.ROWS_FIRST
            raise Broken(
                rule, f"nothing of ticket {ticket} after its Evaluated, until the order comes again", brief(message)
            )
        if order.version not in self.versions:
            expected = f"no {type(message).__name__} before the Weights of version {order.version}"
            raise Broken(Rule.EVALUATE_VERSION, expected, brief(message))
        played = self.played.get(ticket)
        if played is None or played.ended:
            played = self.played[ticket] = PlayedRows(order, self.run, self.versions[order.version])
        if isinstance(message, EpisodeRows):
            return played.see_rows(message)
        played.see_answer(message)
        self._answered[ticket] += 1
        if self._results.setdefault(ticket, message) != message and not order.send_rows:
            raise Broken(Rule.EVALUATE_ONCE, f"the same answer to ticket {ticket} again", "another")
        return None

    def _see_description(self, message: Described) -> None:
        ticket = message.ticket
        if ticket not in self.descriptions:
            raise Broken(
                Rule.DESCRIBE, f"the ticket of a Describe: {sorted(self.descriptions) or 'none yet'}", brief(message)
            )
        self._answered[ticket] += 1
        asked = self._asked[ticket]
        answered = self._answered[ticket]
        if answered > asked:
            raise Broken(
                Rule.DESCRIBE, f"answers to ticket {ticket} as often as it was sent: {asked}", f"{answered} answers"
            )
        first = self._described.setdefault(ticket, message)
        if repr(message.description) != repr(first.description):
            raise Broken(Rule.DESCRIBE_AGAIN, "the same description again", "another")

    def _see_answer(self, message: Answer) -> None:
        order = self.orders.get(message.ticket)
        if order is None or isinstance(order, Evaluate):
            last = f"ticket {max(self.orders)} was the last order" if self.orders else "no order was sent in this session"
            raise Broken(Rule.ORDER_ONLY, f"no answer without an order ({last})", brief(message))
        if isinstance(order, Call) != isinstance(message, Returned):
            raise Broken(Rule.ORDER_ANSWERED, f"the answer to a {type(order).__name__}", brief(message))
        self._see_lane(message, order)
        if message.incarnation != order.incarnation:
            raise Broken(
                Rule.INCARNATION, f"incarnation {order.incarnation}, as in the order", f"incarnation {message.incarnation}"
            )
        if isinstance(message, Stepped):
            assert isinstance(self.run, StepSpec)
            check_stepped(message, self.run)
        self._is_first(message, Rule.ORDER_ONLY, Rule.ORDER_ONCE)

    def _see_lane(self, message: Answer | Rollout, order: Order | Permit) -> None:
        if message.lane != order.lane:
            expected = f"lane {order.lane}, as in the {type(order).__name__} with ticket {order.ticket}"
            raise Broken(Rule.LANES if isinstance(order, Permit) else Rule.ORDER_ANSWERED, expected, f"lane {message.lane}")

    def _is_first(self, message: Answer | Rollout, too_often: Rule, differs: Rule) -> bool:
        """Whether this is the first answer to its ticket.

        Raises `Broken`: with the rule `too_often` if there are too many answers, with `differs` if this one differs from the
        first.
        """
        ticket = message.ticket
        self._answered[ticket] += 1
        asked = self._asked[ticket]
        answered = self._answered[ticket]
        if answered > asked:
            raise Broken(too_often, f"answers to ticket {ticket} as often as it was sent: {asked}", f"{answered} answers")
        first = self.answers.setdefault(ticket, message)
        if first is not message and (wrong := fields_that_differ(first, message)):
            raise Broken(differs, f"the same answer to ticket {ticket} again", f"another {', '.join(wrong)}")
        return first is message

    def _see_rollout(self, message: Rollout) -> None:
        if not isinstance(self.run, RunSpec):
            raise Broken(Rule.TICKETS, "no rollout in a session whose copies are stepped on order", brief(message))
        dealt = self.permits.get(message.ticket)
        if dealt is None:
            raise Broken(Rule.TICKETS, f"a ticket that was dealt: {sorted(self.permits) or 'none yet'}", brief(message))
        permit, version = dealt
        self._see_lane(message, permit)
        if message.version != version:
            raise Broken(
                Rule.VERSION,
                f"version {version}, which the Collect of ticket {permit.ticket} names",
                f"version {message.version}",
            )
        if version not in self.versions:
            raise Broken(Rule.VERSION, f"no rollout before the Weights of version {version}", brief(message))
        if not self._is_first(message, Rule.ROLLOUT_ONCE, Rule.ROLLOUT_ONCE):
            return
        if message.sequence != permit.sequence:
            raise Broken(
                Rule.SEQUENCE,
                f"sequence {permit.sequence}, as in the permit with ticket {permit.ticket}",
                f"sequence {message.sequence}",
            )
        place = (message.lane, permit.incarnation)
        expected = self._next_sequence.get(place, 0)
        if message.sequence != expected:
            raise Broken(
                Rule.IN_ORDER,
                f"sequence {expected} first, of lane {place[0]}, incarnation {place[1]}",
                f"sequence {message.sequence}",
            )
        self._next_sequence[place] = expected + 1
        try:
            validate(message, self.run)
        except BadRollout as error:
            rule = Rule.SEATS if self.run.seats else Rule.ROWS
            raise Broken(rule, "a rollout that keeps the row format", str(error)) from None
        if place not in self._rows:
            begins = permit.past is None or permit.past.new_episodes
            self._rows[place] = LaneRows(self.run) if begins else self._continued(permit)
        rows = self._rows[place]
        rows.see(message, self.versions[message.version])

    def _continued(self, permit: Permit) -> LaneRows:
        """The rows of the lane's newest incarnation so far, which this permit continues."""
        newest = max(incarnation for lane, incarnation in self._rows if lane == permit.lane)
        return self._rows[permit.lane, newest]


def fields_that_differ(one: Answer | Rollout, other: Answer | Rollout) -> list[str]:
    """Names of the fields in which two messages differ in at least one bit."""
    return [name for name in one.__struct_fields__ if _bits(getattr(one, name)) != _bits(getattr(other, name))]


def _bits(value: object) -> object:
    match value:
        case np.ndarray():
            return value.dtype, value.shape, value.tobytes()
        case tuple():
            return [_bits(each) for each in value]
    return value


def check_stepped(message: Stepped, spec: StepSpec) -> None:
    """Raise `Broken` if the arrays don't have the dtypes and shapes of the lane, or have values outside their spaces."""
    if why := wrong_rows(message, spec, axes=None):
        raise Broken(Rule.STEPPED_ARRAYS, "arrays of the lane", why)
    if why := wrong_rows(message, spec, axes=("copy",)):
        raise Broken(Rule.IN_SPACE, "values of their spaces", why)
    if message.infos.dtype != np.uint8 or message.infos.ndim != 1:
        raise Broken(Rule.STEPPED_ARRAYS, "infos uint8[bytes]", f"infos {message.infos.dtype}{list(message.infos.shape)}")


def resets_too_early(around: Sequence[tuple[bytes, bytes]]) -> bool:
    """Whether the copy was reset too early, which makes every episode's last observation the first one of the next episode.

    `around`: pairs of these observations, for episodes that terminated. False if all episodes begin in the same way, because
    then the pairs prove nothing.
    """
    first = {after for _, after in around}
    return len(around) >= 3 and len(first) > 1 and all(last == after for last, after in around)
