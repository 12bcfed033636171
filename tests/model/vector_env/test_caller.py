"""The model's program does what `ZmqVectorEnv` does: both see the same messages, and send the same orders.

Rule: a real `ZmqVectorEnv`, with its hub, makes random calls on a hostile network; what its coordinator heard, and when its
hub took a turn, is then told to the model's `Caller`.
"""

from __future__ import annotations

import random
from collections import Counter, deque
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import pytest

from learner.members.membership import Outgoing
from learner.vector_env import send_recv, step_hub
from learner.vector_env.env import ZmqVectorEnv
from learner.vector_env.order_coordinator import MakeOrder, OrderCoordinator
from learner.vector_env.spec import VectorEnvDescription
from learner.vector_env.step_hub import StepHub
from protocol.errors import NoWorkers, WorkerLost
from protocol.messages import Reset, ToLearner, ToWorker
from protocol.wire.codec import Buffer, decode_to_worker
from tests.model.settings import TIMEOUT_S
from tests.model.vector_env.caller import REPLACED, Caller
from tests.model.vector_env.order_content import content_of
from tests.model.vector_env.stepping import Stepping
from tests.model.vector_env.worker_half import Worker
from tests.support.fake_link import FakeLink

LANES, CALLS = 2, 12


class Wire(FakeLink):
    """Workers of the model behind a hostile network. Time passes while the hub waits, and one message arrives at a time."""

    def __init__(self, settings: Stepping, fate: random.Random) -> None:
        super().__init__()
        self.settings, self.fate, self.now = settings, fate, 0.0
        self.workers = [Worker(number, 0) for number in range(settings.workers)]
        self.down: list[deque[ToWorker]] = [deque() for _ in self.workers]
        self.up: deque[tuple[bytes, ToLearner]] = deque()

    def poll(self, timeout_s: float) -> bool:
        if timeout_s:
            self.now += 2 * timeout_s
            for worker in self.workers:
                self._live(worker)
            if self.up and self.fate.random() < 0.8:
                self.inbox.append(self.up.popleft())
        return bool(self.inbox)

    def send(self, peer: bytes, frames: Sequence[Buffer]) -> bool:
        number = int(peer[1:])
        if self.workers[number].session is not None and self.fate.random() > 0.02:
            self.down[number].append(decode_to_worker(frames))
        return True

    def _live(self, worker: Worker) -> None:
        draw, down = self.fate.random(), self.down[worker.number]
        if worker.session is None:
            if draw < 0.2:
                self._do(worker, "start")
        elif draw < 0.01:
            down.clear()
            self._do(worker, "end")
        elif draw < 0.02 or (worker.frozen and draw < 0.1):
            self._do(worker, "thaw" if worker.frozen else "freeze")
        elif not worker.frozen:
            self._do(worker, "time")
            if worker.work is not None and draw < 0.7:
                self._do(worker, "finish")
            while down and worker.session is not None and self.fate.random() < 0.8:
                self._do(worker, "handle", down.popleft())

    def _do(self, worker: Worker, what: str, message: ToWorker | None = None) -> None:
        content = None if message is None else content_of(message, worker.number)
        event = (what, 0) if what == "handle" else (what,)
        for said in worker.event(event, content, self.settings, self.now):
            if self.fate.random() > 0.02:
                self.up.append((b"w%d" % worker.number, said))


