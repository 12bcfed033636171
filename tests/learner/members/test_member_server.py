"""The server of members, over a link and a clock that are not real: silent workers are removed only after listening."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import cast

import msgspec
import numpy as np
import pytest

from millrace.learner.members.describe_coordinator import DescribeCoordinator, Unknown
from millrace.learner.members.events import Event, LaneContinued
from millrace.learner.members.lobby import Lobby, LobbySettings
from millrace.learner.members.member_server import (
    ASK_PROCESSES_S,
    AWAY_S,
    FAIR_SHARE,
    SHORT_TURN_S,
    TURN_S,
    MemberServer,
    ServerSettings,
)
from millrace.learner.members.membership import Membership
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.learner.rollouts.hub import Hub, HubSettings
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import STRIKES, TicketCoordinator
from millrace.learner.vector_env.lane_orders import packed, reset_order
from millrace.learner.vector_env.order_coordinator import OrderCoordinator
from millrace.learner.vector_env.step_hub import StepHub
from millrace.learner.vector_env.vector_env_status import status
from millrace.protocol.alive import StartFailed, WorkerActivity, WorkerExit
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import BadMessage, EnvironmentFailed, NoWorkers
from millrace.protocol.messages import (
    PROTOCOL_VERSION,
    Failure,
    Goodbye,
    Heartbeat,
    Hello,
    Refuse,
    Rejoin,
    Status,
    ToLearner,
    Welcome,
)
from millrace.protocol.specs import WaitSpec
from millrace.protocol.wire.codec import decode_to_learner, decode_to_worker, encode
from millrace.protocol.wire.compression import Packing
from millrace.protocol.wire.learner_link import LearnerLink
from tests.learner.vector_env.test_order_coordinator import SPEC
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import fake_rollout, run_spec
from tests.support.conversation.fake_link import FakeLink
from tests.support.in_process.fake_processes import FakeProcesses

TIMEOUT_S, POLL_S = 5.0, 0.1


class Served:
    """A server with one member, and the workers whose processes have ended."""

    def __init__(self, settings: ServerSettings | None = None) -> None:
        self.link = FakeLink()
        self.ended: list[WorkerExit | StartFailed] = []
        self.left = {"all": math.inf, "collecting": math.inf}
        self.running: list[WorkerActivity] = []
        self.asked = 0
        self.coordinator = OrderCoordinator(SPEC, 1, TIMEOUT_S)
        link = cast(LearnerLink, self.link)
        processes = FakeProcesses(of_ended=self._ended, of_activities=self._running, of_left=self._left)
        self.server = MemberServer(link, self.coordinator, self, processes, settings, lambda: self.link.now)
        self.link.inbox.append((b"w0", example(Hello)))
        self.server.listen(POLL_S)

    def status(self, now: float) -> Status:
        return status(self.coordinator, now)

    def happened(self, event: Event) -> None:
        pass

    def sent(self, peer: bytes) -> None:
        pass

    def _left(self, collecting: bool) -> float:
        return self.left["collecting" if collecting else "all"]

    def _ended(self) -> list[WorkerExit | StartFailed]:
        ended, self.ended = self.ended, []
        return ended

    def _running(self) -> list[WorkerActivity]:
        self.asked += 1
        return self.running

    def says(self, peer: bytes, *messages: ToLearner) -> None:
        self.link.inbox += [(peer, message) for message in messages]
        while self.link.inbox:
            self.server.listen(POLL_S)

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


def test_what_started_workers_do_is_asked_now_and_then() -> None:
    served = Served()
    served.running.append(WorkerActivity("w0", 1, "stepping", 0.0, 0))
    assert served.listens_for(2 * TIMEOUT_S), "a worker in environment code is not silent"
    assert served.asked <= 2 * TIMEOUT_S / ASK_PROCESSES_S + 2


def flood(served: Served) -> None:
    """From now on, the inbox is never empty."""

    def receive() -> Iterator[tuple[bytes, ToLearner]]:
        while True:
            served.link.now += 0.001
            yield b"loud", example(Heartbeat, session=7)

    served.link.receive = receive  # type: ignore[method-assign]
    served.link.poll = lambda timeout_s: True  # type: ignore[method-assign]


def test_a_silent_worker_is_removed_although_others_speak_without_end() -> None:
    served = Served()
    flood(served)
    while served.link.now < 110.0 + FAIR_SHARE * 0.001 and served.coordinator.members:
        served.server.listen(POLL_S)
    assert not served.coordinator.members


def test_a_short_turn_takes_no_longer_than_the_caller_has_worked() -> None:
    served = Served()
    flood(served)
    for worked_s, turn_s in ((0.05, 0.05), (0.0, SHORT_TURN_S), (10.0, TURN_S)):
        served.link.now += worked_s
        began_s = served.link.now
        served.server.listen(0.0, short=True)
        assert turn_s < served.link.now - began_s <= turn_s + 0.0021


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


def packed_rollout(link: FakeLink, session: int) -> BadMessage:
    """How the link hands over a rollout of this session whose packed observations are larger than the run's."""
    images = np.zeros((3, 1, 4, 1024, 1024), np.uint8)
    rollout = msgspec.structs.replace(fake_rollout(session, lane=0, ticket=1, version=0, sequence=0), obs=(images,))
    with pytest.raises(BadMessage) as raised:
        decode_to_learner(encode(rollout, Packing(stack=True)), link.packed_bytes_limit)
    return raised.value


