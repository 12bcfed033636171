"""The learner's half of a conversation with its workers: the part that all conversations share.

It is pure: messages and `now` in, messages out.

Rule: a worker that is waiting when the run begins becomes a member of the run, in the same session. If it is describing an
environment at that time, it gets work only after it reports that it has begun the run. `Membership.hear` answers Failures
and messages that don't belong to a member's session; a subclass handles all other messages. A membership ends with a
Goodbye, a Failure, the end of the worker's process, silence, a refusal, or the revocation of the worker's key. Then the
member's tickets and lanes are taken back, and `_deal` gives them to others. If a Heartbeat shows that a message was lost,
the message is sent again before the reply.

A subclass defines the rest: how to answer messages, which work to deal, what to do when a worker is lost, and what to do
after a wrong answer.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from millrace.learner.members.events import Event, WorkerStartFailed
from millrace.learner.members.member import Member
from millrace.learner.members.membership import Answered, Membership, Outgoing
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


class Coordinator(ABC):
    """Answers members' messages, removes members, and deals work to them."""

    def __init__(self, membership: Membership, worker_timeout_s: float) -> None:
        self.membership = membership
        self.worker_timeout_s = worker_timeout_s

    @property
    def members(self) -> dict[bytes, Member]:
        """Members by routing id."""
        return self.membership.members

    @property
    def events(self) -> list[Event]:
        """Events that have not been logged yet."""
        return self.membership.events

    # ---------------------------------------------------------------- in

    def receive(self, peer: bytes, message: ToLearner, now: float) -> list[Outgoing]:
        """The answer to a message."""
        heard = self.membership.hear(peer, message, now)
        if not isinstance(heard, Answered):
            return self._answer(heard, message) + self._deal()
        self._not_of_member(message, heard)
        return heard.out + (self._deal() if heard.changed else [])

    def take_over(self, waiting: Membership, now: float) -> list[Outgoing]:
        """Begin the run for the workers that are waiting for it. Call this before anything else."""
        return self.membership.take_over(waiting, now) + self._deal()

    def reject_message(self, peer: bytes, why: str, now: float) -> list[Outgoing]:
        """The answer to a message that could not be read."""
        member = self.members.get(peer)
        if member is None:
            return [(peer, Refuse(one_line(f"not understood: {why}")))]
        member.heard_s = now
        return self._unusable(member, why) + self._deal()

    def revoke(self, peer: bytes, why: str) -> list[Outgoing]:
        """Remove a member at once, whatever work it has, because its key was revoked. Sends it the reason."""
        return self.membership.revoke(peer, why) + self._deal()

    def process_ended(self, ended: WorkerExit | StartFailed) -> list[Outgoing]:
        """Handle the end of a worker process that this program started."""
        match ended:
            case StartFailed(worker, reason, last_lines):
                self.events.append(WorkerStartFailed(worker, reason, last_lines))
                return []
            case WorkerExit():
                return self._deal() if self.membership.record_exit(ended) else []

    def remove_silent(self, now: float) -> list[Outgoing]:
        """Remove workers that have been silent for longer than `worker_timeout_s`.

        Call this only after `receive` was given every message that has arrived.
        """
        return self._deal() if self.membership.remove_silent(now, self.worker_timeout_s) else []

    def drain(self, reason: str) -> list[Outgoing]:
        """Ask every worker to leave. From now on, no work is dealt."""
        return self.membership.drain(reason)

    # ---------------------------------------------------------------- what a subclass defines

    @abstractmethod
    def _answer(self, member: Member, message: ToLearner) -> list[Outgoing]:
        """The answer to a message that a member sent in its session."""

    def _not_of_member(self, message: ToLearner, answered: Answered) -> None:  # noqa: B027  # not every subclass needs it
        """Called with each message that the membership has answered instead of this object."""

    def _deal(self) -> list[Outgoing]:
        """Deal the work that no worker holds. Called after each event that may have made a worker available."""
        return []

    def _again(self, member: Member, heartbeat: Heartbeat, lost: Sequence[int]) -> list[Outgoing]:
        """The messages to send again because this heartbeat shows that they were lost.

        `lost` has the member's tickets that were lost.
        """
        return []

    def _received(self, member: Member) -> tuple[Received, ...]:
        """The lanes of this member, and which of their rollouts have arrived."""
        return ()

    def _unusable(self, member: Member, why: str) -> list[Outgoing]:
        """Handle a member's message that could not be used."""
        return self.membership.refuse(member, why)

    # ---------------------------------------------------------------- inside

    def _heartbeat(self, member: Member, heartbeat: Heartbeat) -> list[Outgoing]:
        """Send lost messages again, then the reply."""
        lost = member.record_heartbeat(heartbeat)
        if member.draining:
            return [(member.peer, Drain(one_line(self.membership.draining or "")))]  # rule DRAIN_AGAIN
        out = self.membership.welcome_again(member, heartbeat)
        out += self._again(member, heartbeat, lost)
        member.replies += 1
        member.begins(heartbeat)
        return [*out, (member.peer, HeartbeatReply(member.session, member.replies, self._received(member)))]
