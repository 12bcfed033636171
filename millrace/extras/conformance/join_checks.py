"""The checks that both profiles share: joining, leaving, and describing the environment.

Each check is a function listed in `profiles.py`, written as `script.py` explains. Its docstring says what the learner does
to the client. The checks follow the order of states and messages in the section "The worker's half" of the wire document.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from msgspec.structs import replace

from millrace.extras.conformance.learner import Learner
from millrace.extras.conformance.script import AskToStop, Broken, CutConnection, Listen, Script, Skipped, Wait, brief
from millrace.protocol.bounds import MAX_LINE
from millrace.protocol.envs.description import DescribedEnv, read_description
from millrace.protocol.errors import BadMessage, UsageError
from millrace.protocol.messages import (
    Answer,
    Describe,
    Described,
    Drain,
    Goodbye,
    Heartbeat,
    HeartbeatReply,
    Hello,
    Refuse,
    Rejoin,
    Release,
    Rollout,
    Weights,
    Welcome,
)
from millrace.protocol.rules import Rule
from millrace.protocol.specs import RunSpec, StepSpec, WaitSpec
from millrace.protocol.wire.socket_options import routing_id

MOST_LIMIT_STEPS = 2000  # the longest time limit that a check tries to reach, in steps
POLE_GAINS = (0.1, 0.2, 1.0, 0.6)  # gains of a linear controller that balances CartPole until the time limit
SILENCE_S = 1.5  # learner_timeout_s in the check in which the learner falls silent


def wait_spec(learner: Learner, heartbeat_s: float = 0.0, learner_timeout_s: float = 30.0) -> WaitSpec:
    """The specification of a session in which the client waits for the run."""
    return WaitSpec(heartbeat_s=heartbeat_s or learner.settings.heartbeat_s, learner_timeout_s=learner_timeout_s)


def describe(learner: Learner) -> Describe:
    """An order to describe the client's environment."""
    return Describe(learner.session, next(learner.tickets), learner.settings.env)


def described(learner: Learner) -> Script[DescribedEnv]:
    """The client's environment. If the client hasn't described it yet, let the client join and do so."""
    if learner.env is None:
        yield from in_any_session(learner)
        yield from describes_on_order(learner)
        assert learner.env is not None
    return learner.env


def describes_on_order(learner: Learner) -> Script[Describe]:
    """Let the client describe its environment, in a session in which it waits for the run. Returns the order."""
    order = describe(learner)
    learner.send(order)
    text = f"Described of the environment {order.env.id}, with ticket {order.ticket} of the order"
    answer = yield from learner.expect((Described, Goodbye), Rule.DESCRIBE, text, within_s=learner.settings.start_s)
    if not isinstance(answer, Described):
        raise Broken(Rule.DECLINED, text, brief(answer))
    try:
        learner.env = read_description(answer.description)
    except (BadMessage, UsageError) as error:
        raise Broken(Rule.DESCRIBE, "a description of spaces that gymnasium has", str(error)) from None
    return order


def time_limit(learner: Learner) -> Script[int]:
    """The time limit that the client described, in steps. Skips the check if there is none, or if it is too long."""
    env = yield from described(learner)
    longest = env.max_episode_steps
    if longest is None or longest > MOST_LIMIT_STEPS:
        raise Skipped("the environment has no time limit" if longest is None else f"its time limit is {longest} steps")
    return longest


def is_gymnasium_pole(env: DescribedEnv) -> bool:
    """Whether the environment is gymnasium's CartPole, whose attributes and `reset` options the checks know."""
    return env.spec is not None and str(env.spec.entry_point).endswith(":CartPoleEnv")


def heartbeats(learner: Learner, number: int, rule: Rule = Rule.HEARTBEAT) -> Script[Heartbeat]:
    """Wait for this many Heartbeats. Returns the last one."""
    for _ in range(number):
        beat = yield from learner.expect(Heartbeat, rule, "a Heartbeat")
    return beat


def over_a_new_connection(learner: Learner, *others: type[Answer | Rollout]) -> Script[None]:
    """Reset every connection, and wait for a Heartbeat of the same session, or for one of `others`."""
    learner.do(CutConnection(), Listen())
    text = "a message of the same session over a new connection"
    yield from learner.expect((Heartbeat, *others), Rule.CONNECTION, text, within_s=10)


