"""The weights that orders name, and which workers hold them. Pure.

Rule: weights are kept while they are the newest, act in a round that is open, or are evaluated. They are sent to a worker
after the first order that names them, and again if its Heartbeat shows that they were lost on the way. A worker drops none
by itself: every order lists those that it is to keep, which are those that its outstanding tickets name. So the learner
knows which the worker holds, whatever is on its way between them.

Where a supervisor shares weights among its workers, it gets them once, in place of the first of its workers that needs
them. For all of these they are on the way until the supervisor's word shows that they have reached it, or are lost. From
then on a worker has as long to take them as if they had just been sent to it; what it lacks later is sent to it directly.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterable, Mapping

import msgspec

from millrace.learner.members.membership import Outgoing
from millrace.learner.rollouts.collecting_member import CollectingMember
from millrace.protocol.alive import SHARED_VERSIONS
from millrace.protocol.messages import Collect, Evaluate, Heartbeat, Weights

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
        """These messages; after all of them, the weights of the versions that they name and their workers do not hold."""
        out = list[Outgoing]()
        weights = list[Outgoing]()
        for peer, message in orders:
            if isinstance(message, Collect | Evaluate):
                member = members[peer]
                keep = named(members[peer].tickets)
                for version in sorted(message.versions - member.versions.keys()):
                    weights += self._sent(member, version, acts=version == message.version)
                member.versions = {version: sent_at for version, sent_at in member.versions.items() if version in keep}
                message = msgspec.structs.replace(message, keep=tuple(sorted(keep)))
            out.append((peer, message))
        return out + weights

    def _sent(self, member: CollectingMember, version: int, *, acts: bool) -> list[Outgoing]:
        """What gives the worker these weights. Opponents differ from worker to worker, so theirs are not shared."""
        supervisor = member.shared_by if acts else None
        member.versions[version] = member.replies if supervisor is None else TO_SUPERVISOR
        if supervisor is None:
            return [(member.peer, self.kept[version])]
        if version in supervisor.versions:
            return []
        last = list(supervisor.versions.items())[1 - SHARED_VERSIONS :]
        supervisor.versions = {**dict(last), version: supervisor.replies}
        return [(supervisor.peer, self.kept[version])]

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
        member.versions = held | dict.fromkeys(lost, member.replies)
        return [(member.peer, self.kept[version]) for version in lost]
