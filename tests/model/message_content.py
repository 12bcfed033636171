"""Messages as plain tuples, which a state of the model can hold, and back.

Rule: only what the two halves read is kept: numbers, flags, and records of these. What is kept follows from the types of the
fields, and which numbers are names from the names of the fields (`NAMED`); so a new field of a message is in the model.
Texts, arrays, seconds by stage and descriptions of an environment are always the same. A rollout is one valid transition.
All that a worker remembers of its env copies is how many rollouts they have made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, TypeVar, get_args

import msgspec
import msgspec.inspect as mi
import numpy as np

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.messages import (
    Describe,
    Described,
    EpisodeRows,
    Evaluate,
    Evaluated,
    Hello,
    Rollout,
    ToLearner,
    ToWorker,
    Weights,
)
from millrace.protocol.rollout import Episode
from millrace.protocol.space_spec import DiscreteSpace, EnvDescription
from millrace.protocol.specs import RunSpec, StepSpec, WaitSpec
from millrace.protocol.wire.plain_values import pack
from tests.model.conversation import Content
from tests.model.names import FIRST_OF, Kind, Name, name
from tests.model.settings import TICK_S, TIMEOUT_S
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import (
    BUFFERS,
    PARAMETERS,
    fake_memory,
    fake_past,
    fake_rollout,
    fake_rows,
    place_of,
)

T = TypeVar("T")

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


# -------------------------------------------------------------------- fields

Read = Callable[[Any, Any, int], Any]
"""Takes a field's value, its record, and the number of the worker that sends or receives it. Returns its content."""

NAMED: Mapping[str, Read] = {
    "session": lambda value, record, worker: session(value),
    "ticket": lambda value, record, worker: ticket(value),
    "tickets": lambda value, record, worker: tuple(ticket(each) for each in sorted(value)),
    "incarnation": lambda value, record, worker: incarnation(record.lane, value),
    "replies": lambda value, record, worker: name(Kind.REPLIES, value, record.session),
    "number": lambda value, record, worker: name(Kind.REPLIES, value, record.session),
    "process_nonce": lambda value, record, worker: name(Kind.NONCE, value, worker),
    "attempt": lambda value, record, worker: name(Kind.ATTEMPT, value, worker),
    "received": lambda value, record, worker: tuple(sorted(fields_of(each, worker) for each in value)),
    "out_of_order": lambda value, record, worker: tuple(sorted(value)),
    "run": lambda value, record, worker: isinstance(value, WaitSpec),
    "past": lambda value, record, worker: None if value is None else place_of(value.memory),
    "memory": lambda value, record, worker: place_of(value),
}
MADE: Mapping[str, Callable[[Any, Mapping[str, Any]], Any]] = {
    "past": lambda place, kept: None if place is None else fake_past(kept["lane"], place),
    "memory": lambda place, kept: fake_memory(place),
}
"""What is made of the content of a field, from it and the fields before it."""
"""Fields whose numbers are names, whose order does not matter, or which say only whether the run is known."""
KINDS: Mapping[str, type] = {kind.__name__: kind for kind in (*get_args(ToLearner), *get_args(ToWorker))}
ROLLOUT = fake_rollout(0, 0, 0, 0, 0)
WEIGHTS = Weights(0, PARAMETERS, BUFFERS)
OTHERS: Mapping[type, Callable[[int, Mapping[str, Any]], Any]] = {
    Hello: lambda worker, kept: example(Hello, worker=f"w{worker}", software="model"),
    Rollout: lambda worker, kept: ROLLOUT,
    EpisodeRows: lambda worker, kept: fake_rows(0, 0, 0, kept["first_step"]),
    Weights: lambda worker, kept: WEIGHTS,
    Describe: lambda worker, kept: Describe(0, 0, ENV),
    Described: lambda worker, kept: Described(0, 0, DESCRIPTION),
}
"""Messages with the fields that are not kept; those of other kinds are as small as they may be."""


def _plain(value: Any, record: Any, worker: int) -> Any:
    return value


def _records(value: Any, record: Any, worker: int) -> Any:
    return tuple(fields_of(each, worker) for each in value)


