"""The server of members, over a link and a clock that are not real: silent workers are removed only after listening."""

from __future__ import annotations

from typing import cast

import pytest

from learner.members.member_server import AWAY_S, MemberServer, ServerCallbacks, ServerSettings
from learner.members.process_callbacks import ProcessCallbacks
from learner.vector_env.order_coordinator import OrderCoordinator
from learner.vector_env.step_hub import StepHub
from learner.vector_env.vector_env_status import status
from protocol.alive import WorkerActivity, WorkerExit
from protocol.errors import NoWorkers
from protocol.messages import PROTOCOL_VERSION, Goodbye, Heartbeat, Hello
from protocol.wire.learner_link import LearnerLink
from tests.learner.vector_env.test_order_coordinator import SPEC
from tests.support.conversation.fake_link import FakeLink
from tests.support.in_process.local_workers import NO_LOCAL_WORKERS

TIMEOUT_S, POLL_S = 5.0, 0.1


class Served:
    """A server with one member, and the workers whose processes have ended."""

    def __init__(self, settings: ServerSettings | None = None) -> None:
        self.link = FakeLink()
        self.ended: list[WorkerExit] = []
        self.running: list[WorkerActivity] = []
        self.coordinator = OrderCoordinator(SPEC, 1, TIMEOUT_S)
        callbacks = ServerCallbacks(self.coordinator.receive, lambda now: status(self.coordinator, now), lambda event: None)
        link = cast(LearnerLink, self.link)
        processes = ProcessCallbacks(self._ended, lambda: self.running)
        self.server = MemberServer(link, self.coordinator, callbacks, processes, settings, lambda: self.link.now)
        self.link.inbox.append((b"w0", Hello(PROTOCOL_VERSION, "w0", "host", 1, 1, "fake", 1)))
        self.server.listen(POLL_S)

    def _ended(self) -> list[WorkerExit]:
        ended, self.ended = self.ended, []
        return ended

    def listens_for(self, seconds: float) -> bool:
        """Whether the worker, which says nothing, is still a member afterwards."""
        until_s = self.link.now + seconds
        while self.link.now < until_s - POLL_S / 2:
            self.server.listen(POLL_S)
        return bool(self.coordinator.members)


def test_a_silent_worker_is_removed_while_the_server_listens() -> None:
    served = Served()
    assert served.listens_for(TIMEOUT_S)
    assert not served.listens_for(2 * POLL_S)


@pytest.mark.parametrize("grace_s", [AWAY_S, TIMEOUT_S])
def test_after_it_was_away_a_worker_has_the_grace_to_be_heard(grace_s: float) -> None:
    served = Served(ServerSettings(grace_s=grace_s))
    served.link.now += 1000.0
    assert served.listens_for(grace_s)
    assert not served.listens_for(2 * POLL_S)


def test_a_learner_that_was_stopped_while_it_waited_was_away_too() -> None:
    served = Served(ServerSettings(grace_s=TIMEOUT_S))
    waiting = served.link.poll

    def stopped(timeout_s: float) -> bool:
        served.link.now += 1000.0
        return waiting(timeout_s)

    served.link.poll = stopped  # type: ignore[method-assign]
    served.server.listen(POLL_S)
    served.link.poll = waiting  # type: ignore[method-assign]
    assert served.listens_for(TIMEOUT_S - 2 * POLL_S)


def test_a_vector_environments_worker_has_its_whole_timeout_to_be_heard() -> None:
    link = FakeLink()
    hub = StepHub(
        cast(LearnerLink, link),
        SPEC,
        first_session=1,
        local_workers=NO_LOCAL_WORKERS,
        worker_timeout_s=TIMEOUT_S,
        clock=lambda: link.now,
    )
    link.inbox.append((b"w0", Hello(PROTOCOL_VERSION, "w0", "host", 1, 1, "fake", 1)))
    hub.wait_for(1, TIMEOUT_S)
    link.now += 1000.0
    with pytest.raises(NoWorkers):
        hub.wait_for(2, TIMEOUT_S)
    assert len(hub.coordinator.members) == 1
    with pytest.raises(NoWorkers):
        hub.wait_for(2, POLL_S)
    assert len(hub.coordinator.members) == 0


def test_the_last_messages_of_a_process_that_has_ended_are_received() -> None:
    served = Served()
    served.ended.append(WorkerExit("w0", 1, "was killed", failed=True))
    waiting = served.link.poll

    def comes_late(timeout_s: float) -> bool:
        if not served.ended:
            served.link.inbox.append((b"w0", Goodbye(1, "told to stop", ())))
        return waiting(timeout_s)

    served.link.poll = comes_late  # type: ignore[method-assign]
    served.server.listen(POLL_S)
    assert not served.coordinator.members
    assert "(the last one left: told to stop)" in str(served.server.no_workers(1, 1.0))


def test_whoever_waits_for_workers_is_told_how_many_came_and_how_to_start_one() -> None:
    served = Served()
    with pytest.raises(NoWorkers, match="waited 1 s for 2 workers at fake, 1 joined; start one: millrace worker fake"):
        served.server.wait_for(2, 1.0, lambda: served.server.listen(POLL_S))
    served.link.inbox.append((b"w0", Heartbeat(1, 0, (), (), 0, {}, 0)))
    served.server.wait_for(1, 1.0, lambda: served.server.listen(POLL_S))