# -------------------------------------------------------------------------------------------------------------- joining


def says_hello(learner: Learner) -> Script[None]:
    """Start the client, and check its first message."""
    hello = yield from learner.newly_started()
    token = learner.settings.token
    peer = (
        learner.peer.rpartition(b"\0")[0] if token else learner.peer
    )  # removes the key that the learner's socket appends to the routing id
    if peer.partition(b"\0")[0] != hello.worker.encode():
        raise Broken(Rule.HELLO, f"the routing id {hello.worker!r}, the worker's name", f"{peer!r}")
    if peer != (expected := routing_id(hello.worker, token)):
        raise Broken(Rule.ROUTING_ID, f"the routing id {expected!r}", f"{peer!r}")
    if hello.attempt != hello.process_nonce + 1:
        raise Broken(Rule.HELLO, f"attempt {hello.process_nonce + 1} (process_nonce + 1)", f"attempt {hello.attempt}")


def repeats_hello(learner: Learner) -> Script[None]:
    """Don't answer Hello, as if every Welcome were lost."""
    first = yield from learner.newly_started()
    times = [learner.now]
    for _ in range(3):
        again = yield from learner.expect(Hello, Rule.HELLO_AGAIN, "the same Hello again", within_s=6.0)
        if (again.attempt, again.process_nonce) != (first.attempt, first.process_nonce):
            raise Broken(Rule.HELLO_AGAIN, f"attempt {first.attempt} again", f"attempt {again.attempt}")
        times.append(learner.now)
    gaps = [later - earlier for earlier, later in pairwise(times)]
    if gaps[-1] < 1.3 * gaps[0] or gaps[0] < 0.1:
        raise Broken(Rule.HELLO_AGAIN, "waits that grow, from 0.25 s", f"{', '.join(f'{gap:.2f} s' for gap in gaps)}")


def ignores_early_messages(learner: Learner) -> Script[None]:
    """Send messages of a session that doesn't exist."""
    hello = yield from learner.joining()
    for message in (
        Rejoin(1), HeartbeatReply(1, 1, ()), Release(1, ()), Weights(3, np.zeros(4, np.float32), np.zeros(0, np.float32))
    ):  # fmt: skip
        learner.send(message)
    again = yield from learner.expect(Hello, Rule.JOINING_IGNORES, "the same Hello again", within_s=6.0)
    if again.attempt != hello.attempt:
        raise Broken(Rule.JOINING_IGNORES, f"attempt {hello.attempt} still", f"attempt {again.attempt}")


def accepts_only_its_welcome(learner: Learner) -> Script[None]:
    """Send Welcomes that answer other attempts."""
    hello = yield from learner.joining()
    learner.send(Welcome(77, hello.attempt - 1, wait_spec(learner)))
    learner.send(Welcome(78, hello.attempt + 1, wait_spec(learner)))
    text = f"Hello until a Welcome for attempt {hello.attempt} comes"
    answer = yield from learner.expect((Hello, Heartbeat), Rule.WELCOME_ATTEMPT, text, within_s=6.0)
    if not isinstance(answer, Hello):
        raise Broken(Rule.WELCOME_ATTEMPT, text, brief(answer))


def describes(learner: Learner) -> Script[None]:
    """Repeat a Describe, as if its answer had been lost. Then send a new Describe, and one of another session."""
    yield from in_any_session(learner)
    order = yield from describes_on_order(learner)
    learner.send(order)
    text = f"Described again, as ticket {order.ticket} came again"
    yield from learner.expect(Described, Rule.DESCRIBE_AGAIN, text, ticket=order.ticket)
    yield from describes_on_order(learner)
    learner.send(replace(order, session=order.session + 1000, ticket=next(learner.tickets)))
    yield from learner.quiet(Described, Rule.OTHER_SESSION, "no Described after an order of another session", for_s=1.0)


# ------------------------------------------------------------------------------------------- a session of any kind


