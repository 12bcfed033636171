"""A worker's part of a vector environment: the lanes that live here, and their orders obeyed, one at a time.

Orders come as messages; those to step may come through shared memory instead, if this process was handed it, and then what
the step gave is laid there, too. It is the same lane either way.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from protocol.cpu_cores import cores
from protocol.errors import UsageError, first_line
from protocol.messages import Answer, Array, Call, Order, Reset, Returned, Step, Stepped
from protocol.specs import StepSpec
from protocol.wire.plain_values import pack, unpack
from protocol.wire.shared_memory import MAY_SPIN, SPIN_S, Awake, Bell, Handed, Memory, Rung
from workers.env_errors import CopyRaised, lane_failed
from workers.env_loop import Infos, Pulse
from workers.step.stepped_lane import Rows, SteppedLane, new_rows

MAX_TRACEBACK = 20_000  # characters


class Stepper:
    """Env copies, lane by lane, made when their first order comes."""

    def __init__(self, spec: StepSpec, handed: Handed | None = None, *, private: bool = True) -> None:
        """`handed`: shared memory and bells; `private`: a Call may reach names that begin with an underscore."""
        self.steps = 0
        """env steps made"""
        self.stages = {"open": 0.0, "step": 0.0}
        """seconds spent making and resetting copies, and stepping them"""
        self._spec, self._private = spec, private
        self._lanes: dict[int, SteppedLane] = {}
        self._seen: dict[int, int] = {}  # lane -> the newest order through shared memory that is obeyed
        self._memory = None if handed is None else Memory(spec, handed.memory)
        self._called = None if handed is None else Bell(hears=handed.to_worker)
        self._calls = None if handed is None else Bell(rings=handed.to_learner)
        self._cores = cores()
        self._awake = Awake()
        self._spin_s = 0.0  # how long to wait awake for the next order

    def obey(self, order: Order, pulse: Pulse) -> Answer:
        """What comes of it. Raises `LaneFailed`, and what `pulse` raises: then the lane is closed."""
        try:
            lane = self._living(order.lane, order.incarnation, pulse)
            match order:
                case Reset():
                    began = perf_counter()
                    infos = lane.reset(order.copies, order.seeds, unpack(order.options.data), pulse)
                    self.stages["open"] += perf_counter() - began
                case Step():
                    infos = self._step(lane, order.actions, pulse)
                case Call():
                    return _call(order, lane, self._private)
        except CopyRaised as error:
            self.close([order.lane])
            raise lane_failed(order.lane, error.doing, error) from error
        except BaseException:
            self.close([order.lane])
            raise
        return _stepped(order, lane.rows, pack_infos(infos))

    def serve(self, timeout_s: float, pulse: Pulse, session: int, say: Callable[[Stepped], None]) -> bool:
        """Step whichever lanes shared memory asks for, until `timeout_s` have passed; True if it was rung for a message.

        Waiting awake is quicker, but of all workers only so many may that the learner has a core for itself. They are those
        that were done first: so the last one's core is free, and awake, when the learner is rung for.
        """
        assert self._memory is not None
        assert self._called is not None
        until = perf_counter() + timeout_s
        while True:
            served = [self._serve_lane(lane, pulse, session, say) for lane in list(self._lanes)]
            if any(served):
                if perf_counter() > until:
                    return False
                self._awake.wait(self._asked, self._spin_s)
                continue
            rung = self._called.wait(max(0.0, until - perf_counter()))
            if rung is not Rung.STEP:
                return rung is Rung.MESSAGE

    @property
    def shares(self) -> bool:
        """Whether `serve` has something to wait for."""
        return self._memory is not None and bool(self._lanes)

    def _asked(self) -> bool:
        assert self._memory is not None
        return any(self._memory.ordered(lane) != seen for lane, seen in self._seen.items())

    def _serve_lane(self, number: int, pulse: Pulse, session: int, say: Callable[[Stepped], None]) -> bool:
        memory, lane = self._memory, self._lanes[number]
        assert memory is not None
        assert self._calls is not None
        order = memory.ordered(number)
        if order == self._seen[number]:
            return False
        self._seen[number] = order
        try:
            # A copy of the actions: an environment may keep what it is given.
            infos = pack_infos(self._step(lane, [array.copy() for array in memory.lanes[number].actions], pulse))
        except CopyRaised as error:
            self.close([number])
            raise lane_failed(number, error.doing, error) from error
        if not memory.answer(number, order, infos):
            step = Step(session, -order, number, lane.incarnation, ())
            say(_stepped(step, lane.rows, infos))
        left = memory.under_way()
        if not left or not MAY_SPIN:
            self._calls.ring()
        done_before = len(memory.lanes) - len(self._lanes) - left
        self._spin_s = SPIN_S if done_before < self._cores - 1 else 0.0
        return True

    def _step(self, lane: SteppedLane, actions: Iterable[Array], pulse: Pulse) -> Infos:
        began = perf_counter()
        infos = lane.step(list(actions), pulse)
        self.steps += len(lane.rows.reward)
        self.stages["step"] += perf_counter() - began
        return infos

    def _living(self, number: int, incarnation: int, pulse: Pulse) -> SteppedLane:
        """The lane in this life, made if need be."""
        lane = self._lanes.get(number)
        if lane is not None and lane.incarnation == incarnation:
            return lane
        began = perf_counter()
        self.close([number])
        lane = SteppedLane(self._spec, number, incarnation, self._rows(number), pulse)
        self._lanes[number] = lane
        if self._memory is not None:
            self._seen[number] = self._memory.ordered(number)
        self.stages["open"] += perf_counter() - began
        return lane

    def _rows(self, lane: int) -> Rows:
        if self._memory is None:
            return new_rows(self._spec, lane)
        memory = self._memory.lanes[lane]
        return Rows(memory.obs, memory.reward, memory.terminated, memory.truncated)

    def close(self, lanes: Iterable[int]) -> None:
        """Let go of these lanes, those that are here."""
        for number in lanes:
            if (lane := self._lanes.pop(number, None)) is not None:
                lane.close()
                self._seen.pop(number, None)

    def close_all(self) -> None:
        """Let go of every lane."""
        self.close(list(self._lanes))


def pack_infos(infos: Infos) -> bytes:
    """Bytes; none for no infos."""
    return pack(infos, show=True) if infos else b""


def _array(data: bytes) -> npt.NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)


def _stepped(order: Reset | Step, rows: Rows, infos: bytes) -> Stepped:
    """The answer, of arrays of its own: it may be said again."""
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


def _call(order: Call, lane: SteppedLane, private: bool) -> Returned:
    """What the attribute gave, or the exception that it raised: that is an answer, too."""
    results: list[Any] = []
    error = detail = ""
    try:
        if order.name.startswith("_") and not private:
            raise UsageError(
                f"{order.name[:40]!r} begins with an underscore: this worker opens nothing private to a learner that it "
                "cannot be sure of; give it a token (and not --no-code)"
            )
        given = unpack(order.given.data)
        if order.assign:
            lane.assign(order.copies, order.name, given)
        else:
            results = lane.call(order.copies, order.name, *given)
        packed = pack(results)
    except Exception as raised:
        packed, error, detail = (
            b"",
            f"{type(raised).__name__}: {first_line(raised)}",
            traceback.format_exc()[-MAX_TRACEBACK:],
        )
    return Returned(order.session, order.ticket, order.lane, order.incarnation, _array(packed), error, detail)
