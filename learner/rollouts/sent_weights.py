"""The weights that orders name, and which worker holds which of them. Pure.

Rule: weights are kept while they are the newest, act in an open round, are being evaluated, or are an opponent. They are
sent to a worker after the first order that names them, and again if its Heartbeat shows that they were lost. A worker drops
weights only when told to: every order lists the versions to keep, which are those that the worker's outstanding tickets
name. The learner therefore knows which weights the worker holds, even while messages are on their way.

If a supervisor shares weights among its workers, it gets them once, in place of the first worker that needs them. For all
these workers, the weights count as being on the way until a message from the supervisor shows that they have arrived or are
lost. From then on, a worker has as much time to load them as if they had just been sent to it. If it still lacks them
afterwards, they are sent to it directly.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import msgspec

from millrace.learner.members.member import Member, SharingSupervisor
from millrace.learner.members.membership import Outgoing
from millrace.protocol.alive import SHARED_VERSIONS
from millrace.protocol.messages import Collect, Evaluate, Heartbeat, Weights


@dataclass(frozen=True)
class SentAfter:
    """The weights were sent after this many heartbeat replies.

    Once the receiver has received a later reply, it has the weights, or they are lost.
    """

    replies: int


@dataclass(frozen=True)
class FromSupervisor:
    """The worker gets the weights from its supervisor, which may not have received them yet."""


@dataclass(frozen=True)
class Confirmed:
    """The worker has confirmed that it holds the weights."""


Standing = SentAfter | FromSupervisor | Confirmed
"""What the learner knows about a worker's copy of some weights. Weights that the worker lacks have no entry."""


class WeightsHeld:
    """The only record of which weights each worker and each supervisor holds or is about to get."""

    def __init__(self) -> None:
        self.by_worker: dict[bytes, dict[int, Standing]] = {}
        """the workers' weights, by routing id and version"""
        self.by_supervisor = WeakKeyDictionary[SharingSupervisor, dict[int, SentAfter]]()
        """for each supervisor, its weights by version, the newest last; dropped with the supervisor's last member"""

    def versions(self, peer: bytes) -> Set[int]:
        """The versions that this worker holds or is about to get."""
        return self.by_worker.get(peer, {}).keys()

    def give(self, member: Member, version: int, supervisor: SharingSupervisor | None) -> bytes | None:
        """Record that the worker gets these weights, through the supervisor if one is given.

        Returns the routing id to which they must be sent; None if they needn't be sent.
        """
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

    def keep_only(self, peer: bytes, versions: Collection[int]) -> None:
        """Record that the worker was told to drop all other versions."""
        mine = self.by_worker.get(peer, {})
        self.by_worker[peer] = {version: standing for version, standing in mine.items() if version in versions}

    def hear(self, member: Member, heartbeat: Heartbeat) -> None:
        """Update the record from the worker's list of the weights that it holds.

        The worker lacks all other weights, unless they may still be on their way.
        """
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
        """Forget a worker whose session has ended."""
        self.by_worker.pop(peer, None)

    def _may_be_under_way(self, version: int, supervisor: SharingSupervisor | None) -> bool:
        """Whether these weights may still be on their way to the supervisor. False if it no longer shares weights."""
        if supervisor is None:
            return False
        sent = self.by_supervisor.get(supervisor, {}).get(version)
        return sent is not None and sent.replies >= supervisor.received


class SentWeights:
    """The weights of a run that workers need, and the messages that send them."""

    def __init__(self) -> None:
        self.kept: dict[int, Weights] = {}
        """the weights, by version"""
        self.held = WeightsHeld()

    def keep(self, newest: Weights, needed: Collection[int]) -> None:
        """Keep the newest weights and the older versions that are still needed."""
        self.kept = {version: weights for version, weights in self.kept.items() if version in needed}
        self.kept[newest.version] = newest

    def after(self, orders: Sequence[Outgoing], members: Mapping[bytes, Member]) -> list[Outgoing]:
        """These orders, each with the versions that its worker must keep, followed by the weights that the workers lack."""
        out = list[Outgoing]()
        weights = list[Outgoing]()
        for peer, order in orders:
            if isinstance(order, Collect | Evaluate):
                member = members[peer]
                for version in sorted(order.versions - self.held.versions(peer)):
                    # Opponents differ from worker to worker, so their weights are not shared.
                    supervisor = member.shared_by if version == order.version else None
                    weights += self._send(member, version, supervisor)
                keep = member.needs(member.tickets)  # including those that later orders in this list name
                self.held.keep_only(peer, keep)
                order = msgspec.structs.replace(order, keep=tuple(sorted(keep)))
            out.append((peer, order))
        return out + weights

    def again(self, member: Member, heartbeat: Heartbeat) -> list[Outgoing]:
        """The weights to send again, because this heartbeat shows that they were lost and unfinished tickets need them."""
        self.held.hear(member, heartbeat)
        lost = sorted(member.needs(heartbeat.tickets) - self.held.versions(member.peer))
        return [message for version in lost for message in self._send(member, version, None)]

    def _send(self, member: Member, version: int, supervisor: SharingSupervisor | None) -> list[Outgoing]:
        receiver = self.held.give(member, version, supervisor)
        return [] if receiver is None else [(receiver, self.kept[version])]