def answers_heartbeats_in_order(learner: Learner) -> Script[None]:
    """Answer Heartbeats with replies that are lost, late and repeated."""
    yield from learner.joining()
    learner.welcome(wait_spec(learner))
    first = yield from learner.expect(Heartbeat, Rule.HEARTBEAT, "a Heartbeat", within_s=learner.settings.start_s)
    if first.replies:
        raise Broken(Rule.HEARTBEAT_REPLIES, "replies 0 before the first HeartbeatReply of a session", f"{first.replies}")
    yield from _replies(learner, 1)
    learner.answers_heartbeats = False
    yield from learner.expect(Heartbeat, Rule.HEARTBEAT, "a Heartbeat although the last one was not answered")
    learner.send(learner.watch.reply(9))
    yield from _replies(learner, 9)
    learner.send(learner.watch.reply(9))
    learner.send(learner.watch.reply(4))
    for _ in range(2):
        late = yield from heartbeats(learner, 1)
        if late.replies != 9:
            raise Broken(Rule.HEARTBEAT_REPLIES, "replies 9 after a late copy of reply 4", f"{late.replies}")


def _replies(learner: Learner, number: int) -> Script[None]:
    for _ in range(4):  # a Heartbeat may have been on its way before the reply arrived
        heartbeat = yield from heartbeats(learner, 1)
        if heartbeat.replies >= number:
            return
    raise Broken(Rule.HEARTBEAT_REPLIES, f"replies {number} after HeartbeatReply {number}", f"{heartbeat.replies}")


def in_any_session(learner: Learner, heartbeat_s: float = 0.0, learner_timeout_s: float = 30.0) -> Script[None]:
    """Let the client join and wait for the run. Every client supports such a session."""
    yield from learner.joining()
    learner.welcome(wait_spec(learner, heartbeat_s, learner_timeout_s))
    yield from heartbeats(learner, 1)


def keeps_the_rhythm(learner: Learner) -> Script[None]:
    """Count Heartbeats, which must come as often as the session requires."""
    yield from in_any_session(learner, heartbeat_s=0.5)
    yield from heartbeats(learner, 1)
    began_s = learner.now
    yield from heartbeats(learner, 4)
    took_s = learner.now - began_s
    if not 1.0 <= took_s <= 4.0:
        raise Broken(Rule.HEARTBEAT, "four of them in 2 s, as heartbeat_s is 0.5", f"{took_s:.1f} s")


def joins_again(learner: Learner) -> Script[None]:
    """Send a Rejoin for another session, then one for this session."""
    yield from in_any_session(learner)
    learner.send(Rejoin(learner.session + 1000))
    yield from learner.quiet(Hello, Rule.OTHER_SESSION, "no Hello after a Rejoin of another session", for_s=1.0)
    yield from learner.rejoin()
    learner.welcome(wait_spec(learner))
    yield from heartbeats(learner, 1, Rule.SESSION)


def begins(learner: Learner, run: RunSpec | StepSpec) -> Script[None]:
    """Let the client join before there is a run, describe its environment, and begin the run in the same session."""
    yield from in_any_session(learner)
    yield from describes_on_order(learner)
    waited = learner.watch.welcome
    yield from _replies(learner, 1)
    learner.begin(run)
    for message in (waited, learner.watch.welcome):  # send late copies of both
        learner.send(message)
    for _ in range(2):
        heartbeat = yield from heartbeats(learner, 1, Rule.BEGINS)
        if not heartbeat.replies:
            raise Broken(Rule.BEGINS, "a session that goes on (replies above 0)", "one that began again")
    yield from _begun(learner)


def _begun(learner: Learner) -> Script[None]:
    """Wait until a Heartbeat says that the client no longer waits for the run."""
    for _ in range(4):  # a Heartbeat may have been on its way before the Welcome arrived
        heartbeat = yield from heartbeats(learner, 1, Rule.BEGINS)
        if not heartbeat.waits:
            return
    raise Broken(Rule.BEGINS, "waits false in a Heartbeat after the second Welcome", "true")


def takes_a_repeated_welcome(learner: Learner) -> Script[None]:
    """Send the same Welcome again, as a learner does if Hello was repeated."""
    yield from in_any_session(learner)
    yield from _replies(learner, 1)
    learner.send(learner.watch.welcome)
    for _ in range(2):
        heartbeat = yield from heartbeats(learner, 1, Rule.REPEATED_WELCOME)
        if not heartbeat.replies:
            raise Broken(Rule.REPEATED_WELCOME, "a session that goes on (replies above 0)", "one that began again")


