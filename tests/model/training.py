"""The conversation of a training run: tickets, rollouts and weights, between a `TicketCoordinator` and `Session`s."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeVar

from millrace.learner.members.membership import Outgoing
from millrace.learner.rollouts.sent_weights import SentAfter
from millrace.protocol.messages import Collect, Evaluate, Heartbeat, Weights
from millrace.protocol.rules import Rule
from tests.model import learner_part, process_part, worker_part
from tests.model.conversation import Content, Event, Facts
from tests.model.learner_part import Learner, first_learner
from tests.model.message_content import content_of, message_of, worker_of
from tests.model.settings import TICK_S, Settings
from tests.model.worker_part import Worker

ARRIVED = -1
"""In place of the number of replies after which weights were sent: the worker has said that it holds them."""


class Training(Settings):
    """A run that has reached its target after some updates."""

    def start(self) -> tuple[Content, list[Content]]:
        learner, _ = first_learner(self, Learner)
        workers = [worker_part.saved(Worker(self, number, 0), 0.0) for number in range(self.workers)]
        return learner_part.saved(learner, 0.0), workers

    def learner(self, content: Content, event: Event, message: Content | None) -> tuple[Content, list[tuple[int, Content]]]:
        now = now_at(event)
        learner, out = learner_event(learner_part.loaded(content, self), event, message, now)
        return learner_part.saved(learner, now), [(worker_of(to), content_of(told, worker_of(to))) for to, told in out]

    def worker(self, content: Content, number: int, event: Event, message: Content | None) -> tuple[Content, list[Content]]:
        worker = worker_part.loaded(content, number, self, Worker)
        now = now_at(event)
        told = None if message is None else message_of(message, number, self.run)
        sent = [content_of(said, number) for said in worker.event(event, told, now)]
        return worker_part.saved(worker, now), sent

    def is_needed(self, worker: Content) -> bool:
        return self.workers == 1

    def without_checkpoints(self, learner: Content) -> Content:
        return learner_part.without_checkpoints(learner)

    def facts(self, content: Content) -> Facts:
        if isinstance(content[0], str):
            return Facts()
        if len(content) == 4:
            return process_part.facts(content)
        members = tuple(member[0].value for member in content[7][0])
        reached = content[2] >= self.updates
        return Facts(reached=reached, updating=content[13], checkpoints=len(content[14]), members=members)


L = TypeVar("L", bound=Learner)


def learner_event(learner: L, event: Event, message: Content | None, now: float) -> tuple[L, list[Outgoing]]:
    """The learner after this event, which may be another one, and what it sends."""
    heard = None if message is None else message_of(message, event[1], learner.settings.run)
    rule = WeightsRule(learner, heard)
    after, out = _after(learner, event, heard, now)
    rule.check(after, out)
    return after, out


class WeightsRule:
    """Rule: weights are sent after an order that names them, and again only if a Heartbeat shows that they were lost.

    Nothing is lost without faults. Then no order waits for weights that the learner takes to be held.
    """

    def __init__(self, learner: Learner, heard: Any) -> None:
        """Before an event. `heard`: the message that the learner receives, if any."""
        self._learner, self._heard = learner, heard
        self._named = {(member.session, version) for member, version in learner.named()}
        self._sent_at = {
            (member.session, version): standing.replies if isinstance(standing, SentAfter) else ARRIVED
            for peer, member in learner.coordinator.members.items()
            for version, standing in learner.coordinator.weights.held.by_worker.get(peer, {}).items()
        }

    def check(self, after: Learner, out: Iterable[Outgoing]) -> None:
        """After it, with what the learner sends."""
        named, sent_at = (self._named, self._sent_at) if after is self._learner else (set(), {})
        out = list(out)
        held = after.coordinator.weights.held
        for peer, message in out:
            if isinstance(message, Collect | Evaluate):
                assert set(message.keep) == held.versions(peer), (
                    f"{Rule.KEEP}: an order lists other weights than count as held"
                )
                versions = {message.version}
                for each in message.permits if isinstance(message, Collect) else ():
                    opponent = after.coordinator.rollouts.held[each.ticket].permit.opponent
                    assert each.opponent == opponent, f"{Rule.OPPONENT}: an order names another opponent than its ticket"
                    versions |= set() if opponent is None else {opponent}
                named |= {(message.session, version) for version in versions}
                assert versions <= held.versions(peer), f"{Rule.WEIGHTS_AFTER}: an order is sent without its weights"
            if isinstance(message, Weights):
                member = after.coordinator.members[peer]
                which = member.session, message.version
                assert which in named, f"{Rule.WEIGHTS_AFTER}: weights are sent that no order has named"
                if which in sent_at:
                    assert after.settings.faults, (
                        f"{Rule.WEIGHTS_AFTER}: an order waits for weights although nothing was lost"
                    )
                    shown = isinstance(self._heard, Heartbeat) and message.version not in self._heard.versions
                    assert shown, f"{Rule.WEIGHTS_AGAIN}: weights are sent again although they were not lost"
                    assert sent_at[which] < self._heard.replies, (
                        f"{Rule.SENT_BEFORE}: weights are sent again although they may be under way"
                    )
                standing = held.by_worker.get(peer, {}).get(message.version)
                assert isinstance(standing, SentAfter), f"{Rule.SENT_BEFORE}: weights are sent and not noted"
                assert standing.replies >= member.replies - isinstance(self._heard, Heartbeat), (
                    f"{Rule.SENT_BEFORE}: weights are sent and not noted"
                )
                sent_at[which] = standing.replies
        heard = self._heard
        for peer, member in after.coordinator.members.items():
            if isinstance(heard, Heartbeat) and member.session == heard.session:
                for version, standing in held.by_worker.get(peer, {}).items():
                    under_way = isinstance(standing, SentAfter) and standing.replies >= heard.replies
                    assert under_way or version in heard.versions, (
                        f"{Rule.WEIGHTS_AGAIN}: weights that a worker lacks count as held"
                    )


def _after(learner: L, event: Event, heard: Any, now: float) -> tuple[L, list[Outgoing]]:
    match event:
        case "receive", worker, _:
            return learner, learner.receive(worker, heard, now)
        case ("publish",):
            return learner, learner.publish()
        case ("time",):
            return learner, learner.pass_time(now)
        case "revoke", worker:
            return learner, learner.revoke(worker)
        case "ended", worker, nonce:
            return learner, learner.process_ended(worker, nonce)
        case "restart", version:
            return learner.restarted(version)
    raise AssertionError(event)


def now_at(event: Event) -> float:
    """The time of an event; each end is loaded at the time 0."""
    return TICK_S if event == ("time",) else 0.0
