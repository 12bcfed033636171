"""Who is a member: joining, sessions, names, refusals, leaving. Pure: messages and `now` in, messages out.

The law: one process has one session at a time. A repeated Hello is answered by the same Welcome; a new beginning, or another
process under the same name, ends the session before it. Whoever was refused stays refused. Whoever is silent for too long
is gone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from learner.members.events import Event, Joined, Left, Told, Turned
from learner.members.states import TABLE, Revoked, Silence, Standing
from protocol.address import worker_name
from protocol.messages import (
    PROTOCOL_VERSION,
    Drain,
    Failure,
    Goodbye,
    Heartbeat,
    Hello,
    Refuse,
    Rejoin,
    Rollout,
    ToLearner,
    ToWorker,
    Welcome,
)
from protocol.specs import RunSpec, StepSpec

MEASURE_S = 0.5  # at least, between two accounts that a worker's speed is measured by
REMEMBERED_REFUSALS = 1000  # processes; who has many names must not fill the memory

Out = tuple[bytes, ToWorker]


@dataclass
class Member:
    """A worker as the learner sees it."""

    peer: bytes
    hello: Hello
    session: int
    order: int
    heard_s: float
    standing: Standing = Standing.ACTIVE
    lanes: set[int] = field(default_factory=set)
    tickets: dict[int, int] = field(default_factory=dict)  # ticket -> replies said when it was last said
    replies: int = 0
    heartbeat: Heartbeat | None = None
    steps_per_s: float = 0.0
    counted: tuple[int, float] = (0, 0.0)  # env steps that its last measured account told of, and when

    def account(self, heartbeat: Heartbeat) -> list[int]:
        """Take note of its account of itself; the tickets that it shows to be lost: said before a reply that the worker
        has seen, yet not held.
        """
        self.heartbeat = heartbeat
        steps, since_s = self.counted
        if self.heard_s - since_s >= MEASURE_S:  # new weights make an account come early: too short a time to measure
            self.steps_per_s = (heartbeat.steps - steps) / (self.heard_s - since_s) if since_s else 0.0
            self.counted = heartbeat.steps, self.heard_s
        held, seen = set(heartbeat.tickets), min(heartbeat.replies, self.replies)
        return [ticket for ticket, said_at in self.tickets.items() if ticket not in held and seen > said_at]


M = TypeVar("M", bound=Member)


class Membership(Generic[M]):
    """The members, by their routing ids."""

    def __init__(self, run: RunSpec | StepSpec, kind: type[M], lost: Callable[[M, str], None], first_session: int) -> None:
        """`kind` is what is kept of each; `lost` is called when one is forgotten: it takes back what that one held."""
        self.members: dict[bytes, M] = {}
        self.events: list[Event] = []
        self.draining: str | None = None
        self._run, self._kind, self._lost = run, kind, lost
        self._next_session = first_session
        self._joins = 0
        self._silent_from_s = -math.inf  # before then nobody can have been silent for too long
        self._silent: set[str] = set()  # names of those given up for their silence, until they join again
        self._refused: dict[bytes, tuple[int, str]] = {}  # the life that was refused, and why

    def active(self) -> list[M]:
        """Those that are given work, in the order in which they joined."""
        return [member for member in self.members.values() if member.standing is Standing.ACTIVE]

    def happened(self) -> list[Event]:
        """What has happened since this was last asked."""
        events, self.events = self.events, []
        return events

    def speaker(self, peer: bytes, message: ToLearner, now: float) -> M | None:
        """Who says this, if it is of a session that lasts; it is heard."""
        member = self.members.get(peer)
        if member is None or isinstance(message, Hello) or member.session != message.session:
            return None
        member.heard_s = now
        return member

    def stranger(self, peer: bytes, message: ToLearner) -> list[Out]:
        """What is answered to whoever speaks of a session that has ended: to join again, unless it leaves anyway."""
        if isinstance(message, Hello | Goodbye | Failure):
            return []
        late = message.env_steps if isinstance(message, Rollout) else 0
        self.events.append(Told(worker_name(peer).decode(errors="replace")[:40], message.session, late))
        return [(peer, Rejoin(message.session))]

    def hello(self, peer: bytes, hello: Hello, now: float) -> tuple[list[Out], M | None]:
        """What is answered, and the member that has joined by it, if one has."""
        why = ""
        if hello.protocol != PROTOCOL_VERSION:
            why = f"protocol expected {PROTOCOL_VERSION}, got {hello.protocol}; install the learner's version of millrace"
        elif hello.worker.encode() != worker_name(peer):
            why = f"name expected {worker_name(peer)[:40]!r}, as in its routing id, got {hello.worker[:40]!r}"
        if why:
            self.events.append(Turned(hello.worker, why))
            return [(peer, Refuse(why))], None
        life, why = self._refused.get(peer, (-1, ""))
        if life == hello.life:
            return [(peer, Refuse(why))], None
        if self.draining is not None:
            return [(peer, Drain(self.draining))], None
        member = self.members.get(peer)
        if member is not None:
            same = member.hello.life == hello.life
            if same and hello.attempt == member.hello.attempt:
                member.heard_s = now
                return [(peer, Welcome(member.session, hello.attempt, self._run))], None
            if same and hello.attempt < member.hello.attempt:
                return [], None
            if not same:
                why = f"another process, on {hello.host}, joined as {hello.worker}; give each worker a name of its own"
                self._remember(member, why)
            self.forget(member, Silence, "began again" if same else f"replaced by process {hello.pid}")
        member = self._kind(peer, hello, self._next_session, self._joins, now)
        self._next_session += 1
        self._joins += 1
        self.members[peer] = member
        self._silent.discard(hello.worker)
        self.events.append(Joined(hello.worker, hello.host, hello.pid))
        return [(peer, Welcome(member.session, hello.attempt, self._run))], member

    def refuse(self, member: M, event: type, why: str) -> list[Out]:
        """Turn a member out for good."""
        self._remember(member, why)
        return self._turn_out(member, event, f"refused: {why}", why)

    def revoke(self, peer: bytes, why: str) -> list[Out]:
        """A member may speak no more: it is told so and forgotten at once, whatever it holds."""
        return self._turn_out(self.members[peer], Revoked, f"was shut out: {why}", why)

    def gone(self, worker: str, why: str) -> bool:
        """A worker's process is known to be dead: do not wait for its silence. False if it was no member any more."""
        member = next((member for member in self.members.values() if member.hello.worker == worker), None)
        if member is not None:
            self.forget(member, Silence, why)
        elif worker in self._silent:  # given up already, and now it is known why
            self._silent.discard(worker)
            self.events.append(Left(worker, why, 0, False))
        return member is not None

    def silence(self, now: float, timeout_s: float, listening_since_s: float = -math.inf) -> list[M]:
        """Forget who has been silent for too long, and too long in the hearing of the learner; those that were."""
        if now < self._silent_from_s:
            return []
        members = self.members.values()
        silent = [member for member in members if now - max(member.heard_s, listening_since_s) > timeout_s]
        for member in silent:
            self._silent.add(member.hello.worker)
            self.forget(member, Silence, f"silent for {timeout_s:.0f} s")
        heard_s = min((member.heard_s for member in self.members.values()), default=now)
        self._silent_from_s = max(heard_s, listening_since_s) + timeout_s
        return silent

    def forget(self, member: M, event: type, why: str) -> None:
        """It is gone."""
        member.standing = TABLE[member.standing][event]
        del self.members[member.peer]
        self.events.append(Left(member.hello.worker, why, len(member.tickets), event is Goodbye))
        self._lost(member, why)

    def drain(self, reason: str) -> list[Out]:
        """Ask everybody to leave; nobody joins any more."""
        self.draining = reason
        out: list[Out] = []
        for member in self.active():
            member.standing = TABLE[member.standing][Drain]
            out.append((member.peer, Drain(reason)))
        return out

    def _turn_out(self, member: M, event: type, why: str, told: str) -> list[Out]:
        self.events.append(Turned(member.hello.worker, told))
        self.forget(member, event, why)
        return [(member.peer, Refuse(told))]

    def _remember(self, member: M, why: str) -> None:
        """Remember that its process was refused: it must not come back."""
        self._refused.pop(member.peer, None)
        self._refused[member.peer] = (member.hello.life, why)
        if len(self._refused) > REMEMBERED_REFUSALS:
            del self._refused[next(iter(self._refused))]
