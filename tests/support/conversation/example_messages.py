"""A good message of any kind, of which a test says only the fields that it is about.

Rule: what is not said follows from the field's type, so a new field of a message touches no test that is not about it.
"""

from __future__ import annotations

from functools import cache
from typing import Any, TypeVar

import msgspec
import msgspec.inspect as mi
import numpy as np

from millrace.protocol.messages import PROTOCOL_VERSION, Evaluate, Hello, Weights, Welcome
from millrace.protocol.specs import WaitSpec

M = TypeVar("M", bound=msgspec.Struct)

SAID: dict[type, dict[str, Any]] = {
    Hello: {
        "protocol": PROTOCOL_VERSION,
        "worker": "w0",
        "host": "host",
        "pid": 1,
        "process_nonce": 1,
        "software": "fake",
        "attempt": 1,
        "continues": True,
    },
    Weights: {"parameters": np.zeros(1, np.float32), "buffers": np.zeros(0, np.float32)},
    Welcome: {"run": WaitSpec()},
    Evaluate: {"seeds": (1,), "most_steps": 100},
}
"""What the type does not say: fields without which nothing could be done with the message."""


def example(kind: type[M], /, **said: object) -> M:
    """A message, or a record inside one, with these fields; the others are as small as their types allow."""
    return kind(**{**_unsaid(kind), **said})


def example_of_session(kind: type[M], session: int) -> M:
    """A message of which a test needs no more than that it is of this session, if messages of its kind are of one."""
    return example(kind, **({"session": session} if "session" in kind.__struct_fields__ else {}))


@cache
def _unsaid(kind: type[msgspec.Struct]) -> dict[str, Any]:
    """The fields that must be given, by name."""
    record = mi.type_info(kind)
    assert isinstance(record, mi.StructType)
    required = {field.name: field.type for field in record.fields if field.required}
    return {name: _least(of_field) for name, of_field in required.items()} | SAID.get(kind, {})


def _least(kind: mi.Type) -> Any:
    """The smallest value of a type. An array has no element."""
    match kind:
        case mi.BoolType():
            return False
        case mi.IntType(ge=least):
            return max(0, least or 0)
        case mi.FloatType():
            return 0.0
        case mi.StrType():
            return ""
        case mi.LiteralType(values=values):
            return values[0]
        case mi.VarTupleType(item_type=inner, min_length=least):
            return (_least(inner),) * (least or 0)
        case mi.DictType():
            return {}
        case mi.UnionType(types=types):
            return None if any(isinstance(each, mi.NoneType) for each in types) else _least(types[0])
        case mi.StructType(cls=record):
            return example(record)
        case mi.CustomType():
            return np.zeros(0, np.uint8)
    raise AssertionError(kind)
