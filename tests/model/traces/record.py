"""What is written of one call of a coordinator or a session: plain data, and messages as their frames or digests.

Rule: two messages with the same digest are the same, bit for bit. Of rollouts and weights, only what the two halves read is
kept besides the digest: they are large.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from millrace.learner.members.describe_coordinator import Unknown, accept_any
from millrace.learner.members.member import Member
from millrace.learner.members.membership import Membership
from millrace.learner.rollouts.ledger import Ledger
from millrace.learner.rollouts.opponent_pool import OpponentPool
from millrace.learner.rollouts.rollout_dealer import AcceptedRollout, RolloutDealer
from millrace.protocol.arrays import Array
from millrace.protocol.messages import Collect, Permit, Rollout, ToLearner, ToWorker, Weights
from millrace.protocol.wire.codec import decode_to_learner, decode_to_worker, encode
from millrace.workers.conversation.session import (
    BeginRun,
    CloseLanes,
    EvaluationTask,
    Leave,
    RolloutTask,
    SendMessage,
    StartSession,
)

SUFFIX = ".trace"
KEPT_WEIGHTS = 64  # digests of weights: the learner of a soak must not grow by them


class Record(NamedTuple):
    """One call."""

    at_s: float
    """when it had returned, by the monotonic clock, which all processes of a machine share"""
    part: str
    """class of the object that was called"""
    method: str
    arguments: tuple[Any, ...]
    keywords: dict[str, Any]
    result: Any


class Said(NamedTuple):
    """A message."""

    kind: str
    digest: bytes
    frames: tuple[bytes, ...] = ()
    """empty in results, because a replay makes them again"""


class SaidRollout(NamedTuple):
    """A rollout, without its arrays."""

    kind: str
    digest: bytes
    numbers: tuple[int, int, int, int, int]
    """session, lane, ticket, version, sequence"""
    env_steps: int
    is_bool: bool
    """whether `valid` has the right dtype"""
    wrong: str = ""
    """what is wrong with its rows, if the learner found something"""


class SaidWeights(NamedTuple):
    """Weights, without their arrays."""

    kind: str
    digest: bytes
    version: int


class SaidMember(NamedTuple):
    """A worker as the learner sees it, by its routing id."""

    peer: bytes


class SaidDealer(NamedTuple):
    """The dealer of rollouts of a new learner: how it is made."""

    lanes: int
    max_lag: int
    next_round: int
    versions: dict[int, int]
    """that act in open rounds"""
    continued: tuple[int, ...]
    """lanes with a past"""
    ledger: Ledger
    incarnations: tuple[int, ...]
    opponents: OpponentPool | None


class SaidWaiting(NamedTuple):
    """The workers that wait for the run: those of the `DescribeCoordinator` of this process."""


class Digests:
    """Digests of messages. A message that stands for a large one has the digest of that one."""

    def __init__(self) -> None:
        self.weights: dict[int, bytes] = {}
        """by version, of the weights that were published or received"""
        self._of: dict[int, tuple[Any, bytes]] = {}

    def published(self, version: int, digest: bytes) -> None:
        """Weights of this version have this digest. Those of much older versions are forgotten."""
        self.weights[version] = digest
        while len(self.weights) > KEPT_WEIGHTS:
            del self.weights[next(iter(self.weights))]

    def set(self, message: Any, digest: bytes) -> None:
        """The message stands for another one, which has the digest."""
        self._of[id(message)] = message, digest

    def of(self, message: ToLearner | ToWorker) -> bytes:
        """The digest."""
        found = self._of.get(id(message))
        if found is not None and found[0] is message:
            return found[1]
        if isinstance(message, Weights):
            if message.version not in self.weights:
                self.weights[message.version] = digest_of(message)
            return self.weights[message.version]
        return digest_of(message)

    def result(self, value: Any) -> Any:
        """What is written of the result of a call."""
        match value:
            case SendMessage(message):
                return type(message).__name__, self.of(message)
            case StartSession() | BeginRun():
                return type(value).__name__
            case CloseLanes(lanes):
                return "CloseLanes", lanes
            case Leave():
                return "Leave", value.exit_code, value.reason
            case RolloutTask():
                without_pasts = tuple(map(_without_past, value.permits))
                return "RolloutTask", value.session, value.weights.version, without_pasts
            case EvaluationTask():
                return "EvaluationTask", value.weights.version, self.of(value.order)
            case AcceptedRollout():
                return value.rollout.ticket, value.rollout.version, value.incarnation
            case list() | tuple():
                return tuple(self.result(each) for each in value)
            case None | bool() | int() | float() | str() | bytes():
                return value
        if isinstance(value, ToLearner | ToWorker):
            return type(value).__name__, self.of(value)
        return type(value).__name__


def digest_of(message: ToLearner | ToWorker) -> bytes:
    """Digest of all that the message says, unpacked, but for the pasts of lanes: a trace has no rows to make them of."""
    if isinstance(message, Collect):
        message = msgspec.structs.replace(message, permits=tuple(map(_without_past, message.permits)))
    found = blake2b(digest_size=8)
    for frame in encode(message):
        found.update(len(frame).to_bytes(8, "little"))
        found.update(frame)
    return found.digest()


def _without_past(permit: Permit) -> Permit:
    return msgspec.structs.replace(permit, past=None)


def argument(value: Any) -> Any:
    """What is written of an argument."""
    match value:
        case Rollout():
            numbers = value.session, value.lane, value.ticket, value.version, value.sequence
            is_bool = value.valid.dtype == bool
            return SaidRollout("Rollout", digest_of(value), numbers, value.env_steps, bool(is_bool))
        case Weights():
            return SaidWeights("Weights", digest_of(value), value.version)
        case Member():
            return SaidMember(value.peer)
        case Membership():
            return SaidWaiting()
        case RolloutDealer():
            lanes, rounds = len(value.lanes), value.rounds
            incarnations = tuple(RolloutDealer.incarnations(value))  # a call of `value` itself would be recorded
            opponents = deepcopy(value.opponents)
            versions = dict(rounds.versions)
            continued = tuple(past.lane for past in value.histories.pasts)
            ledger = value.ledger.copy()
            return SaidDealer(lanes, rounds.max_lag, rounds.next, versions, continued, ledger, incarnations, opponents)
        case Unknown():
            return replace(value, accept=accept_any)  # all that was asked for was accepted
        case AcceptedRollout():
            return value.rollout.ticket
        case list():
            return [argument(each) for each in value]
        case np.ndarray():
            return None
    if isinstance(value, ToLearner | ToWorker):
        return Said(type(value).__name__, digest_of(value), tuple(bytes(frame) for frame in encode(value)))
    return value if not callable(value) or isinstance(value, type) else None


def message_of(said: Any, digests: Digests, *, to_learner: bool) -> Any:
    """A message that says the same as far as the two halves read it."""
    match said:
        case SaidRollout():
            message: Any = _rollout(said)
        case SaidWeights():
            message = Weights(said.version, np.zeros(1, np.float32), np.zeros(0, np.float32))
            digests.published(said.version, said.digest)
        case Said():
            return decode_to_learner(said.frames) if to_learner else decode_to_worker(said.frames)
        case _:
            return said
    digests.set(message, said.digest)
    return message


def _rollout(said: SaidRollout) -> Rollout:
    nothing: Array = np.zeros(0, np.float32)
    session, lane, ticket, version, sequence = said.numbers
    valid = np.ones((max(said.env_steps, 1), 1), bool if said.is_bool else np.int8)
    valid[said.env_steps :] = 0
    return Rollout(
        session=session,
        lane=lane,
        ticket=ticket,
        version=version,
        sequence=sequence,
        obs=(),
        action=np.zeros(valid.shape, np.int64),
        log_prob=nothing,
        reward=nothing,
        terminated=np.zeros(valid.shape, bool),
        truncated=np.zeros(valid.shape, bool),
        valid=valid,
        state=nothing,
    )


def read(path: Path) -> Iterator[Record]:
    """The records of a trace. The last one may be cut, if its process was killed."""
    with path.open("rb") as file:
        while True:
            try:
                yield Record(*pickle.load(file))
            except (EOFError, pickle.UnpicklingError):
                return
