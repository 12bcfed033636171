"""The checks of both profiles: joining, leaving, and what the learner must know of the environment.

Each function is one check (`script.py`). The order of the states and messages is that of "The worker's half".
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from millrace.conformance import rules
from millrace.conformance.learner import Learner
from millrace.conformance.script import Broken, Heard, Script, Wait, brief
from protocol.bounds import MAX_LINE
from protocol.envs.description import DescribedEnv, read_description
from protocol.errors import BadMessage, UsageError
from protocol.messages import (
    Described,
    Drain,
    Goodbye,
    Heartbeat,
    HeartbeatReply,
    Hello,
    Refuse,
    Rejoin,
    Release,
    Weights,
    Welcome,
)
from protocol.specs import DescribeSpec

SILENCE_S = 1.5  # learner_timeout_s of the check of silence


def describe_spec(learner: Learner, heartbeat_s: float = 0.0, learner_timeout_s: float = 30.0) -> DescribeSpec:
    """A session in which the client describes its environment."""
    settings = learner.settings
    return DescribeSpec(settings.env, heartbeat_s=heartbeat_s or settings.heartbeat_s, learner_timeout_s=learner_timeout_s)


def described(learner: Learner) -> Script[DescribedEnv]:
    """The client's environment. If it is not known yet, the client joins and describes it."""
    if learner.description is None:
        yield from learner.joining()
        learner.welcome(describe_spec(learner))
        within_s = learner.settings.start_s
        found = yield Wait(
            within_s, lambda event: isinstance(event, Heard) and isinstance(event.message, Described | Goodbye)
        )
        if found is None:
            raise Broken(rules.DESCRIBE, f"Described after a Welcome with a DescribeSpec, within {within_s:g} s", "none")
        assert isinstance(found, Heard)
        if not isinstance(found.message, Described):
            got = f"Goodbye: {found.message.reason}" if isinstance(found.message, Goodbye) else brief(found.message)
            raise Broken(rules.DECLINED, f"a description of the environment {learner.settings.env.id}", got)
        learner.description = found.message
    try:
        return read_description(learner.description.description)
    except (BadMessage, UsageError) as error:
        raise Broken(rules.DESCRIBE, "a description of spaces that gymnasium has", str(error)) from None


# -------------------------------------------------------------------------------------------------------------- joining


def says_hello(learner: Learner) -> Script[None]:
    """The first message."""
    hello = yield from learner.newly_started()
    routing_id = learner.peer.partition(b"\0")[0]
    if routing_id != hello.worker.encode():
        raise Broken(rules.HELLO, f"the routing id {hello.worker!r}, the worker's name", f"{routing_id!r}")
    if hello.attempt != hello.process_nonce + 1:
        raise Broken(rules.HELLO, f"attempt {hello.process_nonce + 1} (life + 1)", f"attempt {hello.attempt}")


def repeats_hello(learner: Learner) -> Script[None]:
    """The learner does not answer: every Welcome is lost."""
    first = yield from learner.newly_started()
    times = [learner.now]
    for _ in range(3):
        again = yield from learner.expect(Hello, rules.HELLO_AGAIN, "the same Hello again", within_s=6.0)
        if (again.attempt, again.process_nonce) != (first.attempt, first.process_nonce):
            raise Broken(rules.HELLO_AGAIN, f"attempt {first.attempt} again", f"attempt {again.attempt}")
        times.append(learner.now)
    gaps = [later - earlier for earlier, later in pairwise(times)]
    if gaps[-1] < 1.3 * gaps[0] or gaps[0] < 0.1:
        raise Broken(rules.HELLO_AGAIN, "waits that grow, from 0.25 s", f"{', '.join(f'{gap:.2f} s' for gap in gaps)}")


def ignores_early_messages(learner: Learner) -> Script[None]:
    """Messages of a session that there is not."""
    hello = yield from learner.joining()
    for message in (
        Rejoin(1), HeartbeatReply(1, 1, ()), Release(1, ()), Weights(3, np.zeros(4, np.float32), np.zeros(0, np.float32))
    ):  # fmt: skip
        learner.send(message)
    again = yield from learner.expect(Hello, rules.JOINING_IGNORES, "the same Hello again", within_s=6.0)
    if again.attempt != hello.attempt:
        raise Broken(rules.JOINING_IGNORES, f"attempt {hello.attempt} still", f"attempt {again.attempt}")


def accepts_only_its_welcome(learner: Learner) -> Script[None]:
    """A Welcome that answers another attempt comes late."""
    hello = yield from learner.joining()
    learner.send(Welcome(77, hello.attempt - 1, describe_spec(learner)))
    learner.send(Welcome(78, hello.attempt + 1, describe_spec(learner)))
    found = yield Wait(
        6.0,
        lambda event: isinstance(event, Heard) and (getattr(event.message, "session", 0) in (77, 78) or _is_hello(event)),
    )
    if found is None or not _is_hello(found):
        got = "no Hello any more" if found is None else brief(found.message) if isinstance(found, Heard) else ""
        raise Broken(rules.WELCOME_ATTEMPT, f"Hello until a Welcome for attempt {hello.attempt} comes", got)