def lobby_server(link: FakeLink) -> MemberServer:
    """The server of a lobby without workers."""
    settings = LobbySettings(
        WaitSpec(), worker_timeout_s=TIMEOUT_S, no_workers_timeout_s=60, stall_timeout_s=60, max_env_failures=1
    )
    return Lobby(cast(LearnerLink, link), WorkerProcesses(), settings, lambda: link.now)._server


def hub_server(link: FakeLink) -> MemberServer:
    """The server of a run without workers."""
    coordinator = TicketCoordinator(run_spec(1), RolloutDealer(1, Rounds(0)), worker_timeout_s=TIMEOUT_S, first_session=1)
    settings = HubSettings(no_workers_timeout_s=60.0, stall_timeout_s=60.0, max_env_failures=0)
    return Hub(cast(LearnerLink, link), coordinator, settings, clock=lambda: link.now)._server


SERVERS: dict[str, Callable[[FakeLink], MemberServer]] = {
    "lobby": lobby_server,
    "run": hub_server,
    "vector environment": lambda link: step_hub(link)._server,
}


@pytest.mark.parametrize("server_of", SERVERS.values(), ids=SERVERS)
def test_a_worker_whose_rollout_was_packed_for_another_run_joins_again(
    server_of: Callable[[FakeLink], MemberServer], caplog: pytest.LogCaptureFixture
) -> None:
    """As after a restart of the learner: the rollout arrives before the worker has joined, perhaps before a run exists."""
    caplog.set_level(logging.INFO)
    link = FakeLink()
    server = server_of(link)
    link.inbox += [(b"w0", packed_rollout(link, 7)), (b"w0", example(Hello))]
    server.listen(POLL_S)
    rejoin, welcome, *_ = map(decode_to_worker, link.sent)
    assert rejoin == Rejoin(7)
    assert isinstance(welcome, Welcome)
    assert caplog.records[0].getMessage() == "worker w0 was told to join again: its session had ended"
    assert {record.levelname for record in caplog.records} == {"INFO"}
    link.sent.clear()
    link.inbox.append((b"w0", packed_rollout(link, 7)))
    server.listen(POLL_S)
    assert [decode_to_worker(frames) for frames in link.sent] == [Rejoin(7)], "a late copy is no mistake of the member"
    link.sent.clear()
    link.inbox += [(b"w0", packed_rollout(link, welcome.session))] * STRIKES
    server.listen(POLL_S)
    assert isinstance(decode_to_worker(link.sent[0]), Refuse), "in its session, it must know how large a rollout is"
    assert "packed arrays expected at most" in caplog.text


def step_hub(link: FakeLink, *workers: str) -> StepHub:
    """The hub of a vector environment, which these workers have joined."""
    hub = StepHub(
        cast(LearnerLink, link),
        SPEC,
        first_session=1,
        processes=WorkerProcesses(),
        worker_timeout_s=TIMEOUT_S,
        clock=lambda: link.now,
    )
    link.inbox += [(worker.encode(), example(Hello, worker=worker)) for worker in workers]
    hub.wait_for(len(workers), TIMEOUT_S)
    return hub


