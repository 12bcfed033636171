"""A worker's lanes in the lock-step: what it opens to whom."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from learner.vector_env.settings import VectorEnvSettings
from learner.vector_env.spec import describe
from protocol.messages import Call, Returned
from protocol.wire.plain_values import pack, unpack
from workers.step.stepper import Stepper


def call(stepper: Stepper, name: str, given: Any, *, assign: bool = False) -> Returned:
    packed = np.frombuffer(pack(given), np.uint8)
    answer = stepper.execute(Call(1, 1, 0, 0, (0, 1), name, assign, packed), lambda: None)
    assert isinstance(answer, Returned)
    return answer


@pytest.mark.parametrize("name", ["_k", "__class__", "_max_episode_steps"])
@pytest.mark.parametrize("assign", [False, True])
def test_nothing_private_is_opened_to_one_it_cannot_be_sure_of(name: str, assign: bool) -> None:
    step = describe(VectorEnvSettings("workers.envs.toy:Countdown-v0", 2, lanes=1, kwargs={"k": 3})).step
    shut = Stepper(step, allow_private_names=False)
    answer = call(shut, name, [4, 4] if assign else ((), {}), assign=assign)
    assert answer.error.startswith(
        f"UsageError: {name!r} begins with an underscore: this worker gives private attributes only to"
    )
    assert "\n" not in answer.error
    shut.close_all()


def test_what_is_private_is_opened_to_a_learner_that_may_run_code() -> None:
    stepper = Stepper(describe(VectorEnvSettings("workers.envs.toy:Countdown-v0", 2, lanes=1, kwargs={"k": 3})).step)
    assert call(stepper, "_k", [4, 5], assign=True).error == ""
    answer = call(stepper, "_k", ((), {}))
    assert (answer.error, unpack(answer.results.data)) == ("", [4, 5])
    stepper.close_all()
