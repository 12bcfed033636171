"""The conversation before a run: workers wait, and describe environments. Pure: messages and `now` in, messages out.

Rule: the worker that joined first describes the environment; the others wait. A worker that has not answered an order is the
last to be asked about the next environment, because it may be hanging. Each time a worker is lost after it was asked, or no
answer arrives for a long time, the number of workers asked at once doubles. One bad machine therefore delays the start by
only one attempt, and an environment that fails everywhere is discovered after a few attempts.

Rule: the run uses the first description that can be read and is accepted; other workers compare their env copies with it
when they open lanes. A worker that declines, or whose description is not accepted, is refused. Once `decliners_to_end`
different workers have been refused, the start fails with the reason. A worker whose environment fails may come back. If a
worker that was not asked fails or declines, this doesn't count.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from millrace.learner.members.coordinator import Coordinator
from millrace.learner.members.member import Member, SentTicket
from millrace.learner.members.membership import MAX_MEMBERS, Gone, Membership, Outgoing
from millrace.protocol.alive import NO_SLOT
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.description import DescribedEnv, read_description
from millrace.protocol.errors import BadMessage, UsageError
from millrace.protocol.messages import TOLD_TO_STOP, Describe, Described, Goodbye, Heartbeat, Status, ToLearner
from millrace.protocol.progress import RunProgress
from millrace.protocol.specs import WaitSpec

# Far above a run's ticket numbers, because a worker may still be describing the environment when the run begins.
FIRST_TICKET = 1 << 51

Accept = Callable[[DescribedEnv], None]
"""A check that raises `UsageError` if the run cannot be made with this environment."""


def accept_any(env: DescribedEnv) -> None:
    """Accept every environment."""


@dataclass(frozen=True)
class Unknown:
    """An environment for a worker to describe."""

    env: EnvSpec
    vector: str = "loop"
    """The kind of env copies. Copies of this kind must have the same spaces as a single copy."""
    render_mode: str | None = None
    accept: Accept = accept_any


class DescribeCoordinator(Coordinator):
    """The members waiting for the run, one of which describes the environment."""

    def __init__(self, wait: WaitSpec, first_session: int, *, worker_timeout_s: float, decliners_to_end: int) -> None:
        """The start fails once `decliners_to_end` different workers cannot describe the environment; 0 means never."""
        super().__init__(Membership(wait, self._removed, first_session, _was_not_asked), worker_timeout_s)
        self.described: DescribedEnv | None = None
        """The first usable description of the newest environment."""
        self.unsuitable: UsageError | None = None
        """Why the start cannot continue: too many workers declined."""
        self._unknown: Unknown | None = None
        self._at_once = 1  # how many workers may describe at the same time
        self._tickets = FIRST_TICKET
        self._decliners_to_end = decliners_to_end
        self._decliners: set[str] = set()

    def ask(self, unknown: Unknown) -> list[Outgoing]:
        """Have a worker describe this environment. The description is then in `described`, until the next call."""
        self.described = None
        self._unknown = unknown
        self._at_once = 1
        self._tickets += 1
        return self._deal()

    def ask_more(self) -> list[Outgoing]:
        """Have more workers describe the environment, because no description has arrived for a long time."""
        self._double()
        return self._deal()

    def status(self, progress: RunProgress, now: float) -> Status:
        """The answer to `millrace status`. There are no weights yet, and no ledger."""
        env = "" if self._unknown is None else self._unknown.env.id
        return Status(env, progress, self.membership.status(now))

    # ---------------------------------------------------------------- inside

    def _removed(self, member: Member, gone: Gone) -> None:
        if self._tickets in member.tickets:
            self._double()

    def _double(self) -> None:
        self._at_once = min(2 * self._at_once, MAX_MEMBERS)

    def _deal(self) -> list[Outgoing]:
        if self._unknown is None or self.described is not None:
            return []
        asked = [member for member in self.membership.active() if self._tickets in member.tickets]
        others = [member for member in self.membership.active() if self._tickets not in member.tickets]
        others.sort(key=_free_first)
        return [self._order(member) for member in others[: max(0, self._at_once - len(asked))]]

    def _order(self, member: Member) -> Outgoing:
        unknown = self._unknown
        assert unknown is not None
        member.tickets[self._tickets] = SentTicket(member.replies)
        return member.peer, Describe(member.session, self._tickets, unknown.env, unknown.vector, unknown.render_mode)

    def _again(self, member: Member, heartbeat: Heartbeat, lost: Sequence[int]) -> list[Outgoing]:
        for ticket in lost:
            del member.tickets[ticket]  # so that `_deal` orders the description again
        return self._deal()

    def _answer(self, member: Member, message: ToLearner) -> list[Outgoing]:
        match message:
            case Heartbeat():
                return self._heartbeat(member, message)
            case Described():
                return self._take_description(member, message)
            case Goodbye(_, reason):
                return self._goodbye(member, reason)
        return []

    def _take_description(self, member: Member, message: Described) -> list[Outgoing]:
        if member.tickets.pop(message.ticket, None) is None:
            return []  # this answer has arrived before
        if message.ticket != self._tickets:
            return []  # it describes an earlier environment
        if self.described is not None or self._unknown is None:
            return []
        try:
            described = read_description(message.description)
            self._unknown.accept(described)
        except BadMessage as error:
            return self._unsuitable(member, f"its description of the environment: {error}")
        except UsageError as error:
            return self._unsuitable(member, str(error))
        self.described = described
        return []

    def _goodbye(self, member: Member, reason: str) -> list[Outgoing]:
        must_leave = reason == TOLD_TO_STOP or reason.startswith(NO_SLOT)
        if must_leave or self.described is not None or _was_not_asked(member):
            self.membership.leave(member, reason)
            return []
        return self._unsuitable(member, reason)

    def _unsuitable(self, member: Member, reason: str) -> list[Outgoing]:
        """Refuse a worker whose environment the run cannot use."""
        refusal = self.membership.refuse(member, reason)
        if self._decliners_to_end:
            self._decliners.add(member.hello.worker)
            if len(self._decliners) >= self._decliners_to_end:
                self.membership.take_events()  # the error contains the reason, so it need not be logged
                self.unsuitable = UsageError(reason)
        return refusal


def _was_not_asked(member: Member) -> bool:
    return not member.tickets


def _free_first(member: Member) -> tuple[bool, bool, int]:
    """Sort key for the workers that may be asked. Those that aren't busy with an earlier order come first.

    Among these, the worker that will get the first lane comes first, because it can keep using the copy that it describes.
    """
    return bool(member.tickets), member.hello.evaluates, member.join_number