def notices_silence(learner: Learner) -> Script[None]:
    """Fall silent. The client must join again after `learner_timeout_s`."""
    yield from in_any_session(learner, learner_timeout_s=SILENCE_S)
    yield from heartbeats(learner, 12)  # the client stays as long as it receives any message from the learner
    learner.answers_heartbeats = False
    silent_from_s = learner.now
    text = f"Hello {SILENCE_S} s (learner_timeout_s) after the learner's last message"
    yield from learner.later_hello(Rule.SILENT, text, within_s=SILENCE_S + 4)
    if learner.now - silent_from_s < SILENCE_S - 2 * learner.settings.heartbeat_s - 0.1:
        raise Broken(Rule.SILENT, f"Hello after {SILENCE_S} s of silence", f"after {learner.now - silent_from_s:.1f} s")


# ---------------------------------------------------------------------------------------------------- faults of networks


def outlives_its_connection(learner: Learner) -> Script[None]:
    """Reset every connection, but keep the session."""
    yield from in_any_session(learner)
    for _ in range(2):
        yield from over_a_new_connection(learner)


def outlives_a_restart(learner: Learner) -> Script[None]:
    """Close the socket for a second; then continue as a learner that doesn't know the session."""
    yield from in_any_session(learner)
    learner.do(CutConnection())
    yield Wait(1.0)
    yield from over_a_new_connection(learner)
    yield from learner.rejoin()
    learner.welcome(wait_spec(learner))
    yield from describes_on_order(learner)


# -------------------------------------------------------------------------------------------------------------- leaving


def leaves_when_refused(learner: Learner) -> Script[None]:
    """Send Refuse while the client is joining."""
    yield from learner.newly_started()
    learner.send(Refuse("the test refuses this worker: expected exit code 2"))
    yield from learner.left(Rule.REFUSE, "Refuse while joining", (2,))


def leaves_when_refused_later(learner: Learner) -> Script[None]:
    """Send Refuse in a session."""
    yield from in_any_session(learner)
    learner.send(Refuse("the test refuses this worker: expected exit code 2"))
    learner.may_leave = True
    yield from learner.left(Rule.REFUSE, "Refuse while ready", (2,))


def drains_while_joining(learner: Learner) -> Script[None]:
    """Answer Hello with a Drain that has the longest allowed reason."""
    yield from learner.newly_started()
    learner.send(Drain("…" * MAX_LINE))
    yield from learner.left(Rule.DRAIN_JOINING, "Drain while joining")


def drains_while_idle(learner: Learner) -> Script[None]:
    """While the client has nothing to do, send a Drain that has the longest allowed reason."""
    yield from in_any_session(learner)
    learner.send(Drain("…" * MAX_LINE))
    goodbye = yield from learner.expect(Goodbye, Rule.DRAIN, "Goodbye after Drain")
    if goodbye.tickets:
        raise Broken(Rule.DRAIN, "Goodbye without tickets", f"tickets {list(goodbye.tickets)}")
    yield from learner.left(Rule.DRAIN, "Drain and Goodbye")


def stops_on_request(learner: Learner) -> Script[None]:
    """Send SIGTERM in a session."""
    yield from in_any_session(learner)
    learner.do(AskToStop())
    yield from learner.expect(Goodbye, Rule.STOP, "Goodbye after SIGTERM")
    yield from learner.left(Rule.STOP, "SIGTERM and Goodbye")


def stops_while_joining(learner: Learner) -> Script[None]:
    """Send SIGTERM while the client waits for an answer to its Hello."""
    yield from learner.newly_started()
    learner.do(AskToStop())
    yield from learner.left(Rule.STOP, "SIGTERM while joining")


def draws_its_nonce(learner: Learner) -> Script[None]:
    """Start two processes with the same command. Their `process_nonce` must differ."""
    one = yield from learner.newly_started()
    other = yield from learner.newly_started()
    if one.process_nonce == other.process_nonce:
        raise Broken(Rule.REAPPEARS, f"another process_nonce than {one.process_nonce} in the second process", "the same")
