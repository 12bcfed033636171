"""Calls env copies, and gets descriptions of them: makes the orders for each lane, and reads the answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from millrace.learner.vector_env.batch_layout import BatchLayout
from millrace.learner.vector_env.cut_short import CutShort
from millrace.learner.vector_env.lane_orders import call_order, packed, packed_each
from millrace.learner.vector_env.lost_lanes import RESET_ATTEMPTS
from millrace.learner.vector_env.order_coordinator import MakeOrder
from millrace.learner.vector_env.send_recv import SendRecv
from millrace.learner.vector_env.step_hub import StepHub
from millrace.protocol.bounds import MAX_COPIES, MAX_LINE, one_line
from millrace.protocol.envs.description import DescribedEnv, read_description
from millrace.protocol.errors import BadMessage, EnvironmentFailed, UsageError, WorkerLost, safe_repr
from millrace.protocol.messages import DESCRIPTION, Described, Returned
from millrace.protocol.wire.codec import decode_to_learner
from millrace.protocol.wire.plain_values import unpack

USE_INSTEAD = ("reset", "step", "close")
"""Methods of an environment that only the vector environment itself may call."""


class CopyCalls:
    """Calls, reads and sets attributes of a vector environment's env copies, and gets descriptions of the copies."""

    def __init__(
        self, send_recv: SendRecv, hub: StepHub, layout: BatchLayout, cut_short: CutShort, known: Mapping[str, Any]
    ) -> None:
        """`known` has the attributes that are equal in all copies and can't be sent, because they aren't plain data."""
        self.known = known
        self._cut_short = cut_short
        self._send_recv = send_recv
        self._hub = hub
        self._layout = layout

    def call(self, copies: Sequence[int], name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[Any, ...]:
        """Call a method of these copies, or get an attribute. The results are in ascending order of the copies.

        Raises the errors that `ZmqVectorEnv.call` raises.
        """
        if name in self.known:
            return (self.known[name],) * len(copies)
        return _results(name, self._answers(call_orders(self._layout, copies, name, args, kwargs)))

    def assign(self, copies: Sequence[int], name: str, values: Sequence[Any]) -> None:
        """Set an attribute of these copies, to one value each. `copies` are in ascending order."""
        _results(name, self._answers(assign_orders(self._layout, copies, name, values)))

    def describe(self, copies: Sequence[int]) -> list[DescribedEnv | None]:
        """Descriptions of these copies, in ascending order; None where a client cannot give one.

        Raises the errors that `call` raises.
        """
        described: list[DescribedEnv | None] = []
        for lane, answer in sorted(self._answers(call_orders(self._layout, copies, DESCRIPTION, (), {})).items()):
            count = len(self._layout.by_lane(copies)[lane])
            try:
                described += _descriptions(answer, count)
            except BadMessage as error:
                self._hub.refuse_owner(lane, f"lane {lane}: description cannot be read: {error}")
                described += [None] * count
        return described

    def make(self) -> list[DescribedEnv | None]:
        """Make all copies, before they are reset, and return their descriptions. Raises the errors that `call` raises."""
        for _ in range(RESET_ATTEMPTS - 1):
            with suppress(WorkerLost):  # another worker may be able to make them
                return self.describe(range(self._layout.count))
        return self.describe(range(self._layout.count))

    def _answers(self, orders: Mapping[int, MakeOrder]) -> dict[int, Returned]:
        lanes = list(orders)
        self._cut_short.check("call")
        self._send_recv.check_back(lanes)
        with self._cut_short:
            try:
                self._send_recv.call(orders)
                results = self._send_recv.recv_some(lanes).results  # only these lanes, because others may be stepping
            except Exception:
                self._send_recv.abandon(lanes)
                raise
        return {lane: result for lane, result in results.items() if isinstance(result, Returned)}


def call_orders(
    layout: BatchLayout, copies: Sequence[int], name: str, args: tuple[Any, ...], kwargs: dict[str, Any]
) -> dict[int, MakeOrder]:
    """Orders, by lane, that call or get an attribute of these copies.

    Raises `ValueError` for `reset`, `step` and `close`, `UsageError` for a name that no message can carry, and `TypeError`
    for arguments that no message can carry.
    """
    _check_name(name)
    if name in USE_INSTEAD:
        raise ValueError(f"call of {name!r}: use {name}() of the vector environment")
    given = packed((args, kwargs))
    return {lane: call_order(chosen, name, given, assign=False) for lane, chosen in layout.by_lane(sorted(copies)).items()}


def assign_orders(layout: BatchLayout, copies: Sequence[int], name: str, values: Sequence[Any]) -> dict[int, MakeOrder]:
    """Orders, by lane, that assign one value to each of these copies. `copies` are in ascending order.

    Raises `UsageError` for a name that no message can carry, and `TypeError` for a value that no message can carry.
    """
    _check_name(name)
    by_copy = dict(zip(copies, values, strict=True))
    return {
        lane: call_order(chosen, name, packed_each([by_copy[layout.copies(lane)[n]] for n in chosen]), assign=True)
        for lane, chosen in layout.by_lane(copies).items()
    }


def _check_name(name: object) -> None:
    """Raise `UsageError` for anything but the name of an attribute, because a worker could not read the message."""
    if not isinstance(name, str) or not name or one_line(name) != name:
        got = one_line(safe_repr(name), 60)
        raise UsageError(f"call: expected the name of an attribute, text of 1 to {MAX_LINE:,} characters, got {got}")


def _results(name: str, answers: Mapping[int, Returned]) -> tuple[Any, ...]:
    """The results of all lanes, in the order of the copies. If an environment raised, raises the exception of `_error`."""
    results: list[Any] = []
    for lane in sorted(answers):
        answer = answers[lane]
        if answer.error:
            raise _error(name, lane, answer)
        results += unpack(answer.results.data, MAX_COPIES)  # `order_coordinator.py` has checked it
    return tuple(results)


def _descriptions(answer: Returned, count: int) -> list[DescribedEnv | None]:
    """Descriptions of a lane's `count` copies; None for all if the client cannot give them.

    Raises `BadMessage` if they cannot be read.
    """
    if answer.error:
        return [None] * count
    sent = unpack(answer.results.data, count)
    described = dict[tuple[bytes, ...], DescribedEnv]()
    for frames in sent:
        if not isinstance(frames, list) or not all(type(frame) is bytes for frame in frames):
            raise BadMessage(f"expected the frames of a message, got {type(frames).__name__}")
        if tuple(frames) not in described:
            message = decode_to_learner(frames)
            if not isinstance(message, Described):
                raise BadMessage(f"expected Described, got {type(message).__name__}")
            described[tuple(frames)] = read_description(message.description)
    return [described[tuple(frames)] for frames in sent]


def _error(name: str, lane: int, answer: Returned) -> Exception:
    """The exception to raise for a call that failed, with the worker's traceback.

    An `AttributeError` keeps its type, because `hasattr` needs it.
    """
    line = f"call of {name!r}, lane {lane}: {answer.error}"
    failed = EnvironmentFailed(line, answer.traceback)
    if not answer.error.startswith("AttributeError"):
        return failed
    error = AttributeError(line)
    error.__cause__ = failed.__cause__
    return error
