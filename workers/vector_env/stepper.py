"""A worker's part of a vector environment: it has lanes of env copies, and executes the orders for them, one at a time.

Orders arrive as messages. If this process has inherited shared memory, orders to step may arrive there instead; the results
are then written there too. Both kinds of orders step the same lanes. A lane whose copies can no longer be used is closed.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from millrace.protocol.bounds import Stages, last_text, one_line
from millrace.protocol.errors import UsageError, first_line
from millrace.protocol.machine.cpu_cores import usable_cores
from millrace.protocol.messages import DESCRIPTION, Answer, Array, Call, Described, Order, Reset, Returned, Step, Stepped
from millrace.protocol.specs import StepSpec
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.plain_values import pack_each, unpack
from millrace.protocol.wire.shared_memory import InheritedDescriptors, SharedMemory
from millrace.protocol.wire.wake_up import CAN_SPIN, SPIN_S, SpinWait, WakePipe, WakeReason
from millrace.workers.activity import STEPPING, activity
from millrace.workers.copies.env_errors import CopyFailed, environment_failed, environment_failures
from millrace.workers.copies.env_loop import CopyInfos, Pulse
from millrace.workers.copies.open_lanes import OpenLanes
from millrace.workers.vector_env.seated_lane import SeatedLane
from millrace.workers.vector_env.stepped_lane import ResultRows, SteppedLane, new_rows


class Stepper:
    """Executes orders on lanes of env copies. A lane is made when its first order arrives."""

    def __init__(
        self, spec: StepSpec, shared_memory: InheritedDescriptors | None = None, *, allow_private_names: bool = True
    ) -> None:
        """`shared_memory` has the file descriptors of shared memory and wake pipes, if this process inherited them.

        `allow_private_names` says whether a Call may use names that begin with an underscore.
        """
        self.steps = 0
        """number of env steps made"""
        self.stages: Stages = {"open": 0.0, "step": 0.0}
        """seconds spent making and resetting copies (`open`), and stepping them (`step`)"""
        self._spec = spec
        self._allow_private_names = allow_private_names
        self.lanes = OpenLanes[SteppedLane]()
        """the lanes that have been made and not been closed"""
        self._memory = None if shared_memory is None else SharedMemory(spec, shared_memory.memory)
        self._wake_in = None if shared_memory is None else WakePipe(read_fd=shared_memory.to_worker)
        self._wake_out = None if shared_memory is None else WakePipe(write_fd=shared_memory.to_learner)
        self._cores = usable_cores()
        self._awake = SpinWait()
        self._spin_s = 0.0  # how long to spin before the next wait for the wake pipe

    def execute(self, order: Order, pulse: Pulse) -> Answer:  # rules ORDER_ANSWERED, ORDER_ONLY
        """Execute an order, and return the answer.

        Raises `EnvironmentFailed` if the environment raises, and whatever `pulse` raises; the lane is then closed.
        """
        try:
            with environment_failures(order.lane), self.lanes.in_use():
                lane = self._lane_for(order.lane, order.incarnation, pulse)
                match order:
                    case Reset():
                        began = perf_counter()
                        infos = lane.reset(order.copies, order.seeds, unpack(order.options.data, len(order.copies)), pulse)
                        self.stages["open"] += perf_counter() - began
                    case Step():
                        infos = self._step(lane, order.actions, pulse)
                    case Call():
                        return _call(order, lane, self._allow_private_names)
                packed = pack_infos(infos)
        except BaseException:
            self.lanes.close([order.lane])
            raise
        return _stepped(order, lane.rows, packed)

    def serve_shared_memory(self, timeout_s: float, pulse: Pulse, session: int, send: Callable[[Stepped], None]) -> bool:
        """Execute the orders in shared memory for `timeout_s` seconds. Returns True early if the wake pipe announces a
        message.

        Checking the memory in a loop (spinning) is faster than waiting for the pipe. At most `cores - 1` workers spin: those
        that finish first. The last worker wakes the learner and does not spin, so that its core is free for the learner.
        """
        assert self._memory is not None
        assert self._wake_in is not None
        until = perf_counter() + timeout_s
        while True:
            stepped = [self._serve_lane(lane, pulse, session, send) for lane in list(self.lanes) if lane in self.lanes]
            if any(stepped):
                if perf_counter() > until:
                    return False
                self._awake.wait(self._has_order, self._spin_s)
                continue
            announced = self._wake_in.wait(max(0.0, until - perf_counter()))
            if announced is not WakeReason.STEP:
                return announced is WakeReason.MESSAGE

    @property
    def uses_shared_memory(self) -> bool:
        """Whether this process has lanes whose orders arrive in shared memory."""
        return self._memory is not None and bool(self.lanes)

    def _has_order(self) -> bool:
        assert self._memory is not None
        return any(self._memory.ordered(number) != lane.executed for number, lane in self.lanes.items())

    def _serve_lane(self, number: int, pulse: Pulse, session: int, send: Callable[[Stepped], None]) -> bool:
        memory = self._memory
        lane = self.lanes[number]
        assert memory is not None
        assert self._wake_out is not None
        order = memory.ordered(number)
        if order == lane.executed:
            return False
        lane.executed = order
        try:
            with self.lanes.in_use():
                infos = pack_infos(self._step(lane, memory.lanes[number].actions, pulse))
        except CopyFailed as error:
            self.lanes.close([number])
            raise environment_failed(number, error) from error
        if number not in self.lanes:
            return True  # the lane was released in the meantime, and another worker may have it now
        if not memory.answer(number, order, infos):
            step = Step(session, -order, number, lane.incarnation, ())
            send(_stepped(step, lane.rows, infos))
        pending = memory.unanswered_orders()
        if not pending or not CAN_SPIN or memory.wakes(number):
            self._wake_out.wake()
        finished_before = len(memory.lanes) - len(self.lanes) - pending
        self._spin_s = SPIN_S if finished_before < self._cores - 1 else 0.0
        return True

    def close(self) -> None:
        """Close all env copies."""
        self.lanes.close_all()

    def _step(self, lane: SteppedLane, actions: Iterable[Array], pulse: Pulse) -> CopyInfos:
        began = perf_counter()
        # The actions are copied, because an environment may keep its action, or change it.
        infos = lane.step([array.copy() for array in actions], pulse)
        self.steps += lane.count
        self.stages["step"] += perf_counter() - began
        return infos

    def _lane_for(self, number: int, incarnation: int, pulse: Pulse) -> SteppedLane:
        """The lane in this incarnation, for an order that arrived as a message. If the lane doesn't exist, it is made."""
        lane = self.lanes.here(number, incarnation)
        if lane is None:
            began = perf_counter()
            kind = SeatedLane if self._spec.seats else SteppedLane
            lane = self.lanes.open(number, lambda: kind(self._spec, number, incarnation, self._rows(number), pulse))
            self.stages["open"] += perf_counter() - began
        if self._memory is not None:
            # A lane has one order at a time, so a step in the memory is finished or was abandoned before this order.
            lane.executed = self._memory.ordered(number)
        return lane

    def _rows(self, lane: int) -> ResultRows:
        if self._memory is None:
            return new_rows(self._spec, lane)
        memory = self._memory.lanes[lane]
        return ResultRows(memory.obs, memory.reward, memory.terminated, memory.truncated)