def _is_hello(event: object) -> bool:
    return isinstance(event, Heard) and isinstance(event.message, Hello)


def describes(learner: Learner) -> Script[None]:
    """The spaces of the environment, with every Heartbeat."""
    learner.description = None
    yield from described(learner)
    first = learner.described_as()
    for _ in range(2):
        yield from learner.expect(Heartbeat, rules.HEARTBEAT, "a Heartbeat")
        again = yield from learner.expect(Described, rules.DESCRIBE_AGAIN, "Described after each Heartbeat")
        if repr(again.description) != repr(first.description):
            raise Broken(rules.DESCRIBE_AGAIN, "the same description again", "another")


# ------------------------------------------------------------------------------------------- a session of any kind


def answers_heartbeats_in_order(learner: Learner) -> Script[None]:
    """Replies are lost, late and repeated."""
    yield from learner.joining()
    learner.welcome(describe_spec(learner))  # the first Heartbeat may come before Described, and is answered
    first = yield from learner.expect(Heartbeat, rules.HEARTBEAT, "a Heartbeat", within_s=learner.settings.start_s)
    if first.replies:
        raise Broken(rules.HEARTBEAT_REPLIES, "replies 0 before the first HeartbeatReply of a session", f"{first.replies}")
    yield from _replies(learner, 1)
    learner.answers_heartbeats = False
    yield from learner.expect(Heartbeat, rules.HEARTBEAT, "a Heartbeat although the last one was not answered")
    learner.send(HeartbeatReply(learner.session, 9, learner.of_lanes()))
    yield from _replies(learner, 9)
    learner.send(HeartbeatReply(learner.session, 9, learner.of_lanes()))
    learner.send(HeartbeatReply(learner.session, 4, learner.of_lanes()))
    for _ in range(2):
        late = yield from learner.expect(Heartbeat, rules.HEARTBEAT, "a Heartbeat")
        if late.replies != 9:
            raise Broken(rules.HEARTBEAT_REPLIES, "replies 9 after a late copy of reply 4", f"{late.replies}")


def _replies(learner: Learner, number: int) -> Script[None]:
    for _ in range(4):  # one may have been on its way
        found = yield from learner.expect(Heartbeat, rules.HEARTBEAT, "a Heartbeat")
        if found.replies >= number:
            return
    raise Broken(rules.HEARTBEAT_REPLIES, f"replies {number} after HeartbeatReply {number}", f"{found.replies}")


def in_any_session(learner: Learner, heartbeat_s: float = 0.0, learner_timeout_s: float = 30.0) -> Script[None]:
    """The client joins, and describes its environment: a session that every client has."""
    yield from learner.joining()
    learner.welcome(describe_spec(learner, heartbeat_s, learner_timeout_s))
    yield from learner.expect(Described, rules.DESCRIBE, "Described", within_s=learner.settings.start_s)


def keeps_the_rhythm(learner: Learner) -> Script[None]:
    """Heartbeats come as often as the session asks for."""
    yield from in_any_session(learner, heartbeat_s=0.5)
    yield from learner.expect(Heartbeat, rules.HEARTBEAT, "a Heartbeat")
    began_s = learner.now
    for _ in range(4):
        yield from learner.expect(Heartbeat, rules.HEARTBEAT, "a Heartbeat")
    took_s = learner.now - began_s
    if not 1.0 <= took_s <= 4.0:
        raise Broken(rules.HEARTBEAT, "four of them in 2 s, as heartbeat_s is 0.5", f"{took_s:.1f} s")


def joins_again(learner: Learner) -> Script[None]:
    """A Rejoin of this session, and one of another."""
    yield from in_any_session(learner)
    learner.send(Rejoin(learner.session + 1000))
    yield from learner.quiet(Hello, 1.0, rules.OTHER_SESSION, "no Hello after a Rejoin of another session")
    yield from learner.rejoin()
    learner.welcome(describe_spec(learner))
    yield from learner.expect(Heartbeat, rules.SESSION, "a Heartbeat of the new session")


def takes_a_repeated_welcome(learner: Learner) -> Script[None]:
    """The learner answers a repeated Hello by the same Welcome."""
    yield from in_any_session(learner)
    yield from _replies(learner, 1)
    assert learner.hello is not None
    learner.send(Welcome(learner.session, learner.hello.attempt, describe_spec(learner)))
    for _ in range(2):
        found = yield from learner.expect(Heartbeat, rules.REPEATED_WELCOME, "a Heartbeat of the same session")
        if not found.replies:
            raise Broken(rules.REPEATED_WELCOME, "a session that goes on (replies above 0)", "one that began again")


