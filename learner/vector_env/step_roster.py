"""The learner's half of a vector environment. Pure: messages and `now` in, messages out; no socket, clock or environment.

The law: an order goes to one lane, which has one at a time; it is answered, or its lane is lost with its worker. A lost lane
lives again, on new env copies, in its next life. What a Heartbeat shows to be lost on the way is said again. Steps through
shared memory are counted elsewhere; of these only infos that are too long to be laid there come as messages.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from learner.members.events import Broke, Event
from learner.members.membership import Member, Membership, Out
from learner.members.states import Rubbish, Standing
from protocol.errors import BadMessage
from protocol.messages import (
    Answer,
    Drain,
    Failure,
    Goodbye,
    Heartbeat,
    HeartbeatReply,
    Hello,
    LaneLife,
    Order,
    Received,
    Refuse,
    Release,
    Returned,
    Rollout,
    Stepped,
    ToLearner,
)
from protocol.specs import StepSpec

Make = Callable[[int, int, LaneLife], Order]
"""An order for a lane, from the session, the ticket and the life of the lane."""


@dataclass
class Seat:
    """A lane as the learner sees it."""

    number: int
    incarnation: int = 0
    owner: bytes | None = None
    living: bool = False  # an order of this life was said: its copies exist, and can be lost


class Lockstep:
    """Members, lanes, orders and their answers."""

    def __init__(self, spec: StepSpec, first_session: int, worker_timeout_s: float = math.inf) -> None:
        self.spec = spec
        self.worker_timeout_s = worker_timeout_s
        self.membership = Membership(spec, Member, self._lost, first_session)
        self.seats = [Seat(lane) for lane in range(len(spec.lanes))]
        self.orders: dict[int, Order] = {}
        """said and not answered, by ticket"""
        self.answers: dict[int, Answer] = {}
        """by lane; whoever gave the order takes it"""
        self.in_memory: dict[int, int] = {}
        """lane -> number of its newest order, of those that went through shared memory"""
        self.infos: dict[int, bytes] = {}
        """by lane: the packed infos of such an order, where they came as a message"""
        self.lost: dict[int, str] = {}
        """lanes whose copies are gone, and why; whoever steps them takes note of it"""
        self.broke: list[Broke] = []
        """environments that raised"""
        self._tickets = 0

    @property
    def members(self) -> dict[bytes, Member]:
        """By routing id."""
        return self.membership.members

    def events(self) -> list[Event]:
        """What has happened since it was last asked."""
        return self.membership.happened()

    # ---------------------------------------------------------------- in

    def receive(self, peer: bytes, message: ToLearner, now: float) -> list[Out]:
        """What a worker said."""
        if isinstance(message, Hello):
            return self.membership.hello(peer, message, now)[0]
        member = self.membership.speaker(peer, message, now)
        if member is None:
            return self.membership.stranger(peer, message)
        match message:
            case Stepped() | Returned():
                return self._answer(member, message)
            case Heartbeat():
                return self._heartbeat(member, message)
            case Goodbye(_, reason):
                self.membership.forget(member, Goodbye, f"left: {reason}")
            case Failure(_, error, traceback, lane):
                broke = Broke(member.hello.worker, member.hello.host, lane, error, traceback)
                self.broke.append(broke)
                self.membership.events.append(broke)
                self.membership.forget(member, Failure, f"broke: {error}")
            case Rollout():
                return self.membership.refuse(member, Rubbish, "it sent a rollout, and nobody collects rollouts here")
        return []

    def reject(self, peer: bytes, why: str) -> list[Out]:
        """A message that could not be read, or an answer that does not fit: its sender is refused."""
        member = self.members.get(peer)
        return [(peer, Refuse(f"not understood: {why}"))] if member is None else self.membership.refuse(member, Rubbish, why)

    def revoke(self, peer: bytes, why: str) -> list[Out]:
        """A member may speak no more: it is told so and forgotten at once, whatever it holds."""
        return self.membership.revoke(peer, why)

    def gone(self, worker: str, why: str) -> None:
        """A worker's process has ended, or it is given up."""
        self.membership.gone(worker, why)

    def tick(self, now: float, listening_since_s: float) -> None:
        """Judge silence. Call it only when every message that has arrived was given to `receive`."""
        self.membership.silence(now, self.worker_timeout_s, listening_since_s)

    # ---------------------------------------------------------------- the vector environment's side

    def begin(self) -> None:
        """What the last orders gave has been taken."""
        self.answers.clear()
        self.in_memory.clear()
        self.infos.clear()

    def place(self, lane: int, patient: bool) -> bool:
        """See that the lane lives with a worker; False if there is none, or (`patient`) only such as have lanes already."""
        seat = self.seats[lane]
        if seat.owner is None:
            emptiest = min(self.membership.active(), key=_by_lanes, default=None)
            if emptiest is None or (emptiest.lanes and patient):
                return False
            seat.owner = emptiest.peer
            emptiest.lanes.add(lane)
        return True

    def rebalance(self) -> list[Out]:
        """All lanes are about to begin anew: move some from the fullest workers to the emptiest."""
        out: list[Out] = []
        active = self.membership.active()
        while active:
            fullest = max(active, key=lambda member: len(member.lanes))
            emptiest = min(active, key=_by_lanes)
            if len(fullest.lanes) - len(emptiest.lanes) < 2:
                break
            seat = self.seats[max(fullest.lanes)]
            fullest.lanes.remove(seat.number)
            out.append((fullest.peer, Release(fullest.session, (LaneLife(seat.number, seat.incarnation),))))
            seat.owner, seat.living, seat.incarnation = emptiest.peer, False, seat.incarnation + 1
            emptiest.lanes.add(seat.number)
        return out

    def owner(self, lane: int) -> Member | None:
        """Whoever the lane lives with."""
        peer = self.seats[lane].owner
        return None if peer is None else self.members[peer]

    def order(self, lane: int, make: Make) -> list[Out]:
        """Say an order to a lane that has been placed."""
        member, seat = self.owner(lane), self.seats[lane]
        if member is None:
            raise ValueError(f"lane {lane} expected a worker, has none")
        self._tickets += 1
        order = make(member.session, self._tickets, LaneLife(lane, seat.incarnation))
        seat.living = True
        self.orders[order.ticket] = order
        member.tickets[order.ticket] = member.replies
        return [(member.peer, order)]

    # ---------------------------------------------------------------- inside

    def _answer(self, member: Member, answer: Answer) -> list[Out]:
        if answer.ticket < 0:
            return self._long_infos(member, answer)
        order = self.orders.get(answer.ticket)
        if order is None or answer.ticket not in member.tickets:
            return []  # a repeat
        try:
            check(answer, order, self.spec)
        except BadMessage as error:
            return self.reject(member.peer, str(error))
        del self.orders[answer.ticket], member.tickets[answer.ticket]
        self.answers[answer.lane] = answer
        return []

    def _long_infos(self, member: Member, answer: Answer) -> list[Out]:
        """To an order through shared memory; it counts only while that lane's newest order is this one."""
        if not isinstance(answer, Stepped):
            return self.reject(member.peer, "an answer to an order through shared memory expected Stepped, got Returned")
        mine = answer.lane in member.lanes and self.seats[answer.lane].incarnation == answer.incarnation
        if mine and self.in_memory.get(answer.lane) == -answer.ticket:
            self.infos[answer.lane] = bytes(answer.infos.data)
        return []

    def _heartbeat(self, member: Member, heartbeat: Heartbeat) -> list[Out]:
        """Say again what this account shows to be lost."""
        missing = member.account(heartbeat)
        if member.standing is Standing.DRAINING:
            return [(member.peer, Drain(self.membership.draining or ""))]
        out: list[Out] = []
        for ticket in missing:
            member.tickets[ticket] = member.replies
            out.append((member.peer, self.orders[ticket]))
        member.replies += 1
        lanes = tuple(Received(lane, self.seats[lane].incarnation, 0) for lane in sorted(member.lanes))
        return [*out, (member.peer, HeartbeatReply(member.session, member.replies, lanes))]

    def _lost(self, member: Member, why: str) -> None:
        for ticket in member.tickets:
            del self.orders[ticket]
        for lane in member.lanes:
            self.in_memory.pop(lane, None)
            seat = self.seats[lane]
            if seat.living:
                self.lost[lane] = f"worker {member.hello.worker} ({member.hello.host}) {why}"
            seat.owner, seat.living, seat.incarnation = None, False, seat.incarnation + 1


