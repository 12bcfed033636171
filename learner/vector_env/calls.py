"""`call`, `get_attr`, `set_attr` and descriptions of copies: what to send to each lane, and what its answer means. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from learner.vector_env.batch_layout import BatchLayout
from learner.vector_env.lane_orders import call_order
from learner.vector_env.order_coordinator import MakeOrder
from protocol.bounds import MAX_LINE, one_line
from protocol.envs.description import DescribedEnv, read_description
from protocol.errors import BadMessage, EnvironmentFailed, UsageError
from protocol.messages import Answer, Described, Returned
from protocol.wire.codec import decode_to_learner
from protocol.wire.plain_values import unpack

USE_INSTEAD = ("reset", "step", "close")
"""Methods of an environment that only the vector environment may call."""


def call_orders(
    layout: BatchLayout, copies: Sequence[int], name: str, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> dict[int, MakeOrder]:
    """Orders by lane that call, or get, the attribute of these copies.

    Raises `ValueError` for `reset`, `step`, `close`; `UsageError` for a name and `TypeError` for arguments that no message
    can carry.
    """
    _check_name(name)
    if name in USE_INSTEAD:
        raise ValueError(f"call of {name!r}: use {name}() of the vector environment")
    return {
        lane: call_order(chosen, name, (args, kwargs), assign=False)
        for lane, chosen in layout.by_lane(sorted(copies)).items()
    }


def assign_orders(layout: BatchLayout, copies: Sequence[int], name: str, values: Sequence[Any]) -> dict[int, MakeOrder]:
    """Orders by lane that assign one value to each of these copies, which are in ascending order.

    Raises `UsageError` for a name and `TypeError` for a value that no message can carry.
    """
    _check_name(name)
    by_copy = dict(zip(copies, values, strict=True))
    return {
        lane: call_order(chosen, name, [by_copy[layout.copies(lane)[n]] for n in chosen], assign=True)
        for lane, chosen in layout.by_lane(copies).items()
    }


def _check_name(name: object) -> None:
    """Raise `UsageError` for what is no name of an attribute: a worker could not read the message."""
    if not isinstance(name, str) or not name or one_line(name) != name:
        got = one_line(repr(name), 60)
        raise UsageError(f"call: expected the name of an attribute, text of 1 to {MAX_LINE:,} characters, got {got}")


def call_results(name: str, answers: Mapping[int, Answer]) -> tuple[Any, ...]:
    """The results of all lanes, in the order of the copies. Raises what `call_error` says if an environment raised."""
    results: list[Any] = []
    for lane in sorted(answers):
        answer = answers[lane]
        assert isinstance(answer, Returned)
        if answer.error:
            raise call_error(name, lane, answer)
        results += unpack(answer.results.data)
    return tuple(results)


def described_copies(answer: Answer, count: int) -> list[DescribedEnv | None]:
    """What each of a lane's `count` copies is; None where the client cannot say it. Raises `BadMessage`."""
    assert isinstance(answer, Returned)
    if answer.error:
        return [None] * count
    sent, found = unpack(answer.results.data), dict[tuple[bytes, ...], DescribedEnv]()
    for frames in sent:
        if not isinstance(frames, list) or not all(type(frame) is bytes for frame in frames):
            raise BadMessage(f"expected the frames of a message, got {type(frames).__name__}")
        if tuple(frames) not in found:
            message = decode_to_learner(frames)
            if not isinstance(message, Described):
                raise BadMessage(f"expected Described, got {type(message).__name__}")
            found[tuple(frames)] = read_description(message.description)
    return [found[tuple(frames)] for frames in sent]


def call_error(name: str, lane: int, answer: Returned) -> Exception:
    """The exception of a call, with the worker's traceback. An `AttributeError` keeps its type, as `hasattr` needs it."""
    line = f"call of {name!r}, lane {lane}: {answer.error}"
    missing = answer.error.startswith("AttributeError")
    error: Exception = AttributeError(line) if missing else EnvironmentFailed(line, answer.traceback)
    error.add_note(answer.traceback)
    return error