def test_a_vector_environment_raises_the_error_of_an_environment_once_with_its_traceback() -> None:
    link = FakeLink()
    hub = step_hub(link, "a")
    session = hub.coordinator.members[b"a"].session
    link.inbox.append((b"a", example(Failure, session=session, error="boom", traceback="its traceback", lane=0)))
    hub.listen()
    with pytest.raises(EnvironmentFailed, match=r"^worker a \(host\): boom$") as raised:
        hub.raise_failure()
    assert raised.value.detail == "its traceback"
    hub.raise_failure()


def test_a_vector_environment_raises_no_failure_of_a_spare_worker() -> None:
    link = FakeLink()
    hub = step_hub(link, "a", "b", "spare")
    for lane in range(len(SPEC.lanes)):
        hub.send_order(lane, reset_order([0], [None], packed(None)))
    session = hub.coordinator.members[b"spare"].session
    link.inbox.append((b"spare", example(Failure, session=session, error="boom", lane=0)))
    hub.listen()
    hub.raise_failure()
    session = hub.coordinator.members[b"b"].session
    link.inbox.append((b"b", example(Failure, session=session, error="boom", lane=0)))
    hub.listen()
    with pytest.raises(EnvironmentFailed, match=r"^worker b "):
        hub.raise_failure()


def test_a_vector_environments_worker_has_its_whole_timeout_to_be_heard() -> None:
    link = FakeLink()
    hub = step_hub(link, "w0")
    link.now += 1000.0
    with pytest.raises(NoWorkers):
        hub.wait_for(2, TIMEOUT_S)
    assert len(hub.coordinator.members) == 1
    with pytest.raises(NoWorkers):
        hub.wait_for(2, POLL_S)
    assert len(hub.coordinator.members) == 0


@pytest.mark.parametrize("before", [0, 2])
def test_the_last_messages_of_a_process_that_has_ended_are_received(before: int) -> None:
    """Also if they come one by one, some after it is known that the process has ended."""
    served = Served()
    served.ended.append(WorkerExit("w0", 1, "was killed", failed=True))
    late: list[ToLearner] = [*[example(Heartbeat, session=1)] * before, Goodbye(1, "told to stop", ())]
    waiting = served.link.poll

    def one_at_a_time(timeout_s: float) -> bool:
        if not served.ended and late:
            served.link.inbox.append((b"w0", late.pop(0)))
        return waiting(timeout_s)

    served.link.poll = one_at_a_time  # type: ignore[method-assign]
    served.server.listen(POLL_S)
    assert not served.coordinator.members
    assert "(the last one left: told to stop)" in str(served.server.no_workers(1, 1.0))


def test_others_that_send_without_end_do_not_hold_up_the_removal_of_a_process() -> None:
    served = Served()
    flood(served)
    served.ended.append(WorkerExit("w0", 1, "was killed", failed=True))
    began_s = served.link.now
    served.server.listen(POLL_S)
    assert not served.coordinator.members
    assert served.link.now - began_s < 3.0


@pytest.mark.parametrize("waits", [False, True], ids=["while it listens", "at the end"])
def test_one_whose_key_was_revoked_is_shut_out(waits: bool) -> None:
    served = Served()
    served.link.keyring = SimpleNamespace(allowed=())
    served.link.rejection_reason = lambda peer: "its key was revoked"  # type: ignore[method-assign]
    if waits:
        served.server.wait_until_all_left(served.link.now + TIMEOUT_S, POLL_S)
    else:
        served.server.listen(POLL_S)
    assert not served.coordinator.members


def test_at_the_end_those_are_awaited_that_may_still_speak_until_the_deadline() -> None:
    served = Served()
    until_s = served.link.now + 3 * TIMEOUT_S
    served.server.wait_until_all_left(until_s, POLL_S)
    assert until_s <= served.link.now < until_s + 2 * POLL_S
    assert served.coordinator.members, "who is silent may still say Goodbye"
    served.ended.append(WorkerExit("w0", 1, "was killed", failed=True))
    until_s = served.link.now + TIMEOUT_S
    served.server.wait_until_all_left(until_s, POLL_S)
    assert not served.coordinator.members
    assert served.link.now < until_s


