"""Messages as plain tuples, which a state of the model can hold, and back.

Rule: only what the two halves read is kept. A rollout is one valid transition.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.messages import (
    PROTOCOL_VERSION,
    Collect,
    Describe,
    Described,
    EpisodeRows,
    Evaluate,
    Evaluated,
    Heartbeat,
    HeartbeatReply,
    Hello,
    LaneIncarnation,
    Permit,
    Received,
    Refuse,
    Rejoin,
    Release,
    Rollout,
    ToLearner,
    ToWorker,
    Weights,
    Welcome,
)
from millrace.protocol.rollout import Episode
from millrace.protocol.space_spec import DiscreteSpace, EnvDescription
from millrace.protocol.specs import RunSpec, StepSpec, WaitSpec
from millrace.protocol.wire.plain_values import pack
from tests.model.conversation import Content
from tests.model.names import FIRST_OF, Kind, Name, name
from tests.model.settings import TICK_S, TIMEOUT_S
from tests.support.conversation.fake_ends import BUFFERS, PARAMETERS, fake_rollout, fake_rows

ENV = EnvSpec("Fake-v0")
WAIT = WaitSpec(heartbeat_s=TICK_S, learner_timeout_s=TIMEOUT_S)
"""What workers are welcomed by before the run."""
TWO = DiscreteSpace(2, 0, "int64")
DESCRIPTION = EnvDescription(TWO, TWO, np.frombuffer(pack({}), np.uint8), "", 0, "")
EPISODE_STEPS = 2  # of each episode of an evaluation, as `tests.support.conversation.fake_ends` plays them


def worker_of(peer: bytes) -> int:
    return int(peer[1:])


def peer_of(worker: int) -> bytes:
    return b"w%d" % worker


def session(number: int) -> Name:
    return name(Kind.SESSION, number)


def ticket(number: int) -> Name:
    """The name of a ticket for a rollout, for a part of an evaluation, or for a description."""
    kind = next((kind for kind, first in FIRST_OF.items() if number >= first), Kind.TICKET)
    return name(kind, number - FIRST_OF.get(kind, 0))


def incarnation(lane: int, number: int) -> Name:
    return name(Kind.INCARNATION, number, lane)


@cache
def rollout(session: int, lane: int, ticket: int, version: int, sequence: int) -> Rollout:
    return fake_rollout(session, lane, ticket, version, sequence)


@cache
def weights(version: int) -> Weights:
    return Weights(version, PARAMETERS, BUFFERS)


def hello(worker: int, nonce: int, attempt: int, *, evaluates: bool = False) -> Hello:
    return Hello(
        protocol=PROTOCOL_VERSION,
        worker=f"w{worker}",
        host="host",
        pid=1,
        process_nonce=nonce,
        software="model",
        attempt=attempt,
        evaluates=evaluates,
    )


def content_of(message: ToLearner | ToWorker, worker: int) -> Content:
    """`worker`: the number of the worker that sends or receives it."""
    match message:
        case Hello():
            attempt = name(Kind.ATTEMPT, message.attempt, worker)
            return "Hello", name(Kind.NONCE, message.process_nonce, worker), attempt, message.evaluates
        case Heartbeat(number, replies, versions, tickets):
            held = tuple(ticket(each) for each in sorted(tickets))
            return "Heartbeat", session(number), name(Kind.REPLIES, replies, number), versions, held, message.waits
        case Rollout():
            return "Rollout", *rollout_content(message)
        case Welcome(number, attempt, run):
            return "Welcome", session(number), name(Kind.ATTEMPT, attempt, worker), isinstance(run, WaitSpec)
        case Describe(number, each):
            return "Describe", session(number), ticket(each)
        case Described(number, each):
            return "Described", session(number), ticket(each)
        case Refuse():
            return ("Refuse",)
        case Rejoin(number):
            return "Rejoin", session(number)
        case Weights(version):
            return "Weights", version
        case Collect(number, version, permits, received, keep):
            permitted = tuple(
                (ticket(p.ticket), p.lane, incarnation(p.lane, p.incarnation), p.sequence, p.opponent) for p in permits
            )
            return "Collect", session(number), version, permitted, _received(received), keep
        case Release(number, lanes):
            return "Release", session(number), tuple((each.lane, incarnation(each.lane, each.incarnation)) for each in lanes)
        case HeartbeatReply(number, replies, received):
            return "HeartbeatReply", session(number), name(Kind.REPLIES, replies, number), _received(received)
        case Evaluate(number, each, version, seeds, _, _, with_rows):
            return "Evaluate", session(number), ticket(each), version, seeds, with_rows, message.keep
        case EpisodeRows(number, each, episode, step):
            return "EpisodeRows", session(number), ticket(each), episode, step
        case Evaluated(number, each, episodes):
            return "Evaluated", session(number), ticket(each), tuple(episode.reward for episode in episodes)
        case _:
            raise AssertionError(f"the model has no {type(message).__name__}")


def message_of(content: Content, worker: int, run: WaitSpec | RunSpec | StepSpec) -> Any:
    """The message of this content, from or to this worker."""
    match content:
        case "Hello", nonce, attempt, evaluates:
            return hello(worker, nonce.value, attempt.value, evaluates=evaluates)
        case "Heartbeat", number, replies, versions, tickets, waits:
            held = tuple(each.value for each in tickets)
            return Heartbeat(number.value, replies.value, versions, held, 0, {}, 0, waits=waits)
        case "Rollout", *fields:
            return rollout_of(tuple(fields))
        case "Welcome", number, attempt, waits:
            return Welcome(number.value, attempt.value, WAIT if waits else run)
        case "Describe", number, each:
            return Describe(number.value, each.value, ENV)
        case "Described", number, each:
            return described(number.value, each.value)
        case ("Refuse",):
            return Refuse("refused")
        case "Rejoin", number:
            return Rejoin(number.value)
        case "Weights", version:
            return weights(version)
        case "Collect", number, version, permits, received, keep:
            allowed = tuple(Permit(each.value, lane, inc.value, *more) for each, lane, inc, *more in permits)
            return Collect(number.value, version, allowed, _received_of(received), keep)
        case "Release", number, lanes:
            return Release(number.value, tuple(LaneIncarnation(lane, inc.value) for lane, inc in lanes))
        case "HeartbeatReply", number, replies, received:
            return HeartbeatReply(number.value, replies.value, _received_of(received))
        case "Evaluate", number, each, version, seeds, with_rows, keep:
            return Evaluate(number.value, each.value, version, seeds, True, EPISODE_STEPS, with_rows, False, keep=keep)
        case "EpisodeRows", number, each, episode, step:
            return fake_rows(number.value, each.value, episode, step)
        case "Evaluated", number, each, returns:
            return evaluated(number.value, each.value, returns)
    raise AssertionError(content)


def described(number: int, of_ticket: int) -> Described:
    """The answer to an order to describe the environment."""
    return Described(number, of_ticket, DESCRIPTION)


def evaluated(number: int, of_ticket: int, returns: tuple[float, ...]) -> Evaluated:
    """An answer with episodes of these returns."""
    episodes = tuple(Episode(each, EPISODE_STEPS, 0.0) for each in returns)
    return Evaluated(number, of_ticket, episodes, (False,) * len(episodes))


def rollout_content(message: Rollout) -> Content:
    return session(message.session), message.lane, ticket(message.ticket), message.version, message.sequence


def rollout_of(content: Content) -> Rollout:
    number, lane, of_ticket, version, sequence = content
    return rollout(number.value, lane, of_ticket.value, version, sequence)


def _received(received: tuple[Received, ...]) -> Content:
    lanes = sorted(received, key=lambda each: each.lane)
    return tuple((r.lane, incarnation(r.lane, r.incarnation), r.next_sequence, tuple(sorted(r.out_of_order))) for r in lanes)


def _received_of(content: Content) -> tuple[Received, ...]:
    return tuple(Received(lane, number.value, following, out) for lane, number, following, out in content)
