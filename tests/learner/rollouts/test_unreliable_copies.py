"""A hub and sixteen workers of one copy each, whose simulators crash: which runs go on. Time is simulated."""

from __future__ import annotations

from typing import cast

import pytest

from millrace.learner.rollouts.hub import Hub, HubSettings
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.protocol.alive import Alive, WorkerExit
from millrace.protocol.errors import EnvironmentFailed
from millrace.protocol.messages import Heartbeat, Hello, ToLearner
from millrace.protocol.wire.learner_link import LearnerLink
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import BUFFERS, PARAMETERS, fake_rollout, run_spec
from tests.support.conversation.fake_link import FakeLink

COPIES = 16
HOUR_S = 3600.0


class Unreliable:
    """The run. Every worker collects, or crashes and is started again."""

    def __init__(self) -> None:
        self.link = FakeLink()
        self.coordinator = TicketCoordinator(
            run_spec(COPIES), RolloutDealer(COPIES, Rounds(0)), worker_timeout_s=1e9, first_session=1
        )
        link, settings = cast(LearnerLink, self.link), HubSettings(1e9, 1e9, max_env_failures=3)
        self.hub = Hub(link, self.coordinator, settings, clock=lambda: self.link.now)
        self.processes = 0
        for worker in range(COPIES):
            self.starts(worker)
        self.publishes()

    def publishes(self) -> None:
        self.hub.publish(self.coordinator.version + 1, PARAMETERS, BUFFERS)

    def hears(self, peer: bytes, message: ToLearner) -> None:
        self.link.inbox.append((peer, message))
        while self.link.inbox:
            self.link.now += 0.01
            self.hub.pulse()

    def starts(self, worker: int) -> None:
        self.processes += 1
        hello = example(Hello, worker=f"w{worker}", process_nonce=self.processes, attempt=self.processes)
        self.hears(f"w{worker}".encode(), hello)

    def crashes(self, worker: int, *, after_steps: bool) -> None:
        """The process of this worker dies. It is started again."""
        member = self.coordinator.members[f"w{worker}".encode()]
        if after_steps:
            self.hears(
                member.peer,
                example(Heartbeat, session=member.session, versions=(0,), tickets=tuple(member.tickets), steps=9),
            )
        why = "was killed by SIGSEGV in a reset of its environment"
        exits = (WorkerExit(member.hello.worker, member.hello.process_nonce, why, failed=True),)
        self.hears(b"supervisor", Alive((), exits))
        self.starts(worker)

    def updates(self, seconds: float) -> None:
        """Every lane collects, and an update is made of it. Raises what ends the run."""
        self.link.now += seconds
        for number, ticket in list(self.coordinator.rollouts.held.items()):
            session, permit = self.coordinator.members[ticket.peer].session, ticket.permit
            self.hears(ticket.peer, fake_rollout(session, permit.lane, number, ticket.version, permit.sequence))
        self.hub.gather()
        self.publishes()


def test_a_run_in_which_each_copy_crashes_once_in_two_hours_goes_on() -> None:
    run = Unreliable()
    for turn in range(20 * COPIES):  # 40 hours
        run.crashes(turn % COPIES, after_steps=True)
        run.updates(2 * HOUR_S / COPIES)
    assert run.coordinator.rollouts.ledger.used == 20 * COPIES * COPIES


def test_a_run_in_which_a_copy_crashes_before_its_first_step_ends_at_the_fourth_crash() -> None:
    run = Unreliable()
    lane = next(iter(run.coordinator.members[b"w5"].lanes))
    for _ in range(3):
        run.crashes(owner(run, lane), after_steps=False)
        run.hub._turn(0.0)
    for _ in range(2):  # a fifth, before the hub is asked, is not in the error
        run.crashes(owner(run, lane), after_steps=False)
    with pytest.raises(EnvironmentFailed, match="killed by SIGSEGV in a reset of its environment; failure 4 in a row; "):
        run.hub._turn(0.0)


def owner(run: Unreliable, lane: int) -> int:
    """Number of the worker that has the lane: after each crash another one."""
    peer = run.coordinator.rollouts.lanes[lane].owner
    assert peer is not None
    return int(peer.decode().removeprefix("w"))
