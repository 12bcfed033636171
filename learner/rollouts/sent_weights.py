"""The weights that orders name, and who holds which of them. Pure.

Rule: weights are kept while they are the newest, act in a round that is open, are evaluated, or are an opponent. They are
sent to a worker after the first order that names them, and again if its Heartbeat shows that they were lost on the way. A
worker drops none by itself: every order lists those that it is to keep, which are those that its outstanding tickets name.
So the learner knows which the worker holds, whatever is on its way between them.

Where a supervisor shares weights among its workers, it gets them once, in place of the first of its workers that needs
them. For all of these they are on the way until the supervisor's word shows that they have reached it, or are lost. From
then on a worker has as long to take them as if they had just been sent to it; what it lacks later is sent to it directly.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import msgspec

from millrace.learner.members.member import SharingSupervisor
from millrace.learner.members.membership import Outgoing
from millrace.learner.rollouts.collecting_member import CollectingMember
from millrace.protocol.alive import SHARED_VERSIONS
from millrace.protocol.messages import Collect, Evaluate, Heartbeat, Weights, versions_of


@dataclass(frozen=True)
class SentAfter:
    """They were sent, after so many heartbeat replies. Who has received a later reply has them, or they are lost."""

    replies: int


@dataclass(frozen=True)
class FromSupervisor:
    """The worker gets them from its supervisor, to which they may still be on the way."""


@dataclass(frozen=True)
class Confirmed:
    """The worker has said that it holds them."""


Standing = SentAfter | FromSupervisor | Confirmed
"""What the learner knows of some weights and a worker. It knows nothing of those that the worker lacks."""


class WeightsHeld:
    """Which weights each worker and each supervisor holds or is about to get, and which it needs. The only record of it."""

    def __init__(self) -> None:
        self.by_worker: dict[bytes, dict[int, Standing]] = {}
        """by routing id and version"""
        self.named: dict[bytes, dict[int, set[int]]] = {}
        """by routing id and ticket, the versions that the ticket names; tickets that have ended may be among them"""
        self.by_supervisor = WeakKeyDictionary[SharingSupervisor, dict[int, SentAfter]]()
        """by version, the newest last; it ends with the last member that has this supervisor"""

    def versions(self, peer: bytes) -> Set[int]:
        """The versions that this worker holds or is about to get."""
        return self.by_worker.get(peer, {}).keys()

    def give(self, member: CollectingMember, version: int, supervisor: SharingSupervisor | None) -> bytes | None:
        """The worker gets these weights, from this supervisor if there is one. Returns whom to send them; None: nobody."""
        mine = self.by_worker.setdefault(member.peer, {})
        if supervisor is None:
            mine[version] = SentAfter(member.replies)
            return member.peer
        mine[version] = FromSupervisor()
        shared = self.by_supervisor.setdefault(supervisor, {})
        if version in shared:  # rule SHARED_WEIGHTS
            return None
        shared[version] = SentAfter(supervisor.replies)
        for oldest in list(shared)[:-SHARED_VERSIONS]:
            del shared[oldest]
        return supervisor.peer

    def needs(self, member: CollectingMember, tickets: Collection[int]) -> set[int]:
        """The versions that these tickets name, those of the worker that have not ended among them."""
        named = self.named.get(member.peer, {})
        return {version for ticket in member.tickets.keys() & tickets for version in named[ticket]}

    def note(self, member: CollectingMember, order: Collect | Evaluate) -> None:
        """Note what the tickets of this order name."""
        named = self.named.get(member.peer, {})
        outstanding = {ticket: versions for ticket, versions in named.items() if ticket in member.tickets}
        self.named[member.peer] = outstanding | _by_ticket(order)

    def keep_only(self, peer: bytes, versions: Collection[int]) -> None:
        """The worker is told to drop all others."""
        mine = self.by_worker.get(peer, {})
        self.by_worker[peer] = {version: standing for version, standing in mine.items() if version in versions}

    def hear(self, member: CollectingMember, heartbeat: Heartbeat) -> None:
        """The worker lists what it holds. It lacks the rest, unless that may still be on its way."""
        mine = self.by_worker.get(member.peer, {})
        after: dict[int, Standing] = {}
        for version, standing in mine.items():
            match standing:
                case FromSupervisor():
                    under_way = self._may_be_under_way(version, member.shared_by)
                    after[version] = standing if under_way else SentAfter(member.replies)
                case SentAfter(replies) if replies >= heartbeat.replies:
                    after[version] = standing
                case _ if version in heartbeat.versions:
                    after[version] = Confirmed()
        self.by_worker[member.peer] = after

    def forget(self, peer: bytes) -> None:
        """The session of this worker has ended."""
        self.by_worker.pop(peer, None)
        self.named.pop(peer, None)

    def _may_be_under_way(self, version: int, supervisor: SharingSupervisor | None) -> bool:
        """Whether these weights may not have reached the supervisor yet. False if it shares no more."""
        if supervisor is None:
            return False
        sent = self.by_supervisor.get(supervisor, {}).get(version)
        return sent is not None and sent.replies >= supervisor.received


class SentWeights:
    """The weights of a run that workers need."""

    def __init__(self) -> None:
        self.kept: dict[int, Weights] = {}
        """by version"""
        self.held = WeightsHeld()

    def keep(self, newest: Weights, needed: Collection[int]) -> None:
        """Keep the newest weights and, of those before them, the versions that are still needed."""
        self.kept = {version: weights for version, weights in self.kept.items() if version in needed}
        self.kept[newest.version] = newest

    def after(self, orders: Sequence[Outgoing], members: Mapping[bytes, CollectingMember]) -> list[Outgoing]:
        """These orders, which list what their workers are to keep. After all of them, the weights that the workers lack."""
        out = list[Outgoing]()
        weights = list[Outgoing]()
        for peer, order in orders:
            if isinstance(order, Collect | Evaluate):
                self.held.note(members[peer], order)
        for peer, order in orders:
            if isinstance(order, Collect | Evaluate):
                member = members[peer]
                for version in sorted(order.versions - self.held.versions(peer)):
                    # Opponents differ from worker to worker, so theirs are not shared.
                    supervisor = member.shared_by if version == order.version else None
                    weights += self._send(member, version, supervisor)
                keep = self.held.needs(member, member.tickets)  # also those of the orders that follow
                self.held.keep_only(peer, keep)
                order = msgspec.structs.replace(order, keep=tuple(sorted(keep)))
            out.append((peer, order))
        return out + weights

    def again(self, member: CollectingMember, heartbeat: Heartbeat) -> list[Outgoing]:
        """The weights that the worker's unfinished tickets name and that were lost, as its heartbeat shows."""
        self.held.hear(member, heartbeat)
        lost = sorted(self.held.needs(member, heartbeat.tickets) - self.held.versions(member.peer))
        return [message for version in lost for message in self._send(member, version, None)]

    def _send(self, member: CollectingMember, version: int, supervisor: SharingSupervisor | None) -> list[Outgoing]:
        receiver = self.held.give(member, version, supervisor)
        return [] if receiver is None else [(receiver, self.kept[version])]


def _by_ticket(order: Collect | Evaluate) -> dict[int, set[int]]:
    """The versions that each ticket of an order names."""
    if isinstance(order, Evaluate):
        return {order.ticket: order.versions}
    return {permit.ticket: versions_of(order.version, [permit.opponent]) for permit in order.permits}