def test_a_wait_ends_when_it_has_found_no_worker_all_the_time() -> None:
    served = Served()
    for attempt in (2, 3):
        served.says(b"w0", Goodbye(attempt - 1, "told to stop", ()))
        served.server.check_members(TIMEOUT_S)
        served.link.now += TIMEOUT_S - 1
        served.server.check_members(TIMEOUT_S)
        served.says(b"w0", example(Hello, process_nonce=attempt))
        served.server.check_members(TIMEOUT_S)
    served.says(b"w0", Goodbye(3, "told to stop", ()))
    served.server.check_members(TIMEOUT_S)
    served.link.now += TIMEOUT_S + 1
    with pytest.raises(NoWorkers):
        served.server.check_members(TIMEOUT_S)


def test_how_workers_come_and_go_is_a_warning_only_if_somebody_should_look(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)

    def level(message: ToLearner) -> str:
        caplog.clear()
        served.says(b"w1", message)
        return " ".join(record.levelname for record in caplog.records)

    def hello(attempt: int) -> Hello:
        return example(Hello, worker="w1", attempt=attempt)

    served = Served()
    assert level(example(Heartbeat, session=7)) == "INFO", "it joins again"
    assert level(hello(1)) == "INFO"
    assert level(Goodbye(2, "told to stop", ())) == "WARNING"
    assert level(hello(2)) == "INFO"
    served.coordinator.drain("done")
    assert level(Goodbye(3, "done", ())) == "INFO"
    assert "(the last one left: told to stop)" in str(served.server.no_workers(1, 1.0)), "the second time, it was asked to"
    caplog.clear()
    served.ended.append(WorkerExit("w0", 1, "was killed", failed=False))
    served.server.listen(POLL_S)
    assert [record.levelname for record in caplog.records] == ["WARNING"], "it did not leave because it was asked to"
    served = Served(ServerSettings(log_joins=False, log_tracebacks=False))
    assert level(hello(1)) == "", "it joins the run in a moment"
    assert level(example(Failure, session=2, error="boom", traceback="its traceback")) == "INFO WARNING"
    assert caplog.messages == ["worker w1 (host): boom", "worker w1 failed"], "whoever raises the error shows its traceback"


