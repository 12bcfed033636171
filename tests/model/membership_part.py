"""The members of a learner's coordinator, to tuples and back: what is the same whatever their work is."""

from __future__ import annotations

from millrace.learner.members.member import Member, SentTicket
from millrace.learner.members.membership import Membership
from millrace.learner.rollouts.evaluation_dealer import FIRST_TICKET
from tests.model.conversation import Content
from tests.model.message_content import hello, peer_of, session, ticket, worker_of
from tests.model.names import Kind, Name, name
from tests.model.settings import TIMEOUT_S


def saved(membership: Membership, now: float) -> Content:
    """The members in the order in which they joined, the next session, and who is not to be given up or let in."""
    membership.events.clear()
    return (
        tuple(_member(member, now) for member in sorted(membership.members.values(), key=lambda each: each.join_number)),
        session(membership._next_session),
        max(0.0, membership._none_silent_before_s - now),
        tuple(sorted(name(Kind.NONCE, nonce, worker_of(peer)) for peer, (nonce, _) in membership._refused.items())),
    )


def _member(member: Member, now: float) -> Content:
    worker = worker_of(member.peer)

    def replies(count: int) -> Name:
        return name(Kind.REPLIES, count, member.session)

    return (
        name(Kind.WORKER, worker),
        name(Kind.NONCE, member.hello.process_nonce, worker),
        name(Kind.ATTEMPT, member.hello.attempt, worker),
        member.hello.evaluates,
        session(member.session),
        max(member.heard_s - now, -TIMEOUT_S - 1.0),
        tuple(sorted(member.lanes)),
        tuple((ticket(number), replies(sent.replies)) for number, sent in member.tickets.items() if number < FIRST_TICKET),
        replies(member.replies),
        replies(member.welcomed),
        member.takeovers,
        member.describes,
        member.strikes,
    )


def load(membership: Membership, content: Content) -> None:
    """Give a new membership this content."""
    members, _, none_silent, refused = content
    for join_number, fields in enumerate(members):
        worker, nonce, attempt, evaluates, number, heard, lanes, tickets, *more = fields
        replies, welcomed, takeovers, describes, strikes = more
        said = hello(worker.value, nonce.value, attempt.value, evaluates=evaluates)
        member = Member(peer_of(worker.value), said, number.value, join_number, heard)
        member.lanes = set(lanes)
        member.describes = describes
        member.tickets = {each.value: SentTicket(sent_at.value) for each, sent_at in tickets}
        member.replies, member.welcomed, member.takeovers = replies.value, welcomed.value, takeovers
        member.strikes = strikes
        membership.members[member.peer] = member
        membership._of_process[said.worker, said.process_nonce] = member
    membership._joins, membership._none_silent_before_s = len(members), none_silent
    membership._refused = {peer_of(nonce.scope): (nonce.value, "refused") for nonce in refused}
