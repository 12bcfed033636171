"""The stepper of a worker: which attributes of its env copies a learner may use."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from learner.vector_env.settings import VectorEnvSettings
from learner.vector_env.spec import describe
from protocol.messages import Call, Returned
from protocol.wire.plain_values import pack, unpack
from workers.step.stepper import Stepper


def call(stepper: Stepper, name: str, arguments: Any, *, assign: bool = False) -> Returned:
    packed = np.frombuffer(pack(arguments), np.uint8)
    answer = stepper.execute(Call(1, 1, 0, 0, (0, 1), name, assign, packed), lambda: None)
    assert isinstance(answer, Returned)
    return answer


@pytest.mark.parametrize("name", ["_k", "__class__", "_max_episode_steps"])
@pytest.mark.parametrize("assign", [False, True])
def test_private_attributes_are_not_given_to_a_learner_that_is_not_trusted(name: str, assign: bool) -> None:
    step = describe(VectorEnvSettings("workers.envs.toy:Countdown-v0", 2, lanes=1, kwargs={"k": 3})).step
    stepper = Stepper(step, allow_private_names=False)
    answer = call(stepper, name, [4, 4] if assign else ((), {}), assign=assign)
    assert answer.error.startswith(
        f"UsageError: {name!r} begins with an underscore: this worker gives private attributes only to"
    )
    assert "\n" not in answer.error
    stepper.close_all()


def test_private_attributes_are_given_to_a_learner_that_may_run_code() -> None:
    stepper = Stepper(describe(VectorEnvSettings("workers.envs.toy:Countdown-v0", 2, lanes=1, kwargs={"k": 3})).step)
    assert call(stepper, "_k", [4, 5], assign=True).error == ""
    answer = call(stepper, "_k", ((), {}))
    assert (answer.error, unpack(answer.results.data)) == ("", [4, 5])
    stepper.close_all()
