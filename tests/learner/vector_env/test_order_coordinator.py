"""The learner's half of a vector environment, rule by rule. Pure: the test is the workers, time is a number."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import msgspec
import numpy as np
import pytest

from millrace.learner.members.events import WorkerLeft, WorkerRefused
from millrace.learner.members.membership import Outgoing
from millrace.learner.vector_env.order_coordinator import MakeOrder, OrderCoordinator, SentOrder
from millrace.learner.vector_env.vector_env_status import status
from millrace.protocol.bounds import LARGEST
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.messages import (
    Answer,
    Call,
    Heartbeat,
    HeartbeatReply,
    Hello,
    LaneIncarnation,
    Order,
    Received,
    Refuse,
    Returned,
    Status,
    Step,
    Stepped,
)
from millrace.protocol.progress import RunProgress
from millrace.protocol.specs import Leaf, StepSpec
from millrace.protocol.wire.codec import decode_to_observer, encode
from millrace.protocol.wire.plain_values import pack
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import fake_rollout, process_ends

A, B = b"a", b"b"
TIMEOUT_S = 5.0
NOTHING = np.zeros(0, np.uint8)
WORDS = np.frombuffer(b"words", np.uint8)
SPEC = StepSpec(
    envs=(EnvSpec("Fake-v0"),),
    copies=(0, 0),
    lanes=(1, 1),
    observation=(Leaf("", "box", (2,), "float32"),),
    action=(Leaf("", "discrete", (), "int64", (2,), (0,)),),
)


def order_coordinator(*peers: bytes) -> OrderCoordinator:
    """With these workers, one lane each, all of them stepped once."""
    made = OrderCoordinator(SPEC, 100, TIMEOUT_S)
    for peer in peers:
        made.receive(peer, example(Hello, worker=peer.decode()), 0.0)
    for lane in range(len(peers)):
        peer, order = sent(made, lane)
        assert made.receive(peer, stepped(order), 0.0) == []
        assert list(made.take()) == [lane]
    made.membership.take_events()
    return made


def sent(made: OrderCoordinator, lane: int, make: MakeOrder | None = None) -> tuple[bytes, Order]:
    """The order that this lane gets at once, and its worker."""
    made.ask(lane, make or step, 0.0)
    ((peer, order),) = made.send_waiting([lane], 0.0, 0.0)
    return peer, cast(Order, order)


def step(session: int, ticket: int, life: LaneIncarnation) -> Order:
    return example(
        Step, session=session, ticket=ticket, lane=life.lane, incarnation=life.incarnation, actions=(np.zeros(1, np.int64),)
    )


def stepped(order: object, **changes: object) -> Stepped:
    assert isinstance(order, Step | Call)
    flag = np.zeros(1, bool)
    obs = (np.zeros((1, 2), np.float32),)
    answer = example(
        Stepped,
        session=order.session,
        ticket=order.ticket,
        lane=order.lane,
        incarnation=order.incarnation,
        obs=obs,
        reward=np.zeros(1),
        terminated=flag,
        truncated=flag,
        infos=NOTHING,
    )
    return msgspec.structs.replace(answer, **changes)


def in_memory(made: OrderCoordinator, lane: int, number: int) -> Stepped:
    """What its worker says when the infos of that order do not fit into shared memory."""
    member = made.owner(lane)
    assert member is not None
    return stepped(
        example(Step, session=member.session, ticket=-number, lane=lane, incarnation=made.lanes[lane].incarnation),
        infos=WORDS,
    )


def test_an_order_is_answered_once() -> None:
    made = order_coordinator(A)
    _, order = sent(made, 0)
    answer = stepped(order)
    made.receive(A, answer, 0.0)
    assert made.take() == {0: answer}
    assert not made.has_orders
    assert made.receive(A, answer, 0.0) == []
    assert made.take() == {}


def test_an_answer_that_nobody_wants_is_not_kept_but_until_it_comes_its_order_is_sent_again() -> None:
    made = order_coordinator(A)
    _, order = sent(made, 0)
    made.forget(0)
    assert made.lanes[0].order == SentOrder(order, wanted=False), "its worker may execute it"
    assert order in [message for _, message in lost_on_the_way(made)]
    made.receive(A, stepped(order), 0.0)
    assert not made.has_orders
    assert made.take() == {}


def test_an_order_that_nobody_wants_is_over_when_the_lane_has_the_next_one() -> None:
    """Its worker has replaced it too, and does not answer it."""
    made = order_coordinator(A)
    _, first = sent(made, 0)
    made.forget(0)
    _, second = sent(made, 0)
    assert [message for _, message in lost_on_the_way(made) if isinstance(message, Step)] == [second]
    assert made.receive(A, stepped(first), 0.0) == []
    assert made.take() == {}
    answer = stepped(second)
    made.receive(A, answer, 0.0)
    assert made.take() == {0: answer}
    assert not made.has_orders


def lost_on_the_way(made: OrderCoordinator) -> list[Outgoing]:
    """What is sent to worker A after heartbeats that name no order."""
    session = made.members[A].session
    made.receive(A, example(Heartbeat, session=session, replies=made.members[A].replies), 1.0)
    return made.receive(A, example(Heartbeat, session=session, replies=made.members[A].replies), 1.0)


def test_another_workers_order_is_not_answered() -> None:
    made = order_coordinator(A, B)
    _, order = sent(made, 0)
    assert made.receive(B, stepped(order, session=made.members[B].session), 0.0) == []
    assert made.lanes[0].order == SentOrder(order)


def test_what_was_not_asked_for_gets_its_sender_refused() -> None:
    made = order_coordinator(A)
    ((_, said),) = made.receive(A, fake_rollout(made.members[A].session, 0, 0, 0, 0), 0.0)
    assert said == Refuse("it sent Rollout, which a vector environment does not ask for")


def test_a_loss_is_told_once_and_its_lane_starts_again_in_its_next_incarnation() -> None:
    made = order_coordinator(A, B)
    made.give_up(made.members[A], "did not answer")
    assert made.take_lost() == {0: "worker a (host) did not answer"}
    assert made.take_lost() == {}
    peer, order = sent(made, 0)
    assert isinstance(order, Step)
    assert (peer, order.incarnation) == (B, 1)


def test_a_lane_stays_where_it_is_although_a_worker_has_none() -> None:
    """While workers may still come, a lane that has none waits for one of its own."""
    made = order_coordinator(A)
    made.ask(1, step, 3.0)
    assert made.send_waiting([1], 7.9, 5.0) == []
    assert made.waiting == [1]
    assert [peer for peer, _ in made.send_waiting([1], 8.0, 5.0)] == [A]
    assert made.waiting == []
    made.receive(B, example(Hello, worker="b"), 0.0)
    sent(made, 1)
    assert [lane.owner for lane in made.lanes] == [A, A]


def test_in_a_tie_the_first_name_gets_the_next_lane_and_numbers_in_names_count() -> None:
    made = OrderCoordinator(SPEC, 100, TIMEOUT_S)
    for name in ("w10", "w2"):
        made.receive(name.encode(), example(Hello, worker=name), 0.0)
    assert [sent(made, lane)[0] for lane in range(2)] == [b"w2", b"w10"]


@pytest.mark.parametrize(
    "changes",
    [
        {"reward": np.zeros(1, np.float32)},
        {"reward": np.zeros(2)},
        {"obs": ()},
        {"obs": (np.zeros((1, 3), np.float32),)},
        {"lane": 1},
        {"incarnation": 7},
        {"truncated": np.full(1, 2, np.uint8).view(bool)},
    ],
    ids=str,
)
def test_an_answer_that_does_not_fit_is_refused_and_its_lane_is_lost(changes: dict[str, object]) -> None:
    made = order_coordinator(A, B)
    _, order = sent(made, 0)
    ((_, said),) = made.receive(A, stepped(order, **changes), 0.0)
    assert isinstance(said, Refuse)
    assert list(made.members) == [B]
    assert list(made.lost) == [0]
    assert not made.has_orders
    assert made.take() == {}


# ---------------------------------------------------------------- what comes beside shared memory


def test_infos_too_long_for_shared_memory_are_no_answer() -> None:
    made = order_coordinator(A)
    said = in_memory(made, 0, 7)
    assert made.receive(A, said, 0.0) == []
    assert made.lanes[0].long_infos == said
    assert made.take() == {}, "counted as an answer it would stand for that of a lane which has none"


def test_infos_of_anothers_lane_or_an_earlier_life_are_not_used() -> None:
    made = order_coordinator(A, B)
    theirs = in_memory(made, 1, 7)
    made.receive(A, msgspec.structs.replace(theirs, session=in_memory(made, 0, 7).session), 0.0)
    made.receive(B, msgspec.structs.replace(theirs, incarnation=9), 0.0)
    assert [lane.long_infos for lane in made.lanes] == [None, None]
    made.give_up(made.members[B], "was killed")
    assert [lane.started for lane in made.lanes] == [True, False], "whoever is gone will not say its infos"


def test_nothing_but_a_step_is_answered_beside_shared_memory() -> None:
    made = order_coordinator(A)
    session = in_memory(made, 0, 7).session
    ((_, said),) = made.receive(A, example(Returned, session=session, ticket=-7, results=NOTHING), 0.0)
    assert isinstance(said, Refuse)
    assert made.members == {}
    assert made.lanes[0].long_infos is None


# ---------------------------------------------------------------- silence


def beat(made: OrderCoordinator, peer: bytes, now: float, steps: int = 0) -> None:
    made.receive(peer, example(Heartbeat, session=made.members[peer].session, steps=steps), now)


def test_whoever_is_silent_while_it_is_listened_to_is_given_up() -> None:
    made = order_coordinator(A, B)
    beat(made, A, 3.0)
    made.remove_silent(TIMEOUT_S + 1)
    assert list(made.members) == [A]
    assert made.lost == {1: "worker b (host) silent for 5 s"}
    process_ends(made, "b", "was killed by SIGKILL", nonce=1)
    assert made.membership.take_events()[-1] == WorkerLeft("b", "was killed by SIGKILL", 0, False)


def test_where_an_end_is_known_otherwise_nobody_is_silent() -> None:
    made = order_coordinator(A)
    made.worker_timeout_s = float("inf")
    made.remove_silent(1e9)
    assert made.lost == {}


def test_one_whose_key_was_revoked_is_told_so_and_forgotten() -> None:
    made = order_coordinator(A)
    assert made.revoke(A, "its key was revoked") == [(A, Refuse("its key was revoked"))]
    assert made.lost == {0: "worker a (host) was shut out: its key was revoked"}
    assert isinstance(made.membership.take_events()[0], WorkerRefused)


def test_what_was_lost_on_the_way_is_said_again() -> None:
    made = order_coordinator(A)
    _, order = sent(made, 0)
    session = made.members[A].session
    said: list[list[object]] = []
    for replies, held in ((0, ()), (1, (order_ticket(order),)), (2, ()), (2, ())):
        outs = made.receive(A, example(Heartbeat, session=session, replies=replies, tickets=held), 1.0)
        said.append([message for _, message in outs if isinstance(message, Step)])
        (reply,) = (message for _, message in outs if isinstance(message, HeartbeatReply))
        assert reply.received == (Received(0, 0, 0),), "its lanes; it closes any other"
    assert said == [[], [], [order], []], "again only once it must have arrived, and once for each time"


def order_ticket(order: object) -> int:
    assert isinstance(order, Step | Answer)
    return order.ticket


# ---------------------------------------------------------------- status


def test_it_says_how_it_is() -> None:
    made = order_coordinator(B, A)
    beat(made, B, 10.0, steps=100)
    beat(made, B, 12.0, steps=300)
    beat(made, A, 12.0, steps=50)
    found = status(made, 13.0)
    assert found.env == "Fake-v0"
    assert found.progress == RunProgress(env_steps=350, steps_per_s=100.0)
    assert [(one.worker, one.lanes, one.silent_s) for one in found.workers] == [("b", (1,), 1.0), ("a", (0,), 1.0)]


def test_it_can_be_sent_whatever_workers_report() -> None:
    made = order_coordinator(B, A)
    for peer in (A, B):
        beat(made, peer, 10.0, steps=LARGEST)
    found = decode_to_observer(encode(status(made, 13.0)))
    assert isinstance(found, Status)
    assert found.progress.env_steps == LARGEST


def call(session: int, ticket: int, life: LaneIncarnation) -> Order:
    return example(
        Call,
        session=session,
        ticket=ticket,
        lane=life.lane,
        incarnation=life.incarnation,
        copies=(0,),
        name="name",
        given=NOTHING,
    )


def assign(session: int, ticket: int, life: LaneIncarnation) -> Order:
    return example(
        Call,
        session=session,
        ticket=ticket,
        lane=life.lane,
        incarnation=life.incarnation,
        copies=(0,),
        name="name",
        assign=True,
        given=NOTHING,
    )


def test_an_answer_of_the_other_kind_and_results_that_are_not_one_for_each_copy_are_refused() -> None:
    results = np.frombuffer(pack([1]), np.uint8)
    two = np.frombuffer(pack([1, 2]), np.uint8)
    text = np.frombuffer(pack("x"), np.uint8)

    def told(make: MakeOrder, answer: Callable[[Order], Answer]) -> str:
        coordinator = order_coordinator(A, B)
        _, order = sent(coordinator, 0, make)
        out = coordinator.receive(A, answer(order), 0.0)
        if not out:
            assert coordinator.take()[0].ticket == order.ticket
            return ""
        assert coordinator.take() == {}
        ((_, refusal),) = out
        assert isinstance(refusal, Refuse)
        return refusal.reason

    def returned(packed: np.ndarray[Any, Any], error: str = "") -> Callable[[Order], Answer]:
        return lambda order: example(
            Returned,
            session=order.session,
            ticket=order.ticket,
            lane=order.lane,
            incarnation=order.incarnation,
            results=packed,
            error=error,
        )

    assert told(step, returned(results)) == "answer to Step: expected Stepped, got Returned"
    assert told(call, stepped) == "answer to Call: expected Returned, got Stepped"
    assert told(assign, returned(np.frombuffer(pack([]), np.uint8))) == ""
    assert told(assign, returned(results)) == "results: expected a list of 0, got 1 in a list"
    assert told(call, returned(two)) == "results: expected a list of 1, got 2 in a list"
    assert told(call, returned(text)) == "results: expected a list of 1, got str"
    assert "not a plain value" in told(call, returned(WORDS))
    assert (told(call, returned(WORDS, "KeyError: 1")), told(call, returned(results)), told(step, stepped)) == ("", "", "")


def test_whoever_is_waited_for_no_longer_takes_no_other_worker_of_its_name_along() -> None:
    """Each key has names of its own: the peers differ, the names do not."""
    made = OrderCoordinator(SPEC, 100, TIMEOUT_S)
    peers = [b"a\0tag\0" + key * 64 for key in (b"1", b"2")]
    for lane, peer in enumerate(peers):
        made.receive(peer, example(Hello, worker="a", process_nonce=lane + 1), 0.0)
        sent(made, lane)
    slow = made.owner(1)
    assert slow is not None
    made.give_up(slow, "did not answer in time")
    assert list(made.members) == [peer for peer in peers if peer != slow.peer]
