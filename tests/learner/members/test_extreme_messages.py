"""A hostile worker without a lane says everything that a worker can say, at extreme values. Nothing that it says matters.

Rule: the rollouts that are used, and the answers that a vector environment gets, are those of the same run without it; no
message of it leads to an error of the learner. Pure but for the codec: the link and the clock are not real.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from itertools import product
from typing import cast

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from millrace.cli.status import as_table
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.learner.rollouts.hub import Hub, HubSettings
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.learner.vector_env.step_hub import StepHub
from millrace.protocol.errors import BadMessage
from millrace.protocol.messages import (
    Alive,
    Answer,
    Collect,
    Failure,
    Goodbye,
    Heartbeat,
    Hello,
    Inquire,
    Order,
    Permit,
    Refuse,
    Rejoin,
    Rollout,
    Step,
    Stepped,
    ToLearner,
    ToWorker,
    Weights,
    Welcome,
)
from millrace.protocol.rollout import rollout_bytes
from millrace.protocol.wire.codec import Buffer, decode_to_learner, decode_to_observer, decode_to_worker, encode
from millrace.protocol.wire.learner_link import LearnerLink
from tests.learner.vector_env.test_order_coordinator import SPEC, step, stepped
from tests.support.conversation.example_messages import example
from tests.support.conversation.extreme_messages import MARK, SESSION, extremes, of_session
from tests.support.conversation.fake_ends import BUFFERS, PARAMETERS, fake_rollout, run_spec
from tests.support.conversation.fake_link import FakeLink
from tests.support.conversation.hostile_messages import hostile, real
from tests.support.examples import examples

HOSTILE = "spare"
SECRET_NONCE = 0x5EC2E7_5EC2E7  # of honest workers: nobody but a worker's supervisor and the learner knows it
LANES, TURN_S = 2, 0.05
RUN = run_spec(LANES)


@cache
def sayings() -> list[list[bytes]]:
    """Everything that the hostile worker says, each in a session that is filled in."""
    return [frames for message in real(SESSION) for frames in extremes(message)]


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


class Conversation(FakeLink):
    """A link on which honest workers answer at once, and the hostile one says what it likes."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[tuple[bytes, ToWorker]] = []  # to honest workers
        self.observed: list[str] = []
        self.sayings: list[tuple[str, list[bytes]]] = []  # of the hostile worker, with the name that it uses
        self.sessions: dict[str, int] = {}  # of the hostile worker, by name, until it is refused
        self.nonces = itertools.count(10)
        self.in_session = 0  # messages that it said in a session of its own

    def poll(self, timeout_s: float) -> bool:
        return bool(self.sayings) or super().poll(timeout_s)

    def receive(self) -> Iterator[tuple[bytes, ToLearner | BadMessage]]:
        yield from super().receive()
        while self.sayings:
            name, frames = self.sayings.pop(0)
            if name not in self.sessions:
                yield name.encode(), example(Hello, worker=name, process_nonce=next(self.nonces))
            session = self.sessions.get(name, 0)
            self.in_session += session > 0
            try:
                message = decode_to_learner(of_session(frames, session), rollout_bytes(RUN))
            except BadMessage as error:
                yield name.encode(), cast(ToLearner, error)
            else:
                yield name.encode(), cast(ToLearner, message)

    def send(self, peer: bytes, frames: Sequence[Buffer]) -> bool:
        name = peer.decode()
        if not name.startswith(HOSTILE):
            self.told.append((peer, decode_to_worker(frames)))
            return True
        try:
            match decode_to_worker(frames):
                case Welcome(session):
                    self.sessions[name] = session
                case Refuse() | Rejoin():
                    self.sessions.pop(name, None)
                case _:
                    pass
        except BadMessage:
            self.observed.append(as_table(decode_to_observer(frames)))
        return True

    def says(self, frames: list[bytes], name: str = HOSTILE) -> None:
        """The hostile worker says this, as bytes, in its session; it joins first if it is no member."""
        self.sayings.append((name, frames))


