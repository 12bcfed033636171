"""The conversation before a run: workers describe the environment. Pure: messages and `now` in, messages out.

Rule: the first description that can be read and is accepted is that of the run; other workers are compared with it when they
open their lanes. A worker that declines, or describes what is not accepted, is refused, and the learner waits for another;
once `decliners_to_end` different workers have been, the start ends with the reason. A worker whose environment fails may
come back.
"""

from __future__ import annotations

from collections.abc import Callable

from millrace.learner.members.coordinator import Coordinator
from millrace.learner.members.membership import Member, Membership, Outgoing
from millrace.protocol.alive import NO_SLOT
from millrace.protocol.envs.description import DescribedEnv, read_description
from millrace.protocol.errors import BadMessage, UsageError
from millrace.protocol.messages import (
    TOLD_TO_STOP,
    Described,
    Goodbye,
    Rejoin,
    Status,
    ToLearner,
)
from millrace.protocol.progress import RunProgress
from millrace.protocol.specs import DescribeSpec

Accept = Callable[[DescribedEnv], None]
"""Raises `UsageError` if the run cannot be made with this environment."""


def accept_any(env: DescribedEnv) -> None:
    """Accept every environment."""


class DescribeCoordinator(Coordinator[Member]):
    """Members that describe the environment, until one has done so."""

    def __init__(
        self,
        spec: DescribeSpec,
        first_session: int,
        *,
        worker_timeout_s: float,
        decliners_to_end: int,
        accept: Accept = accept_any,
    ) -> None:
        """`decliners_to_end`: how many different workers must be unable to describe it until the start ends; 0: never."""
        super().__init__(Membership(spec, Member, lambda member, why: None, first_session), worker_timeout_s)
        self.spec = spec
        self.described: DescribedEnv | None = None
        """What the first usable description says."""
        self.unsuitable: UsageError | None = None
        """Why the start cannot go on: too many workers declined."""
        self._decliners_to_end, self._accept = decliners_to_end, accept
        self._decliners: set[str] = set()

    def finish(self) -> list[Outgoing]:
        """The next conversation begins: every member says Hello again."""
        return [(peer, Rejoin(member.session)) for peer, member in self.membership.members.items()]

    def status(self, total_steps: int, now: float) -> Status:
        """The answer to `millrace status`. There are no weights yet, and no ledger."""
        return Status(self.spec.env.id, RunProgress(total_steps=total_steps), self.membership.status(now))

    # ---------------------------------------------------------------- inside

    def _answer(self, member: Member, message: ToLearner) -> list[Outgoing]:
        if not isinstance(message, Described) or self.described is not None:
            return []
        try:
            described = read_description(message.description)
            self._accept(described)
        except BadMessage as error:
            return self._unsuitable(member, Described, f"its description of the environment: {error}")
        except UsageError as error:
            return self._unsuitable(member, Described, str(error))
        self.described = described
        return []

    def _goodbye(self, member: Member, reason: str) -> list[Outgoing]:
        if reason == TOLD_TO_STOP or reason.startswith(NO_SLOT) or self.described is not None:
            return super()._goodbye(member, reason)
        return self._unsuitable(member, Goodbye, reason)

    def _unsuitable(self, member: Member, event: type, reason: str) -> list[Outgoing]:
        """The run cannot be made with this worker's environment."""
        refusal = self.membership.refuse(member, event, reason)
        if self._decliners_to_end:
            self._decliners.add(member.hello.worker)
            if len(self._decliners) >= self._decliners_to_end:
                self.membership.take_events()  # the reason is the error's text, and need not be logged too
                self.unsuitable = UsageError(reason)
        return refusal
