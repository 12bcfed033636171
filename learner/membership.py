"""Who is a member: joining, sessions, names, refusals, leaving. Pure: messages and `now` in, messages out.

The law: one process has one session at a time. A repeated Hello is answered by the same Welcome; a new beginning, or another
process under the same name, ends the session before it. Whoever was refused stays refused.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from learner.events import Event, Joined, Left, Turned
from learner.standing import TABLE, Silence, Standing
from protocol.address import name_of
from protocol.messages import PROTOCOL_VERSION, Drain, Goodbye, Heartbeat, Hello, Refuse, ToWorker, Welcome
from protocol.specs import RunSpec, StepSpec

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
    acknowledged: int = -1
    under_way: int | None = None  # version of the Weights sent and not acknowledged
    said_at: int = 0  # replies said when it was sent
    strikes: int = 0
    heartbeat: Heartbeat | None = None
    steps_per_s: float = 0.0
    counted: tuple[int, float] = (0, 0.0)  # env steps that its last measured account told of, and when


class Membership:
    """The members, by their routing ids."""

    def __init__(self, run: RunSpec | StepSpec, first_session: int, lost: Callable[[Member, str], None]) -> None:
        """`lost` is called when a member is forgotten: it takes back what that one held."""
        self.members: dict[bytes, Member] = {}
        self.events: list[Event] = []
        self.draining: str | None = None
        self._run = run
        self._lost = lost
        self._next_session = first_session
        self._joins = 0
        self._refused: dict[bytes, tuple[int, str]] = {}  # the life that was refused, and why

    def active(self) -> list[Member]:
        """Those that are given work, in the order in which they joined."""
        return [member for member in self.members.values() if member.standing is Standing.ACTIVE]

    def hello(self, peer: bytes, hello: Hello, now: float) -> tuple[list[Out], Member | None]:
        """What is answered, and the member that has joined by it, if one has."""
        why = ""
        if hello.protocol != PROTOCOL_VERSION:
            why = f"protocol expected {PROTOCOL_VERSION}, got {hello.protocol}; install the learner's version of millrace"
        elif hello.worker.encode() != name_of(peer):
            why = f"name expected {name_of(peer)[:40]!r}, as in its routing id, got {hello.worker[:40]!r}"
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
        member = Member(peer, hello, self._next_session, self._joins, now)
        self._next_session += 1
        self._joins += 1
        self.members[peer] = member
        self.events.append(Joined(hello.worker, hello.host, hello.pid))
        return [(peer, Welcome(member.session, hello.attempt, self._run))], member

    def refuse(self, member: Member, event: type, why: str) -> list[Out]:
        """Turn a member out for good."""
        self._remember(member, why)
        self.events.append(Turned(member.hello.worker, why))
        self.forget(member, event, f"refused: {why}")
        return [(member.peer, Refuse(why))]

    def _remember(self, member: Member, why: str) -> None:
        """Remember that its process was refused: it must not come back."""
        self._refused.pop(member.peer, None)
        self._refused[member.peer] = (member.hello.life, why)
        if len(self._refused) > REMEMBERED_REFUSALS:
            del self._refused[next(iter(self._refused))]

    def forget(self, member: Member, event: type, why: str) -> None:
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
