"""Words in shared memory, wake pipes, and spinning."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.protocol.wire.shared_memory import SUPPORTED, SharedMemory, new_memory
from millrace.protocol.wire.wake_up import CAN_SPIN, SpinWait, WakePipe, WakeReason
from tests.support.in_process.described import step_spec

pytestmark = pytest.mark.skipif(not SUPPORTED, reason="needs Linux")


@pytest.fixture
def pipe() -> Iterator[WakePipe]:
    made = WakePipe()
    yield made
    made.close()


def test_a_wake_pipe_distinguishes_messages_from_steps_and_forgets_what_it_reported(pipe: WakePipe) -> None:
    assert pipe.wait(0) is WakeReason.NONE
    pipe.wake()
    pipe.wake(WakeReason.MESSAGE)
    pipe.wake()
    assert pipe.wait(0) is WakeReason.MESSAGE
    assert pipe.wait(0) is WakeReason.NONE
    pipe.wake()
    assert pipe.wait(0) is WakeReason.STEP


def test_waking_never_waits_and_never_fails(pipe: WakePipe) -> None:
    for _ in range(100_000):  # more than a pipe holds
        pipe.wake()
    assert pipe.wait(0) is WakeReason.STEP
    ours = WakePipe(write_fd=os.dup(pipe.write_fd))
    pipe.close()
    ours.wake()  # no reader is left
    ours.close()


def test_who_is_done_last_sees_that_nobody_is_under_way() -> None:
    spec = step_spec(VectorEnvSettings("CartPole-v1", 6, lanes=3))
    here = SharedMemory(spec, new_memory(), resize=True)
    there = SharedMemory(spec, os.dup(here.fd))
    assert here.order(range(3)) == {0: 1, 1: 1, 2: 1}
    left = []
    for lane in (2, 0, 1):
        assert there.answer(lane, there.ordered(lane), b"")
        left.append(there.unanswered_orders())
    assert left == [2, 1, 0]
    here.close()
    there.close()


@pytest.mark.skipif(not CAN_SPIN, reason="nobody waits awake on this kind of machine")
def test_waiting_awake_is_tried_less_often_while_it_is_in_vain() -> None:
    awake, looks = SpinWait(), 0

    def never() -> bool:
        nonlocal looks
        looks += 1
        return False

    tried = []
    for _ in range(12):
        looks = 0
        assert not awake.wait(never, 1e-4)
        tried.append(looks > 1)  # one look is made in any case
    assert tried == [True, False, True, False, False, False, True, *[False] * 5]
    for _ in range(2):  # what was left out counts down
        assert not awake.wait(never, 1e-4)
    answers = iter([False, True])
    assert awake.wait(lambda: next(answers), 1.0)  # now it comes at once
    looks = 0
    assert not awake.wait(never, 1e-4)
    assert looks > 1
