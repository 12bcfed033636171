"""Weights that supervisors share among their workers: once for each, and directly to whom they do not reach. Pure."""

from __future__ import annotations

import gc
import weakref

import pytest

from millrace.learner.members.member import SUPERVISOR_WORD_S
from millrace.learner.members.membership import Outgoing
from millrace.learner.rollouts.opponent_pool import OpponentPool, PoolSettings
from millrace.protocol.alive import SHARED_VERSIONS, Alive, WorkerActivity
from millrace.protocol.messages import Collect, HeartbeatReply, Hello, Weights
from tests.learner.rollouts.test_ticket_coordinator import Learner
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import process_ends

A, B, C, SUPERVISOR = b"a", b"b", b"c", b"supervisor"
NONCE = 1000 * len("host") + 1  # as `Learner.joins` makes it


def speaks(learner: Learner, replies: int | None, workers: bytes = b"ab", peer: bytes = SUPERVISOR) -> list[Outgoing]:
    """The supervisor says which workers run, and that it has received so many replies."""
    running = [WorkerActivity(chr(worker), NONCE, "waiting", 0.0, 0) for worker in workers]
    return learner.says(peer, Alive(tuple(running), (), replies))


def shared(peers: bytes = b"abc", lanes: int = 3) -> Learner:
    """A learner whose workers have version 0. The supervisor of `a` and `b` has spoken; other workers have none."""
    learner = Learner(lanes=lanes)
    for peer in peers:
        learner.joins(bytes([peer]))
    learner.deliver_all()
    learner.take()
    speaks(learner, 0)
    return learner


def receivers(outs: list[Outgoing]) -> list[bytes]:
    return [peer for peer, message in outs if isinstance(message, Weights)]


def test_a_supervisor_gets_each_version_once_and_other_workers_their_own() -> None:
    learner = shared()
    assert sorted(receivers(learner.publish(1))) == [C, SUPERVISOR]
    learner.deliver_all()
    learner.take()
    assert sorted(receivers(learner.publish(2))) == [C, SUPERVISOR]


def test_a_worker_that_needs_later_what_its_supervisor_got_finds_it_there() -> None:
    learner = shared(b"ab", lanes=1)
    holder, spare = (A, B) if learner.coordinator.members[A].lanes else (B, A)
    assert receivers(learner.publish(1)) == [SUPERVISOR]
    assert learner.holds(spare) == set()
    outs = learner.balanced(process_ends(learner.coordinator, holder.decode()))
    assert [type(message) for _, message in outs] == [Collect]
    assert 1 in learner.holds(spare)


def test_the_weights_of_an_opponent_are_not_shared() -> None:
    learner = shared(b"ab", lanes=1)
    pool = learner.coordinator.rollouts.opponents = OpponentPool(PoolSettings(1, 1, 1, 0.0, 0))
    pool.made(0, 0)
    holder, spare = (A, B) if learner.coordinator.members[A].lanes else (B, A)
    assert receivers(learner.publish(1)) == [SUPERVISOR]
    outs = learner.balanced(process_ends(learner.coordinator, holder.decode()))
    assert [(peer, message.versions) for peer, message in outs if isinstance(message, Collect)] == [(spare, {0, 1})]
    assert [(peer, message.version) for peer, message in outs if isinstance(message, Weights)] == [(spare, 0)]


def test_a_worker_of_which_its_supervisor_has_not_spoken_yet_gets_weights_directly() -> None:
    learner = shared(b"a", lanes=2)
    learner.joins(B)
    assert sorted(receivers(learner.publish(1))) == [B, SUPERVISOR]


def test_the_answer_to_a_supervisor_is_numbered_and_says_whose_weights_follow() -> None:
    learner = shared()
    first = learner.coordinator.membership._first_session
    assert speaks(learner, 1) == [(SUPERVISOR, HeartbeatReply(first, 2, ()))]
    assert speaks(learner, None) == [], "one that shares none is not answered"
    assert speaks(learner, 0, b"xyz", b"stranger") == [], "nor one without workers here"


def test_what_is_under_way_to_a_supervisor_is_not_sent_to_its_workers() -> None:
    learner = shared()
    learner.publish(1)
    for _ in range(4):  # the link is slow
        learner.now += 1.0
        speaks(learner, 1)  # the reply that came before the weights
        assert receivers(learner.beats(A, versions=[0])) == []


def test_what_a_worker_lacks_although_it_has_reached_its_supervisor_or_is_lost_is_sent_directly() -> None:
    learner = shared()
    learner.publish(1)
    speaks(learner, 1)
    speaks(learner, 2)  # what was sent before that reply has arrived, or is lost
    assert receivers(learner.beats(A, versions=[0])) == [], "it may have found them since"
    assert receivers(learner.beats(A, versions=[0])) == [A]
    assert receivers(learner.beats(B, versions=[0, 1])) == []
    assert receivers(learner.beats(B, versions=[0, 1])) == []


@pytest.mark.parametrize("how", ["silent", "shares no more"])
def test_workers_of_a_supervisor_that_shares_no_more_get_weights_directly(how: str) -> None:
    learner = shared(b"ab", lanes=2)
    learner.publish(1)
    if how == "silent":
        learner.now += SUPERVISOR_WORD_S
    else:
        speaks(learner, None)
    assert [receivers(learner.beats(A, versions=[0])) for _ in range(2)] == [[], [A]]
    learner.beats(B, versions=[0, 1])
    learner.deliver_all()
    learner.take()
    assert sorted(receivers(learner.publish(2))) == [A, B]


def test_weights_go_to_no_supervisor_of_another_key() -> None:
    learner = Learner()
    peer = b"a\0tag\0aa"
    learner.says(peer, example(Hello, worker="a", process_nonce=NONCE, attempt=NONCE + 1))
    learner.deliver_all()
    learner.take()
    assert speaks(learner, 0, b"a", b"supervisor\0tag\0bb") == []
    assert receivers(learner.publish(1)) == [peer]


def test_what_is_kept_of_a_supervisor_ends_with_its_workers() -> None:
    learner = shared(b"ab", lanes=2)
    for version in range(1, 5):
        learner.publish(version)
        learner.deliver_all()
        learner.take()
    supervisor, of_b = (member.supervisor for member in learner.coordinator.members.values())
    assert supervisor is of_b
    assert supervisor is not None
    gone = weakref.ref(supervisor)
    del supervisor, of_b
    for peer in (A, B):
        process_ends(learner.coordinator, peer.decode())
    gc.collect()
    assert gone() is None
    assert not learner.coordinator.weights.held.by_supervisor
    assert not learner.coordinator.weights.held.by_worker


def test_a_version_that_the_supervisor_keeps_no_more_is_sent_to_it_again() -> None:
    """An evaluation beside training is of one version, while others come."""
    learner = shared(b"ab", lanes=2)
    for version in range(1, 2 + SHARED_VERSIONS):
        learner.publish(version)
        learner.deliver_all()
        learner.take()
    (supervisor, _) = (member.supervisor for member in learner.coordinator.members.values())
    assert supervisor is not None
    assert set(learner.coordinator.weights.held.by_supervisor[supervisor]) == set(range(2, 2 + SHARED_VERSIONS))