def notices_silence(learner: Learner) -> Script[None]:
    """The learner says nothing more."""
    yield from in_any_session(learner, learner_timeout_s=SILENCE_S)
    before = learner.hello
    assert before is not None
    for _ in range(12):  # as long as it is heard, the client stays: any message counts
        yield from learner.expect(Heartbeat, rules.HEARTBEAT, "a Heartbeat")
    learner.answers_heartbeats = False
    learner.allows_hello = True
    silent_from_s = learner.now
    hello = yield from learner.expect(
        Hello,
        rules.SILENT,
        f"Hello {SILENCE_S} s (learner_timeout_s) after the learner's last message",
        within_s=SILENCE_S + 4,
    )
    if learner.now - silent_from_s < SILENCE_S - 2 * learner.settings.heartbeat_s - 0.1:
        raise Broken(rules.SILENT, f"Hello after {SILENCE_S} s of silence", f"after {learner.now - silent_from_s:.1f} s")
    if hello.attempt <= before.attempt:
        raise Broken(rules.SILENT, f"an attempt later than {before.attempt}", f"attempt {hello.attempt}")


# ---------------------------------------------------------------------------------------------------- faults of networks


def outlives_its_connection(learner: Learner) -> Script[None]:
    """Every connection is reset; the learner keeps the session."""
    yield from in_any_session(learner)
    for _ in range(2):
        learner.cut()
        yield from learner.expect(Heartbeat, rules.CONNECTION, "a Heartbeat over a new connection", within_s=10)


def outlives_a_restart(learner: Learner) -> Script[None]:
    """The learner is away for a second, and then knows no session."""
    yield from in_any_session(learner)
    before = learner.hello
    assert before is not None
    learner.cut(listen=False)
    yield from learner.let_pass(1.0)
    learner.listen()
    yield from learner.expect(Heartbeat, rules.CONNECTION, "a Heartbeat over a new connection", within_s=10)
    hello = yield from learner.rejoin()
    if hello.process_nonce != before.process_nonce:
        raise Broken(rules.HELLO, f"life {before.process_nonce}, for the process is the same", f"life {hello.process_nonce}")
    learner.welcome(describe_spec(learner))
    yield from learner.expect(Described, rules.DESCRIBE, "Described in the new session")


# -------------------------------------------------------------------------------------------------------------- leaving


def leaves_when_refused(learner: Learner) -> Script[None]:
    """Refuse while joining."""
    yield from learner.newly_started()
    learner.send(Refuse("the test refuses this worker: expected exit code 2"))
    yield from learner.left(rules.REFUSE, 2, "Refuse while joining")


def leaves_when_refused_later(learner: Learner) -> Script[None]:
    """Refuse while ready."""
    yield from in_any_session(learner)
    learner.send(Refuse("the test refuses this worker: expected exit code 2"))
    assert learner.watch is not None
    learner.watch.heard_heartbeat_s = learner.now + learner.settings.patience_s  # no Heartbeat is due any more
    yield from learner.left(rules.REFUSE, 2, "Refuse while ready")


def drains_while_joining(learner: Learner) -> Script[None]:
    """Drain is the answer to Hello. Its reason is as long as a reason may be."""
    yield from learner.newly_started()
    learner.send(Drain("…" * MAX_LINE))
    yield from learner.left(rules.DRAIN_JOINING, 0, "Drain while joining")


def drains_while_idle(learner: Learner) -> Script[None]:
    """Drain while there is nothing to do. Its reason is as long as a reason may be."""
    yield from in_any_session(learner)
    learner.send(Drain("…" * MAX_LINE))
    goodbye = yield from learner.expect(Goodbye, rules.DRAIN, "Goodbye after Drain")
    if goodbye.tickets:
        raise Broken(rules.DRAIN, "Goodbye without tickets", f"tickets {list(goodbye.tickets)}")
    yield from learner.left(rules.DRAIN, 0, "Drain and Goodbye")


def stops_on_request(learner: Learner) -> Script[None]:
    """SIGTERM while ready."""
    yield from in_any_session(learner)
    learner.stop()
    yield from learner.expect(Goodbye, rules.STOP, "Goodbye after SIGTERM")
    yield from learner.left(rules.STOP, 0, "SIGTERM and Goodbye")


def stops_while_joining(learner: Learner) -> Script[None]:
    """SIGTERM while no learner answers."""
    yield from learner.newly_started()
    learner.stop()
    yield from learner.left(rules.STOP, 0, "SIGTERM while joining")


def draws_its_life(learner: Learner) -> Script[None]:
    """Two processes of the same command have different lives."""
    one = yield from learner.newly_started()
    other = yield from learner.newly_started()
    if one.process_nonce == other.process_nonce:
        raise Broken(rules.REAPPEARS, f"another life than {one.process_nonce} in the second process", "the same")