class Heard(OrderCoordinator):
    """Notes what it hears and the orders that it sends."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.noted: list[tuple[Any, ...]] = []
        self.orders_sent: list[tuple[Any, ...]] = []

    def receive(self, peer: bytes, message: ToLearner, now: float) -> list[Outgoing]:
        self.noted.append(("receive", peer, message, now))
        return super().receive(peer, message, now)

    def remove_silent(self, now: float) -> list[Outgoing]:
        self.noted.append(("remove_silent", now))
        return super().remove_silent(now)

    def rebalance(self) -> list[Outgoing]:
        self.noted.append(("call", "reset"))
        return super().rebalance()

    def order(self, lane: int, make_order: MakeOrder) -> list[Outgoing]:
        out = super().order(lane, make_order)
        self.orders_sent.append(described(out[0]))
        return out


def described(sent: Outgoing) -> tuple[Any, ...]:
    peer, order = sent
    of_lane: Any = order
    seeds = order.seeds if isinstance(order, Reset) else ()
    return peer, type(order).__name__, of_lane.session, of_lane.ticket, of_lane.lane, of_lane.incarnation, seeds


def real_calls(settings: Stepping, fate: random.Random, outcomes: Counter[str]) -> Heard:
    """Make the calls with a real vector environment. Returns what its coordinator noted."""
    wire = Wire(settings, fate)
    hub = StepHub(wire, settings.run, first_session=0, worker_timeout_s=TIMEOUT_S, clock=lambda: wire.now)  # type: ignore[arg-type]
    heard: Any = hub._coordinator
    turn = hub._turn

    def noted_turn(timeout_s: float) -> None:
        turn(timeout_s)
        heard.noted.append(("turn", wire.now))

    hub._turn = noted_turn  # type: ignore[method-assign]
    space = gymnasium.spaces.Box(-1, 1000, (1,), np.float32)
    description = VectorEnvDescription(settings.run, space, gymnasium.spaces.Discrete(2), {}, None, None)
    env = ZmqVectorEnv(description, hub, timeout_s=settings.call_timeout_s)
    at = 0
    while at < len(settings.calls):
        call = settings.calls[at]
        try:
            if call != "reset":
                heard.noted.append(("call", call))
            match call:
                case "reset":
                    env.reset(seed=[at] * LANES)
                case "step":
                    _, _, _, truncated, _ = env.step(np.zeros(LANES, np.int64))
                    outcomes["steps with a loss"] += bool(truncated.any())
                case "call":
                    env.call("state")
            at += 1
        except NoWorkers:
            outcomes[f"{call}: NoWorkers"] += 1
        except WorkerLost:
            outcomes[f"{call}: WorkerLost"] += 1
            at += call == "call"
    return heard  # type: ignore[no-any-return]


def told(settings: Stepping, heard: Heard) -> Caller:
    """The model's program after the same events."""
    caller = Caller(OrderCoordinator(settings.run, 0, TIMEOUT_S), settings, 0.0)
    for event in heard.noted:
        match event:
            case "receive", peer, message, now:
                caller.now = now
                caller.server.send(caller.coordinator.receive(peer, message, now))
            case "remove_silent", now:
                caller.now = now
                caller.server.send(caller.coordinator.remove_silent(now))
            case "turn", now:
                caller.now = now
                caller.turn()
                caller.give_up_if_late()
            case "call", kind:
                assert settings.calls[caller.at] == kind, "the model's program is at another call"
                assert caller.deadline_s is None, "the model's program still waits"
                caller.go_on()
    return caller


def test_the_model_of_a_program_sends_what_a_vector_environment_sends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(step_hub, "OrderCoordinator", Heard)
    monkeypatch.setattr(send_recv, "replacement_seeds", lambda seeds, incarnation: (REPLACED,) * len(tuple(seeds)))
    outcomes: Counter[str] = Counter()
    for seed in range(40):
        fate = random.Random(seed)
        calls = ("reset", "step", *fate.choices(["reset", "step", "call"], [1, 5, 2], k=CALLS - 2))
        settings = Stepping(workers=2, lanes=LANES, calls=calls, faults=1)
        heard = real_calls(settings, fate, outcomes)
        caller = told(settings, heard)
        sent = [described(each) for each in caller.server.sent if type(each[1]).__name__ in ("Reset", "Step", "Call")]
        resent = Counter(heard.orders_sent)
        assert list(dict.fromkeys(sent)) == heard.orders_sent, f"seed {seed}"
        assert max(resent.values()) == 1
        assert caller.at == len(calls), f"seed {seed}"
    assert outcomes["steps with a loss"] > 10, outcomes
    assert outcomes["call: WorkerLost"] > 0, outcomes
    assert outcomes.total() > 20, outcomes
