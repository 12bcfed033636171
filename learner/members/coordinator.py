"""The learner's half of every conversation, as far as all are alike. Pure: messages and `now` in, messages out.

Rule: who waits for the run when it begins is a member from then on, in the same session. If it describes an environment at
that time, it is given work once it says that it has begun the run. What is not sent in a member's session is answered by the
membership (`Membership.hear`), and so is a Failure; the rest goes to the part that knows what it means. A membership ends by
Goodbye, by Failure, by the end of the process, by silence, by a refusal, or with its key. Then what the member held is taken
back, and `_deal` gives it to others. What a Heartbeat shows to be lost on the way is sent again, before the reply.

A subclass says what differs: what messages mean, what is dealt, what a loss means, and what becomes of a wrong answer.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Generic

from millrace.learner.members.events import Event, WorkerStartFailed
from millrace.learner.members.member import Member
from millrace.learner.members.member_states import MemberState, SentUnusable
from millrace.learner.members.membership import Answered, M, Membership, Outgoing
from millrace.protocol.alive import StartFailed
from millrace.protocol.bounds import one_line
from millrace.protocol.messages import (
    Drain,
    Heartbeat,
    HeartbeatReply,
    Received,
    Refuse,
    ToLearner,
    WorkerExit,
)


class Coordinator(ABC, Generic[M]):
    """The members, and what they are answered."""

    def __init__(self, membership: Membership[M], worker_timeout_s: float) -> None:
        self.membership = membership
        self.worker_timeout_s = worker_timeout_s

    @property
    def members(self) -> dict[bytes, M]:
        """Members by routing id."""
        return self.membership.members

    @property
    def events(self) -> list[Event]:
        """Events that were not logged yet."""
        return self.membership.events

    # ---------------------------------------------------------------- in

    def receive(self, peer: bytes, message: ToLearner, now: float) -> list[Outgoing]:
        """Answer a message."""
        heard = self.membership.hear(peer, message, now)
        if not isinstance(heard, Answered):
            return self._answer(heard, message) + self._deal()
        self._not_of_member(message, heard)
        return heard.out + (self._deal() if heard.changed else [])

    def take_over(self, waiting: Membership[Member], now: float) -> list[Outgoing]:
        """The run begins for the workers that wait for it. Call it first."""
        return self.membership.take_over(waiting, now) + self._deal()

    def reject_message(self, peer: bytes, why: str, now: float) -> list[Outgoing]:
        """Answer a message that could not be read."""
        member = self.members.get(peer)
        if member is None:
            return [(peer, Refuse(one_line(f"not understood: {why}")))]
        member.heard_s = now
        return self._unusable(member, why) + self._deal()

    def revoke(self, peer: bytes, why: str) -> list[Outgoing]:
        """A member's key was revoked: send it the reason and remove it at once, whatever it holds."""
        return self.membership.revoke(peer, why) + self._deal()

    def process_ended(self, ended: WorkerExit | StartFailed) -> list[Outgoing]:
        """A process of this program has ended."""
        match ended:
            case StartFailed(worker, reason, last_lines):
                self.events.append(WorkerStartFailed(worker, reason, last_lines))
                return []
            case WorkerExit():
                return self._deal() if self.membership.record_exit(ended) else []

    def remove_silent(self, now: float) -> list[Outgoing]:
        """Remove workers that were silent for longer than `worker_timeout_s`.

        Call it only when every message that has arrived was given to `receive`.
        """
        return self._deal() if self.membership.remove_silent(now, self.worker_timeout_s) else []

    def drain(self, reason: str) -> list[Outgoing]:
        """Ask every worker to leave; nothing is dealt any more."""
        return self.membership.drain(reason)

    # ---------------------------------------------------------------- what differs

    @abstractmethod
    def _answer(self, member: M, message: ToLearner) -> list[Outgoing]:
        """The answer to what a member sent in its session."""

    def _not_of_member(self, message: ToLearner, answered: Answered) -> None:
        """Learn from a message that the membership has answered."""

    def _deal(self) -> list[Outgoing]:
        """Give out what no worker has. Called after each event that may have changed who can take it."""
        return []

    def _again(self, member: M, heartbeat: Heartbeat, lost: Sequence[int]) -> list[Outgoing]:
        """What this heartbeat shows to be lost on the way. `lost`: among the tickets that the member holds."""
        return []

    def _received(self, member: M) -> tuple[Received, ...]:
        """The lanes of this member, and what has come of them."""
        return ()

    def _unusable(self, member: M, why: str) -> list[Outgoing]:
        """A member sent what could not be used."""
        return self.membership.refuse(member, SentUnusable, why)

    # ---------------------------------------------------------------- inside

    def _heartbeat(self, member: M, heartbeat: Heartbeat) -> list[Outgoing]:
        """What was lost on the way, then the reply."""
        lost = member.record_heartbeat(heartbeat)
        if member.state is MemberState.DRAINING:
            return [(member.peer, Drain(one_line(self.membership.draining or "")))]  # rule DRAIN_AGAIN
        out = self.membership.welcome_again(member, heartbeat)
        out += self._again(member, heartbeat, lost)
        member.replies += 1
        member.begins(heartbeat)
        return [*out, (member.peer, HeartbeatReply(member.session, member.replies, self._received(member)))]
