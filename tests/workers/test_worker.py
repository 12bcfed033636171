"""The shell round a session, over a link that is not real: which runs it takes part in, how it packs, what it acts under."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NoReturn, cast

import msgspec
import numpy as np
import pytest
from gymnasium.envs.classic_control import CartPoleEnv

from millrace.protocol.alive import NO_SLOT
from millrace.protocol.arrays import Array
from millrace.protocol.call_timeouts import OUR_CODE, CallTimeouts
from millrace.protocol.env_spec import AllowedCode, EnvSpec
from millrace.protocol.messages import (
    Collect,
    Describe,
    Drain,
    Failure,
    Goodbye,
    Hello,
    Inquire,
    Permit,
    Received,
    Rejoin,
    Rollout,
    ToLearner,
    ToWorker,
    Weights,
    Welcome,
)
from millrace.protocol.policy.layout import acting_size, buffer_size
from millrace.protocol.rollout import rollout_bytes
from millrace.protocol.specs import EncoderSpec, OwnPolicySpec, RunSpec, WaitSpec
from millrace.protocol.wire import codec
from millrace.protocol.wire.codec import Buffer, decode_to_learner, decode_to_worker, encode
from millrace.protocol.wire.compression import Packing
from millrace.protocol.wire.weight_dtypes import ActingDtype, to_float32, to_wire_dtype
from millrace.protocol.wire.worker_link import WorkerLink
from millrace.workers import machine_slots as slot_file
from millrace.workers.activity import ActivityReader, activity
from millrace.workers.actors import Actors, make_local_actors
from millrace.workers.conversation.session import Leave, Session
from millrace.workers.copy_slots import UNUSED_S
from millrace.workers.exit_codes import EXIT_UNSUITABLE
from millrace.workers.machine_slots import Slots
from millrace.workers.shared_weights import SharedWeights, SharedWeightsReader
from millrace.workers.worker import CONNECT_AGAIN_S, Worker, WorkerOptions, identity
from tests.support.conversation.example_messages import example
from tests.support.in_process.collectors import TOY, bits, collect, random_collector, run_of

RUN = msgspec.structs.replace(run_of("CartPole-v1", T=40, N=8), learner_timeout_s=1e9)


NO_SUCH = EnvSpec("tests.no_such_module:Env-v0")
SAYS = "environment tests.no_such_module:Env-v0: no module named tests.no_such_module; is it installed, or its folder on"


class FakeLink:
    """Says one message each time it is asked, and keeps what is answered."""

    address, problem, connected = "fake", None, False

    def __init__(self, messages: Sequence[ToWorker], stack: bool = False, zstd: bool = False) -> None:
        self.packing = Packing(stack, zstd)
        self.messages = list(messages)
        self.sent: list[list[Buffer]] = []

    def poll(self, timeout_s: float) -> bool:
        return bool(self.messages)

    def receive(self) -> Iterator[ToWorker]:
        yield self.messages.pop(0)

    def send(self, frames: list[Buffer]) -> None:
        self.sent.append(frames)

    def close(self) -> None:
        pass

    def heard(self, room: int = 0) -> list[ToLearner | Inquire]:
        return [decode_to_learner(frames, room) for frames in self.sent]


class Unanswered(FakeLink):
    """A connection that looks open, over which nothing comes. Its clock runs while the worker waits."""

    connected = True

    def __init__(self) -> None:
        super().__init__([])
        self.now = 0.0
        self.made_at: list[float] = []

    def poll(self, timeout_s: float) -> bool:
        self.now += timeout_s
        return super().poll(timeout_s)

    def connect_again(self) -> None:
        self.made_at.append(self.now)


def work(link: FakeLink, options: WorkerOptions | None = None) -> Leave:
    session = Session(replace(identity("w0"), process_nonce=0), 0.0)
    return Worker(cast(WorkerLink, link), session, options, clock=lambda: 0.0).run()


PARAMETERS = np.random.default_rng(0).normal(0, 0.1, acting_size(RUN.policy)).astype(np.float32)
BUFFERS = np.ones(buffer_size(RUN.policy), np.float32)


def said_to_a_worker(run: RunSpec, parameters: Array = PARAMETERS) -> list[ToWorker]:
    """To join, collect one rollout and leave."""
    permits, received = (example(Permit),), (Received(0, 0, 0),)
    return [
        Welcome(1, 1, run),
        Weights(0, parameters, BUFFERS),
        example(Collect, session=1, permits=permits, received=received),
        Drain("done"),
    ]


class Watching(FakeLink):
    """Weights do not come over it, but into the shared file, and wake the worker."""

    def __init__(self, messages: Sequence[ToWorker], shared: SharedWeights) -> None:
        super().__init__(messages)
        self.shared = shared

    def watch(self, fd: int) -> None:
        self.watched = fd

    def poll(self, timeout_s: float) -> bool:
        if self.messages and isinstance(weights := self.messages[0], Weights):
            self.messages.pop(0)
            self.shared.write(1, weights.version, encode(weights))
            assert select.select([self.watched], [], [], 0.0)[0]
            return False
        return super().poll(timeout_s)


def test_a_worker_acts_under_the_weights_that_its_supervisor_got_as_if_they_had_come_over_the_link() -> None:
    direct, shared = FakeLink(said_to_a_worker(RUN)), SharedWeights()
    assert work(direct).exit_code == 0
    welcome, weights, order, drain = said_to_a_worker(RUN)
    for said in ([welcome, weights, order, drain], [welcome, order, weights, drain]):
        link = Watching(said, shared)
        options = WorkerOptions(shared_weights=SharedWeightsReader(*shared.descriptors("w0")))
        assert work(link, options).exit_code == 0
        assert [bits(each) for each in link.heard() if isinstance(each, Rollout)] == [
            bits(each) for each in direct.heard() if isinstance(each, Rollout)
        ]
    shared.close()


def test_a_worker_compresses_if_the_run_and_its_link_let_it() -> None:
    rollouts, bytes_sent = [], []
    for run_may, link_may in ((True, False), (False, True), (True, True)):
        link = FakeLink(said_to_a_worker(msgspec.structs.replace(RUN, zstd=run_may)), zstd=link_may)
        assert work(link).exit_code == 0
        (rollout,) = (message for message in link.heard(rollout_bytes(RUN)) if isinstance(message, Rollout))
        without_times = msgspec.structs.replace(rollout, memory=())
        rollouts.append([bytes(frame) for frame in encode(without_times)[1:]])
        bytes_sent += [sum(map(len, frames)) for frames in link.sent if len(frames) > 1]
    assert rollouts[0] == rollouts[1] == rollouts[2]
    assert bytes_sent[0] == bytes_sent[1] > bytes_sent[2] / 0.75


def test_a_rollout_with_too_many_episodes_for_a_message_is_a_failure_with_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codec, "MAX_HEAD_BYTES", 8_000)
    run = run_of(f"{TOY}Countdown-v0", T=16, N=64, kwargs={"k": 1})
    *said, drain = said_to_a_worker(run, np.zeros(acting_size(run.policy), np.float32))
    drained = FakeLink([*said, drain])
    assert work(drained).exit_code == 0  # it leaves all the same
    assert isinstance(drained.heard()[-1], Goodbye)
    link = FakeLink(said)
    assert work(link).exit_code == 1
    failure = link.heard()[-1]
    assert isinstance(failure, Failure)
    assert failure.error.endswith(", for 512 episodes ended in it; take fewer rollout_steps, or more lanes")


def test_a_collector_that_cannot_be_made_is_a_failure_that_the_learner_hears() -> None:
    def no_device(run: RunSpec) -> NoReturn:
        raise RuntimeError("CUDA error: out of memory")

    link = FakeLink(said_to_a_worker(RUN))
    session = Session(replace(identity("w0"), process_nonce=0), 0.0)
    options = WorkerOptions(make_actors=no_device)
    assert Worker(cast(WorkerLink, link), session, options, clock=lambda: 0.0).run().exit_code == 1
    failure = link.heard()[-1]
    assert isinstance(failure, Failure)
    assert failure.error == "RuntimeError: CUDA error: out of memory"
    assert "in no_device" in failure.traceback


def test_a_worker_without_a_slot_leaves_without_a_failure_and_ends_when_there_is_room(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(slot_file, "WAIT_S", 0.0)
    monkeypatch.setattr(slot_file, "_of_processes", {os.getpid(): Slots(most=RUN.copies)})
    others, waited = Slots(), [0]
    others.take()

    def pause(seconds: float) -> None:
        waited[0] += 1
        others.give_back(0)

    monkeypatch.setattr(time, "sleep", pause)
    link = FakeLink(said_to_a_worker(RUN))
    assert work(link).exit_code == 1  # its supervisor starts it again
    assert waited == [1]
    goodbye = link.heard()[-1]
    assert isinstance(goodbye, Goodbye)
    assert goodbye.reason.startswith(NO_SLOT)


def test_a_worker_that_makes_its_policy_is_not_silent() -> None:
    doing = []

    def slow_imports(run: RunSpec) -> NoReturn:
        doing.append(ActivityReader(activity()).read(0.0).doing)
        raise ImportError("no module my_encoder")

    link = FakeLink(said_to_a_worker(RUN))
    options = WorkerOptions(make_actors=slow_imports)
    session = Session(replace(identity("w0"), process_nonce=0), 0.0)
    Worker(cast(WorkerLink, link), session, options, clock=lambda: 0.0).run()
    assert doing == ["preparing"]
    assert "preparing" not in OUR_CODE


def test_calls_may_take_as_long_as_the_newest_run_lets_them_before_any_of_its_environments_is_made() -> None:
    """The learner was started again with other timeouts: the worker joins it again, in the same process."""
    limits, watched = list[CallTimeouts](), list[CallTimeouts]()
    page = ActivityReader(activity())

    def note_limits(run: RunSpec) -> Actors:
        assert page.read(0.0).timeouts == watched[-1], "the watchdog does not know them yet"
        limits.append(watched[-1])
        return make_local_actors(run)

    runs = [msgspec.structs.replace(RUN, call_timeouts=CallTimeouts(each, 2 * each)) for each in (7.0, 3.0)]
    link = FakeLink([Welcome(1, 1, runs[0]), Rejoin(1), Welcome(2, 2, runs[1]), Drain("done")])
    options = WorkerOptions(make_actors=note_limits, feed_watchdog=lambda now: watched.append(page.read(0.0).timeouts))
    assert work(link, options).exit_code == 0
    assert limits == [CallTimeouts(7.0, 14.0), CallTimeouts(3.0, 6.0)]


def log_prob_under(parameters: Array, lane: int = 0) -> object:
    """Of the first rollout of this lane, as bytes."""
    collector = random_collector(RUN)
    collector.load(parameters, BUFFERS)
    return bits(collect(collector, RUN, lanes=[lane])[0])["log_prob"]


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_a_worker_acts_under_the_weights_that_travelled(dtype: ActingDtype) -> None:
    travelling = to_wire_dtype(PARAMETERS, dtype)
    (welcome, weights, *rest) = said_to_a_worker(RUN, travelling)
    link = FakeLink([welcome, decode_to_worker(encode(weights)), *rest])
    assert work(link).exit_code == 0
    (rollout,) = (message for message in link.heard() if isinstance(message, Rollout))
    assert rollout.log_prob.tobytes() == log_prob_under(to_float32(travelling))
    assert (rollout.log_prob.tobytes() == log_prob_under(PARAMETERS)) == (dtype == "float32")


class DrainsAfterTwo(FakeLink):
    """A link whose learner says Drain when two rollouts have come."""

    def send(self, frames: list[Buffer]) -> None:
        super().send(frames)
        if sum(len(each) > 1 for each in self.sent) == 2:
            self.messages.append(Drain("done"))


def test_each_rollout_of_a_worker_acts_under_the_weights_that_its_order_names() -> None:
    """Both versions are held before the first rollout starts."""
    received = (Received(0, 0, 0), Received(1, 0, 0))
    parameters = PARAMETERS, -PARAMETERS
    link = DrainsAfterTwo([Welcome(1, 1, RUN)])
    for version, each in enumerate(parameters):
        order = example(
            Collect, session=1, version=version, permits=(example(Permit, ticket=version, lane=version),), received=received
        )
        link.messages += [Weights(version, each, BUFFERS), order]
    assert work(link).exit_code == 0
    rollouts = [message for message in link.heard() if isinstance(message, Rollout)]
    assert [(rollout.lane, rollout.version) for rollout in rollouts] == [(0, 0), (1, 1)]
    assert [rollout.log_prob.tobytes() for rollout in rollouts] == [
        log_prob_under(each, lane) for lane, each in enumerate(parameters)
    ]


@pytest.mark.parametrize("looks_open", [True, False])
def test_a_connection_without_an_answer_is_made_again(looks_open: bool, caplog: pytest.LogCaptureFixture) -> None:
    """If none looks open, because there is no learner yet, this is not worth a line: it drops the Hellos that piled up."""
    link = Unanswered()
    link.connected = looks_open
    left = Worker(cast(WorkerLink, link), Session(identity("w0"), 0.0, join_timeout_s=50.0), clock=lambda: link.now).run()
    assert left.exit_code == 1
    assert [round(at) for at in link.made_at] == [20, 41]
    assert len(caplog.messages) == (2 if looks_open else 0)


def test_only_the_time_in_which_a_joining_worker_listens_is_time_without_an_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over a second connection its Hellos come while the learner may still read those that came over the first one."""
    link = Unanswered()
    link.messages = [Welcome(1, 1, msgspec.structs.replace(RUN, learner_timeout_s=30.0))]
    closed_at: list[float] = []

    def close(lanes: Iterable[int]) -> None:
        link.now += 100.0
        closed_at.append(link.now)

    def slow_to_close(run: RunSpec) -> Actors:
        actors = make_local_actors(run)
        monkeypatch.setattr(actors.lanes, "close", close)
        return actors

    session = Session(replace(identity("w0"), process_nonce=0), 0.0, rejoin_timeout_s=150.0)
    Worker(cast(WorkerLink, link), session, WorkerOptions(make_actors=slow_to_close), clock=lambda: link.now).run()
    assert [(at - closed_at[0]) // CONNECT_AGAIN_S for at in link.made_at] == [1, 2]


# ---------------------------------------------------------------------------------------- without the environment


@pytest.mark.parametrize(
    "said",
    [
        [Welcome(1, 1, WaitSpec()), Describe(1, 7, NO_SUCH)],
        said_to_a_worker(msgspec.structs.replace(RUN, env=NO_SUCH)),
    ],
    ids=["asked to describe it", "asked to collect"],
)
def test_a_worker_that_lacks_the_environment_declines_and_is_not_started_again(said: list[ToWorker]) -> None:
    """It was not asked to describe it, if another worker had joined earlier."""
    link = FakeLink(said)
    left = work(link)
    assert left.exit_code == EXIT_UNSUITABLE
    assert left.reason.startswith(SAYS)
    assert [type(message) for message in link.heard()] == [Hello, Goodbye]


MISSING = f"{__name__}_that_is_missing:made"
ENCODING = msgspec.structs.replace(RUN.policy, encoder=EncoderSpec(MISSING, (), 1))
ACTING = msgspec.structs.replace(RUN.policy, own=OwnPolicySpec(MISSING, ()))
WRAPPED = msgspec.structs.replace(RUN.env, wrappers=(MISSING,))


@pytest.mark.parametrize(
    ("called", "run"),
    [
        ("encoder", msgspec.structs.replace(RUN, policy=ENCODING)),
        ("policy", msgspec.structs.replace(RUN, policy=ACTING)),
        ("wrapper", msgspec.structs.replace(RUN, env=WRAPPED)),
    ],
)
def test_a_worker_that_lacks_a_module_of_the_run_declines_as_without_the_environment(called: str, run: RunSpec) -> None:
    link = FakeLink(said_to_a_worker(run))
    left = work(link, WorkerOptions(code=AllowedCode.CALLABLES))
    assert left.exit_code == EXIT_UNSUITABLE
    assert left.reason.startswith(f"{called} {MISSING}: no module named {MISSING.partition(':')[0]}")
    assert [type(message) for message in link.heard()] == [Hello, Goodbye]


def test_a_policy_that_is_there_and_cannot_be_made_is_a_failure_of_the_policy() -> None:
    own = OwnPolicySpec("builtins:int", (), kwargs={"no_such": 1})
    link = FakeLink(said_to_a_worker(msgspec.structs.replace(RUN, policy=msgspec.structs.replace(RUN.policy, own=own))))
    assert work(link, WorkerOptions(code=AllowedCode.CALLABLES)).exit_code == 1
    failure = link.heard()[-1]
    assert isinstance(failure, Failure)
    assert failure.of_policy


def test_a_worker_that_gets_no_lane_does_not_keep_the_copy_that_it_has_described(monkeypatch: pytest.MonkeyPatch) -> None:
    link = Unanswered()
    link.messages = [Welcome(1, 1, WaitSpec(learner_timeout_s=1e9)), Describe(1, 7, RUN.env), Welcome(1, 1, RUN)]
    closed_at: list[float] = []
    monkeypatch.setattr(CartPoleEnv, "close", lambda self: closed_at.append(link.now))
    session = Session(replace(identity("w0"), process_nonce=0), 0.0)
    stop = WorkerOptions(stop_requests=lambda: int(link.now > 3 * UNUSED_S))
    Worker(cast(WorkerLink, link), session, stop, clock=lambda: link.now).run()
    (at,) = closed_at
    assert UNUSED_S < at < UNUSED_S + 2.0


def test_the_copy_that_a_worker_has_described_is_the_first_of_its_lane(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[object] = []
    make = EnvSpec.make

    def counted(self: EnvSpec, render_mode: str | None = None) -> Any:
        made.append(self)
        return make(self, render_mode)

    welcome, *said = said_to_a_worker(RUN)
    alone = FakeLink([welcome, *said])
    work(alone)
    monkeypatch.setattr(EnvSpec, "make", counted)
    link = FakeLink([Welcome(1, 1, WaitSpec()), Describe(1, 7, RUN.env), welcome, *said])
    assert work(link).exit_code == 0
    assert len(made) == RUN.copies
    expected, found = (
        [message for message in each.heard(rollout_bytes(RUN)) if isinstance(message, Rollout)] for each in (alone, link)
    )
    assert [bits(rollout) for rollout in found] == [bits(rollout) for rollout in expected]