def test_that_a_lane_continues_is_a_warning_only_if_an_episode_is_abandoned(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    served = Served()
    caplog.clear()
    served.coordinator.membership.events += [LaneContinued("w0", 0, 5, new_episodes) for new_episodes in (0, 1)]
    served.server.send(())
    assert [record.levelname for record in caplog.records] == ["INFO", "WARNING"]


def test_what_a_connection_had_sent_that_a_newer_one_replaced_is_no_warning(caplog: pytest.LogCaptureFixture) -> None:
    """ZeroMQ takes the routing id from the older connection, so its Hellos are read from one without a name."""
    caplog.set_level(logging.INFO)
    served, hello = Served(), example(Hello, worker="w1")
    caplog.clear()
    served.says(b"\0\0\0\0\1", hello)
    assert "(the last one was refused: its connection has no routing id" in str(served.server.no_workers(2, 1.0))
    served.says(b"w1", hello)
    assert [record.levelname for record in caplog.records] == ["INFO", "INFO"]
    assert "this is harmless if it has connected again" in caplog.messages[0]
    assert len(served.coordinator.members) == 2


def test_what_became_of_workers_is_said_where_one_is_missing() -> None:
    served = Served()
    served.link.keyring, served.link.refused = SimpleNamespace(allowed=()), 3
    says = str(served.server.no_workers(2, 1.0))
    assert says.endswith("1 joined (3 were not let in; the log says why); start one: millrace worker fake --token FILE")
    served.says(b"w1", example(Hello, protocol=PROTOCOL_VERSION + 1, worker="w1"))
    assert "1 joined (the last one was refused: protocol: expected" in str(served.server.no_workers(2, 1.0))


def test_a_wait_ends_at_once_when_nobody_is_left_who_could_work(caplog: pytest.LogCaptureFixture) -> None:
    served, why = Served(), "ended with exit code 1 while it started (no licence)"
    served.left = {"all": 1.0, "collecting": 0.0}
    served.server.check_members(TIMEOUT_S, collecting=True)  # there is a member
    served.ended.append(WorkerExit("w0", 1, "was killed", failed=True))
    served.ended.append(StartFailed("w1", why, "first\nno licence"))
    served.server.listen(POLL_S)
    assert caplog.messages[-1] == f"worker w1 {why}\n    first\n    no licence"
    served.server.check_members(TIMEOUT_S)  # one that only evaluates is left
    with pytest.raises(NoWorkers) as raised:
        served.server.check_members(TIMEOUT_S, collecting=True)
    assert str(raised.value) == f"no worker is left, and none will be started again: the last one {why}"
    served.left["collecting"] = 1.0
    with pytest.raises(
        NoWorkers, match=r"waited for 2 workers \(--min-workers\), and only 1 of them can still join: the last"
    ):
        served.server.wait_for(2, TIMEOUT_S, lambda: served.server.listen(POLL_S))


def test_new_members_of_one_key_are_limited() -> None:
    served = Served()
    served.server._joins.admits = lambda source, now: False  # type: ignore[method-assign]
    served.says(b"w1", example(Hello, worker="w1"))
    assert list(served.coordinator.members) == [b"w0"]


def test_whoever_waits_for_workers_is_told_how_many_came_and_how_to_start_one() -> None:
    served = Served()
    with pytest.raises(NoWorkers, match="waited 1 s for 2 workers at fake, 1 joined; start one: millrace worker fake"):
        served.server.wait_for(2, 1.0, lambda: served.server.listen(POLL_S))
    served.link.inbox.append((b"w0", example(Heartbeat, session=1)))
    served.server.wait_for(1, 1.0, lambda: served.server.listen(POLL_S))


def members_of_a_lobby() -> Membership:
    """A worker that was asked to describe the environment, and has not answered yet."""
    made = DescribeCoordinator(WaitSpec(), 1, worker_timeout_s=TIMEOUT_S, decliners_to_end=0)
    made.ask(Unknown(EnvSpec("Fake-v0")))
    made.receive(b"w0", example(Hello), 0.0)
    return made.membership


def begin_run(link: FakeLink, described_in_s: float) -> Callable[[], None]:
    """Begin a run for this worker. Returns the wait for its workers."""
    rollouts = RolloutDealer(1, Rounds(0))
    coordinator = TicketCoordinator(run_spec(1), rollouts, worker_timeout_s=TIMEOUT_S, first_session=1)
    settings = HubSettings(no_workers_timeout_s=TIMEOUT_S, stall_timeout_s=600.0, max_env_failures=0)
    hub = Hub(cast(LearnerLink, link), coordinator, settings, clock=lambda: link.now)
    hub.take_over(members_of_a_lobby(), described_in_s)
    return lambda: hub.wait_for(1)


def begin_vector_env(link: FakeLink, described_in_s: float) -> Callable[[], None]:
    """Begin a vector environment for this worker. Returns the wait for its workers."""
    hub = step_hub(link)
    hub.take_over(members_of_a_lobby(), described_in_s)
    return lambda: hub.wait_for(1, TIMEOUT_S)


@pytest.mark.parametrize(("begins_after_s", "expected_s"), [(1.0, 1.0), (math.inf, 2.0)])
@pytest.mark.parametrize("begin", [begin_run, begin_vector_env])
def test_a_learner_waits_for_a_worker_that_still_describes_the_environment_but_no_longer_than_the_description_took(
    begin: Callable[[FakeLink, float], Callable[[], None]], begins_after_s: float, expected_s: float
) -> None:
    """`begins_after_s`: when the worker reports that it has begun the run."""
    link = FakeLink()
    wait = begin(link, 2.0)
    began_s = link.now
    poll = link.poll

    def poll_and_begin(timeout_s: float) -> bool:
        if link.now >= began_s + begins_after_s:
            link.inbox.append((b"w0", example(Heartbeat, session=1, waits=False)))
        return poll(timeout_s)

    link.poll = poll_and_begin  # type: ignore[method-assign]
    wait()
    assert link.now - began_s == pytest.approx(expected_s, abs=1.5 * POLL_S)
    wait()
    assert link.now - began_s == pytest.approx(expected_s, abs=1.5 * POLL_S), "it waits only once"


def test_a_run_that_has_what_it_needs_does_not_wait() -> None:
    served = Served()
    served.coordinator.members[b"w0"].describes = True
    served.server.wait_for(1, TIMEOUT_S, lambda: pytest.fail("it waits"))
