"""The conversation before a run: workers describe the environment. Pure: messages and `now` in, messages out.

Rule: the first description that can be read and is accepted is that of the run; other workers are compared with it when they
open their lanes. A worker that declines, or describes what is not accepted, is refused, and the learner waits for another;
once `decliners_to_end` different workers have been, the start ends with the reason. An environment that fails counts; its
worker may come back.
"""

from __future__ import annotations

from collections.abc import Callable

from learner.members.events import EnvironmentRaised
from learner.members.failure_count import FailureCount
from learner.members.membership import Member, Membership, Outgoing
from learner.members.states import SentUnusable
from protocol.alive import NO_SLOT
from protocol.bounds import one_line
from protocol.envs.description import DescribedEnv, read_description
from protocol.errors import BadMessage, EnvironmentFailed, UsageError, UserFacingError
from protocol.messages import (
    TOLD_TO_STOP,
    Alive,
    Described,
    Failure,
    Goodbye,
    Heartbeat,
    HeartbeatReply,
    Hello,
    Refuse,
    Rejoin,
    Status,
    ToLearner,
    WorkerExit,
)
from protocol.specs import DescribeSpec

Accept = Callable[[DescribedEnv], None]
"""Raises `UsageError` if the run cannot be made with this environment."""


def accept_any(env: DescribedEnv) -> None:
    """Accept every environment."""


class DescribeCoordinator:
    """Members that describe the environment, until one has done so."""

    def __init__(
        self,
        spec: DescribeSpec,
        first_session: int,
        *,
        worker_timeout_s: float,
        max_env_failures: int,
        decliners_to_end: int,
        accept: Accept = accept_any,
    ) -> None:
        """`decliners_to_end`: how many different workers must be unable to describe it until the start ends; 0: never."""
        self.spec = spec
        self.described: DescribedEnv | None = None
        """What the first usable description says."""
        self.failure: UserFacingError | None = None
        """Why the start cannot go on."""
        self.membership: Membership[Member] = Membership(spec, Member, lambda member, why: None, first_session)
        self._worker_timeout_s, self._failures = worker_timeout_s, FailureCount(max_env_failures)
        self._decliners_to_end, self._accept = decliners_to_end, accept
        self._decliners: set[str] = set()

    def receive(self, peer: bytes, message: ToLearner, now: float) -> list[Outgoing]:
        """Answer a message."""
        if isinstance(message, Hello):
            return self.membership.join(peer, message, now)[0]
        if isinstance(message, Alive):
            answer, exits = self.membership.hear_supervisor(peer, message, now)
            for worker_exit in exits:
                self._count_exit(worker_exit)
            return answer
        member = self.membership.member_of_session(peer, message, now)
        if member is None:
            return self.membership.answer_ended_session(peer, message)
        match message:
            case Described(_, description) if self.described is None:
                try:
                    described = read_description(description)
                except BadMessage as error:
                    return self.membership.refuse(member, SentUnusable, f"its description of the environment: {error}")
                try:
                    self._accept(described)
                except UsageError as error:
                    return self._unsuitable(member, Described, str(error))
                self.described = described
            case Heartbeat():
                member.record_heartbeat(message)
                member.replies += 1
                return [(peer, HeartbeatReply(member.session, member.replies, ()))]
            case Goodbye(_, reason):
                return self._goodbye(member, reason)
            case Failure(_, error, traceback, lane):
                failed = member.failed(EnvironmentRaised, error, traceback, lane=lane)
                self.membership.events.append(failed)
                self.membership.remove(member, Failure, "failed")
                self._count_failure(failed.worker, f" ({failed.host}): {error}", failed.traceback)
        return []

    def reject_message(self, peer: bytes, why: str, now: float) -> list[Outgoing]:
        """A message that could not be read, such as a description that exceeds the bounds: its sender is refused."""
        member = self.membership.members.get(peer)
        if member is None:
            return [(peer, Refuse(one_line(f"not understood: {why}")))]
        return self.membership.refuse(member, SentUnusable, why)

    def revoke(self, peer: bytes, why: str) -> list[Outgoing]:
        """A member's key was revoked: send it the reason and remove it."""
        return self.membership.revoke(peer, why)

    def process_ended(self, worker_exit: WorkerExit) -> list[Outgoing]:
        """A worker's process has ended. If it was to describe the environment, the environment ended it."""
        if self.membership.record_exit(worker_exit):
            self._count_exit(worker_exit)
        return []

    def remove_silent(self, now: float) -> list[Outgoing]:
        """Remove workers that were silent for longer than `worker_timeout_s`."""
        self.membership.remove_silent(now, self._worker_timeout_s)
        return []

    def finish(self) -> list[Outgoing]:
        """The next conversation begins: every member says Hello again."""
        return [(peer, Rejoin(member.session)) for peer, member in self.membership.members.items()]

    def status(self, total_steps: int, now: float) -> Status:
        """The answer to `millrace status`. There are no weights yet, and no ledger."""
        return Status(self.spec.env.id, self.membership.status(now), total_steps=total_steps)

    def _goodbye(self, member: Member, reason: str) -> list[Outgoing]:
        if reason == TOLD_TO_STOP or reason.startswith(NO_SLOT) or self.described is not None:
            self.membership.remove(member, Goodbye, f"left: {reason}")
            return []
        return self._unsuitable(member, Goodbye, reason)

    def _unsuitable(self, member: Member, event: type, reason: str) -> list[Outgoing]:
        """The run cannot be made with this worker's environment."""
        refusal = self.membership.refuse(member, event, reason)
        if self._decliners_to_end:
            self._decliners.add(member.hello.worker)
            if len(self._decliners) >= self._decliners_to_end:
                self.membership.take_events()  # the reason is the error's text, and need not be logged too
                self.failure = self.failure or UsageError(reason)
        return refusal

    def _count_exit(self, worker_exit: WorkerExit) -> None:
        if worker_exit.failed:
            self._count_failure(worker_exit.worker, f" {worker_exit.reason}", "")

    def _count_failure(self, worker: str, what: str, detail: str) -> None:
        why = self._failures.failed((worker,), False, 0.0)
        if why and self.failure is None and self.described is None:
            self.failure = EnvironmentFailed(f"worker {worker}{what}; {why}", detail)
