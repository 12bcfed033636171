"""The weights that orders name, and which workers hold them. Pure.

Rule: weights are kept while they are the newest, act in a round that is open, or are evaluated. They are sent to a worker
after the first order that names them, and again if its Heartbeat shows that they were lost on the way. When weights come to
a worker, it keeps the newest and those that its tickets name. It drops none when a ticket ends, because an order that is on
its way may name the same weights, and would have to wait for a Heartbeat.

Where a supervisor shares weights among its workers, it gets them once, in place of the first of its workers that needs
them. For all of these they are on the way until the supervisor's word shows that they have reached it, or are lost. From
then on a worker has as long to take them as if they had just been sent to it; what it lacks later is sent to it directly.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterable, Mapping

from learner.members.membership import Outgoing
from learner.rollouts.collecting_member import CollectingMember
from protocol.alive import SHARED_VERSIONS
from protocol.messages import Collect, Evaluate, Heartbeat, Weights

TO_SUPERVISOR = sys.maxsize  # in place of a number of replies: on the way to the supervisor, as far as is known

Named = Callable[[Collection[int]], set[int]]
"""Returns the versions that these tickets name."""


class SentWeights:
    """The weights of a run that workers need."""

    def __init__(self) -> None:
        self.kept: dict[int, Weights] = {}
        """by version"""

    def publish(self, weights: Weights, acts: Callable[[int], bool]) -> None:
        """Set the newest weights. `acts`: whether a version acts in an open round or is evaluated; others are dropped."""
        self.kept = {version: each for version, each in self.kept.items() if acts(version)}
        self.kept[weights.version] = weights

    def after(self, orders: Iterable[Outgoing], members: Mapping[bytes, CollectingMember], named: Named) -> list[Outgoing]:
        """These messages; after all of them, the weights of the versions that they name and their workers do not hold.

        When weights come, a worker drops those that no order names: so the orders come first.
        """
        orders, out = list(orders), list[Outgoing]()
        for peer, message in orders:
            member = members[peer]
            if not isinstance(message, Collect | Evaluate):
                continue
            acting = message.version
            for version in sorted(message.versions - member.versions.keys()):
                # Opponents differ from worker to worker, so their weights are not shared.
                supervisor = member.shared_by if version == acting else None
                if supervisor is None:
                    out.append((peer, self.kept[version]))
                elif version not in supervisor.versions:
                    out.append((supervisor.peer, self.kept[version]))
                    last = list(supervisor.versions.items())[1 - SHARED_VERSIONS :]
                    supervisor.versions = {**dict(last), version: supervisor.replies}
                member.versions[version] = member.replies if supervisor is None else TO_SUPERVISOR
                member.versions = _kept(member.versions, named(member.tickets))
        return orders + out

    def again(self, member: CollectingMember, heartbeat: Heartbeat, named: Named) -> list[Outgoing]:
        """Those that the worker's unfinished tickets name and that were lost on the way to it, as its heartbeat shows."""
        supervisor = member.shared_by
        for version, sent_at in member.versions.items():
            on_its_way = supervisor is not None and supervisor.versions.get(version, -1) >= supervisor.received
            if sent_at == TO_SUPERVISOR and not on_its_way:
                member.versions[version] = member.replies
        sent = member.versions.items()
        # What it does not list was dropped or lost, unless it may still be on its way.
        held = {version: at for version, at in sent if version in heartbeat.versions or at >= heartbeat.replies}
        lost = sorted(named(heartbeat.tickets) - held.keys())
        member.versions = _kept(held | dict.fromkeys(lost, member.replies), named(member.tickets)) if lost else held
        return [(member.peer, self.kept[version]) for version in lost]


def _kept(versions: Mapping[int, int], named: Collection[int]) -> dict[int, int]:
    """Of these versions, those that a worker keeps when one of them comes."""
    kept = {*named, max(versions)}
    return {version: sent_at for version, sent_at in versions.items() if version in kept}