def _is_kept(kind: mi.Type) -> bool:
    """Whether values of this type are numbers, flags, or records of these."""
    match kind:
        case mi.IntType() | mi.BoolType() | mi.FloatType() | mi.NoneType():
            return True
        case mi.UnionType(types=types):
            return all(map(_is_kept, types))
        case mi.VarTupleType(item_type=inner):
            return _is_kept(inner)
        case mi.StructType(fields=fields):
            return all(field.name in NAMED or _is_kept(field.type) for field in fields)
    return False


@cache
def _kept(kind: Any) -> dict[str, Read]:
    """The fields of a record that are kept, in their order."""
    record = mi.type_info(kind)
    assert isinstance(record, mi.StructType)
    found: dict[str, Read] = {}
    for field in record.fields:
        if field.name in NAMED:
            found[field.name] = NAMED[field.name]
        elif _is_kept(field.type):
            holds_records = isinstance(field.type, mi.VarTupleType) and isinstance(field.type.item_type, mi.StructType)
            found[field.name] = _records if holds_records else _plain
    return found


@cache
def _inner(kind: type) -> dict[str, type]:
    """The records in the fields of a message, by field."""
    record = mi.type_info(kind)
    assert isinstance(record, mi.StructType)
    inner = {field.name: field.type.item_type for field in record.fields if isinstance(field.type, mi.VarTupleType)}
    return {field: of.cls for field, of in inner.items() if isinstance(of, mi.StructType) and _is_kept(of)}


def fields_of(record: Any, worker: int = 0) -> Content:
    """What is kept of a record: the contents of its fields, in their order."""
    kind: Any = type(record)
    return tuple([read(getattr(record, field), record, worker) for field, read in _kept(kind).items()])


def record_of(kind: type[T], content: Content) -> T:
    """The record with these fields, of which all are kept."""
    fields: Any = kind
    kept: dict[str, Any] = {}
    for field, value in zip(_kept(fields), content, strict=True):
        kept[field] = MADE[field](value, kept) if field in MADE else _value(value)
    return kind(**kept)


def _value(content: Any) -> Any:
    """Numbers in place of their names."""
    if isinstance(content, Name):
        return content.value
    return tuple(map(_value, content)) if isinstance(content, tuple) else content


# -------------------------------------------------------------------- messages


def content_of(message: ToLearner | ToWorker, worker: int) -> Content:
    """`worker`: the number of the worker that sends or receives it."""
    return type(message).__name__, *fields_of(message, worker)


def message_of(content: Content, worker: int, run: WaitSpec | RunSpec | StepSpec) -> Any:
    """The message of this content, from or to this worker. `run`: what a Welcome brings that does not let a worker wait."""
    kind, inner = KINDS[content[0]], _inner(KINDS[content[0]])
    kept: dict[str, Any] = {}
    for field, value in zip(_kept(kind), content[1:], strict=True):
        if field == "run":
            kept[field] = WAIT if value else run
        elif field in inner:
            kept[field] = tuple(record_of(inner[field], each) for each in value)
        elif field in MADE:
            kept[field] = MADE[field](value, kept)
        else:
            kept[field] = _value(value)
    if kind in OTHERS:
        return msgspec.structs.replace(OTHERS[kind](worker, kept), **kept)
    return example(kind, **kept)


@cache
def weights(version: int) -> Weights:
    return msgspec.structs.replace(WEIGHTS, version=version)


def hello(worker: int, nonce: int, attempt: int, *, evaluates: bool = False) -> Hello:
    """The Hello of this attempt of a process."""
    return example(Hello, worker=f"w{worker}", process_nonce=nonce, software="model", attempt=attempt, evaluates=evaluates)


def described(number: int, of_ticket: int) -> Described:
    """The answer to an order to describe the environment."""
    return Described(number, of_ticket, DESCRIPTION)


def evaluated(number: int, of_ticket: int, returns: tuple[float, ...]) -> Evaluated:
    """An answer with episodes of these returns."""
    episodes = tuple(Episode(each, EPISODE_STEPS, 0.0) for each in returns)
    return example(Evaluated, session=number, ticket=of_ticket, episodes=episodes, cut=(False,) * len(episodes))


def rollout_content(message: Rollout) -> Content:
    return fields_of(message)


@cache
def rollout_of(content: Content) -> Rollout:
    rollout: Rollout = message_of(("Rollout", *content), 0, WAIT)
    return rollout


def order_content(order: Evaluate) -> Content:
    """An order to evaluate, without the weights that it lists, which matter when it comes."""
    return content_of(msgspec.structs.replace(order, keep=()), 0)