class Honest:
    """A worker of a run, without faults."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.session, self.sent = 0, 0
        self.versions: set[int] = set()
        self.permits: list[tuple[Permit, int]] = []

    def hears(self, message: ToWorker) -> None:
        match message:
            case Welcome(session):
                self.session = session
            case Weights(version):
                self.versions.add(version)
            case Collect(_, version, permits):
                self.permits += [(permit, version) for permit in permits]
            case _:
                pass

    def says(self) -> Iterator[ToLearner]:
        if not self.session:
            yield example(Hello, worker=self.name, process_nonce=SECRET_NONCE)
            return
        held = tuple(permit.ticket for permit, _ in self.permits)
        yield example(Heartbeat, session=self.session, versions=tuple(sorted(self.versions)), tickets=held, steps=self.sent)
        if self.permits:
            permit, version = self.permits.pop(0)
            yield fake_rollout(self.session, permit.lane, permit.ticket, version, permit.sequence)
            self.sent += 1


Say = Callable[[Conversation, int], None]


def used(turns: int, say: Say) -> list[tuple[int, int, int, int, int]]:
    """Lane, ticket, version, sequence and incarnation of each rollout that an update used, in order."""
    link = Conversation()
    coordinator = TicketCoordinator(RUN, RolloutDealer(RUN.lanes, Rounds(1)), worker_timeout_s=3.0, first_session=1)
    settings = HubSettings(60.0, 600.0, max_env_failures=0)
    hub = Hub(cast(LearnerLink, link), coordinator, settings, clock=lambda: link.now)
    honest = [Honest(f"w{number}") for number in range(LANES)]
    found = []
    for turn in range(turns):
        if turn == 2:
            hub.publish(0, PARAMETERS, BUFFERS)
        if turn > 2:  # every lane has its owner
            say(link, turn)
        link.inbox += [(worker.name.encode(), message) for worker in honest for message in worker.says()]
        while link.inbox or link.sayings:
            hub._turn(0.0)
        taken = coordinator.rollouts.take() if turn > 2 else None
        if taken is not None:
            found += [
                (r.rollout.lane, r.rollout.ticket, r.rollout.version, r.rollout.sequence, r.incarnation) for r in taken
            ]
            hub.publish(coordinator.version + 1, PARAMETERS, BUFFERS)
        for peer, message in link.told:
            next(worker for worker in honest if worker.name.encode() == peer).hears(message)
        link.told.clear()
        link.now += TURN_S
    assert hub._server.unexpected_errors == 0
    ledger = coordinator.rollouts.ledger
    assert ledger.issued == ledger.used + ledger.outstanding + ledger.lost
    assert ledger.lost == 0
    assert not any(MARK in text for text in link.observed)
    return found


def answers(turns: int, say: Say) -> list[bytes]:
    """The observations that a vector environment of two lanes got, in order."""
    link = Conversation()
    hub = StepHub(
        cast(LearnerLink, link),
        SPEC,
        first_session=1,
        processes=WorkerProcesses(),
        worker_timeout_s=3.0,
        clock=lambda: link.now,
    )
    orders: list[tuple[bytes, Order]] = []
    found: list[bytes] = []
    wait = link.poll

    def poll(timeout_s: float) -> bool:
        for peer, message in link.told:
            if isinstance(message, Step):
                orders.append((peer, message))
        link.told.clear()
        if not link.inbox and not link.sayings and orders:
            peer, order = orders.pop(0)
            obs = np.full((1, 2), 100 * order.lane + len(found), np.float32)
            link.inbox.append((peer, msgspec.structs.replace(stepped(order), obs=(obs,))))
        return wait(timeout_s)

    link.poll = poll  # type: ignore[method-assign]
    for name in ("w0", "w1"):
        link.inbox.append((name.encode(), example(Hello, worker=name, process_nonce=SECRET_NONCE)))
    hub.wait_for(2, 5.0)
    for turn in range(turns):
        held = tuple(ticket for member in hub.coordinator.members.values() for ticket in member.tickets)
        for number in (0, 1):
            session = hub.coordinator.members[b"w%d" % number].session
            link.inbox.append((b"w%d" % number, example(Heartbeat, session=session, tickets=held)))
        if turn:
            say(link, turn)
        for lane in (0, 1):
            hub.send_order(lane, step)
        got: dict[int, Answer | bytes] = {}
        deadline_s = link.now + 30.0
        while len(got) < 2:
            assert link.now < deadline_s, hub.coordinator.take_lost()
            hub.wait(30.0, together=True)
            got |= hub.take()
        found += [answer.obs[0].tobytes() for _, answer in sorted(got.items()) if isinstance(answer, Stepped)]
    assert hub._server.unexpected_errors == 0
    return found


def silent(link: Conversation, turn: int) -> None:
    """No hostile worker."""


def all_of(batch: int) -> Say:
    """In each turn the next so many sayings."""

    def say(link: Conversation, turn: int) -> None:
        for frames in sayings()[(turn - 3) * batch : (turn - 2) * batch]:
            link.says(frames)

    return say


def remembering(say: Say, links: list[Conversation]) -> Say:
    """The same, and the link on which it was said."""

    def remember(link: Conversation, turn: int) -> None:
        links.append(link)
        say(link, turn)

    return remember


BATCH = 12


def test_every_field_at_extreme_values_changes_no_rollout_that_is_used() -> None:
    turns = 3 + len(sayings()) // BATCH + 1
    expected = used(turns, silent)
    assert len(expected) > 500
    said: list[Conversation] = []
    assert used(turns, remembering(all_of(BATCH), said)) == expected
    assert said[0].in_session > 0.9 * len(sayings())


def test_every_field_at_extreme_values_changes_no_answer_of_a_vector_environment() -> None:
    turns = 3 + len(sayings()) // BATCH + 1
    said: list[Conversation] = []
    assert answers(turns, remembering(all_of(BATCH), said)) == answers(turns, silent)
    assert said[0].in_session > 0.9 * len(sayings())


FLOODS: list[Callable[[int], list[ToLearner | Inquire]]] = [
    lambda nonce: [example(Hello, worker=HOSTILE, host="h" * 1_000, pid=2**31, process_nonce=nonce, software="s")],
    lambda nonce: [Goodbye(SESSION, "x" * 1_000, (0, 1))],
    lambda nonce: [
        example(
            Heartbeat,
            session=SESSION,
            replies=2**53,
            versions=(0, 2**53),
            tickets=tuple(range(1_000)),
            steps=2**53,
            stages={"step": 1e9},
            resident_bytes=2**53,
        )
    ],
    lambda nonce: [example(Failure, session=SESSION, error="boom", traceback="t" * 64_000, lane=nonce % 3)],
    lambda nonce: [Inquire()],
    lambda nonce: [Alive((), ())],
    lambda nonce: [fake_rollout(SESSION, nonce % 2, nonce, nonce % 5, nonce)],
]


@examples(25)
@given(
    st.lists(
        st.tuples(
            st.integers(4, 40),
            st.one_of(st.integers(0, 4_999), st.sampled_from(range(-len(FLOODS), 0))),
            st.integers(1, 20),
            st.booleans(),
        ),
        max_size=40,
    ),
    st.sampled_from([used, answers]),
)
def test_whatever_it_says_when_and_however_often_changes_nothing(
    script: list[tuple[int, int, int, bool]], play: Callable[[int, Say], object]
) -> None:
    """`script`: at which turn it says what, how often, and whether under a new name."""

    def say(link: Conversation, turn: int) -> None:
        for at, what, times, renamed in script:
            for time in range(times if at == turn else 0):
                frames = sayings()[what] if what >= 0 else None
                flood = FLOODS[what](next(link.nonces)) if frames is None else []
                said = [frames] if frames is not None else [[bytes(frame) for frame in encode(one)] for one in flood]
                for one in said:
                    link.says(one, f"{HOSTILE}{turn}.{time}" if renamed else HOSTILE)

    assert play(44, say) == play(44, silent)


def test_rollouts_on_tickets_that_others_hold_change_nothing() -> None:
    def say(link: Conversation, turn: int) -> None:
        for ticket, back, version in product(range(2 * turn - 8, 2 * turn + 2), range(1, 5), range(turn - 5, turn - 2)):
            taken = fake_rollout(SESSION, ticket % 2, max(0, ticket), max(0, version), max(0, turn - back))
            link.says([bytes(frame) for frame in encode(taken)])

    assert used(15, say) == used(15, silent)


def test_fuzzed_bytes_change_nothing() -> None:
    def say(link: Conversation, turn: int) -> None:
        for _ in range(10):
            link.says(next(fuzzed))

    for play in (used, answers):
        fuzzed = hostile(5, real(SESSION))
        assert play(100, say) == play(100, silent)


def test_the_sayings_reach_every_field_and_some_of_every_kind_are_understood() -> None:
    understood: dict[type, int] = {}
    refusals = []
    for frames in sayings():
        try:
            message = decode_to_learner(of_session(frames, 5), rollout_bytes(RUN))
        except BadMessage as error:
            refusals.append(str(error))
            continue
        understood[type(message)] = understood.get(type(message), 0) + 1
    assert all(text.isprintable() and len(text) <= 500 for text in refusals)
    assert set(understood) | {Inquire} == {type(message) for message in real(7)}
    assert min(understood.values()) > 20
    assert understood[Rollout] > 300