def _by_lanes(member: Member) -> tuple[int, int, str]:
    """Who has fewest comes first; among equals by name, not by who was faster to join."""
    return len(member.lanes), len(member.hello.worker), member.hello.worker


def check(answer: Answer, order: Order, spec: StepSpec) -> None:
    """Raise `BadMessage`, in one line, if the answer is not one to this order."""
    if (answer.lane, answer.incarnation) != (order.lane, order.incarnation):
        raise BadMessage(f"answer expected of lane {order.lane}, got lane {answer.lane}")
    if isinstance(answer, Returned):
        return
    N = spec.lanes[answer.lane]
    if len(answer.obs) != len(spec.observation):
        raise BadMessage(f"obs expected {len(spec.observation)} arrays, got {len(answer.obs)}")
    expected = [
        *((f"obs {leaf.path}".strip(), leaf.dtype, leaf.shape) for leaf in spec.observation),
        ("reward", "float64", ()), ("terminated", "bool", ()), ("truncated", "bool", ()),
    ]  # fmt: skip
    found = [*answer.obs, answer.reward, answer.terminated, answer.truncated]
    for (name, dtype, shape), array in zip(expected, found, strict=True):
        if array.shape != (N, *shape) or array.dtype != np.dtype(dtype):
            raise BadMessage(f"{name} expected {dtype}{[N, *shape]}, got {array.dtype}{list(array.shape)}")
        if array.dtype.kind == "b" and array.size and array.view(np.uint8).max() > 1:
            raise BadMessage(f"{name} expected bytes 0 and 1, got {array.view(np.uint8).max()}")