def pack_infos(infos: CopyInfos) -> bytes:
    """Pack the infos as bytes; empty if there are none. Values that aren't plain arrive as numbers or as their `repr`.

    Raises `CopyFailed` if an object in them raises.
    """
    try:
        return pack_each(infos, use_repr=True) if infos else b""
    except Exception as error:  # user-defined keys and dicts raise anything
        raise CopyFailed(None, "infos") from error


def _array(data: bytes) -> npt.NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)


def _stepped(order: Reset | Step, rows: ResultRows, infos: bytes) -> Stepped:  # rule STEPPED_ARRAYS
    """The answer to an order. Its arrays are copies, because it may have to be sent again later."""
    return Stepped(
        session=order.session,
        ticket=order.ticket,
        lane=order.lane,
        incarnation=order.incarnation,
        obs=tuple(array.copy() for array in rows.obs),
        reward=rows.reward.copy(),
        terminated=rows.terminated.copy(),
        truncated=rows.truncated.copy(),
        infos=_array(infos),
    )


def _private_name(order: Call, arguments: Any) -> str:
    """The private name that a call uses: its own name, or the name that it passes to a method of gymnasium. Empty if
    there is none.
    """
    names = [order.name]
    if order.name in ("get_wrapper_attr", "has_wrapper_attr", "set_wrapper_attr") and not order.assign:
        args, kwargs = arguments
        names += [str(name) for name in (*args[:1], kwargs.get("name", ""))]
    return next((name for name in names if name.startswith("_")), "")


def _call(order: Call, lane: SteppedLane, allow_private_names: bool) -> Returned:  # rule RETURNED
    """Execute a call. The answer contains the results, or, if the call raises, the exception."""
    results: list[Any] = []
    error = detail = ""
    try:
        arguments = unpack(order.given.data, len(order.copies))
        if (private := _private_name(order, arguments)) and not allow_private_names:
            raise UsageError(
                f"{private[:40]!r} begins with an underscore: this worker gives private attributes only to a learner "
                "that it trusts; start the worker with a token, and without --no-code"
            )
        with activity().during(STEPPING):
            if order.name == DESCRIPTION:
                described = [Described(order.session, order.ticket, each) for each in lane.describe(order.copies)]
                results = [[bytes(frame) for frame in encode(each)] for each in described]
            elif order.assign:
                lane.assign(order.copies, order.name, arguments)
            else:
                results = lane.call(order.copies, order.name, *arguments)
        packed = pack_each(results)
    except BaseException as raised:
        packed = b""
        error = one_line(f"{type(raised).__name__}: {first_line(raised)}")
        detail = last_text(traceback.format_exc())
    return Returned(order.session, order.ticket, order.lane, order.incarnation, _array(packed), error, detail)
