"""Workers that only step env copies follow the run's terms, although their specs aren't made from the run's settings."""

from __future__ import annotations

import numpy as np
import pytest

from millrace.launch.learner_inference import settings_of_run
from millrace.learner.config.config import Config
from millrace.learner.members.describe_coordinator import DescribeCoordinator
from millrace.learner.members.who_may_connect import BindSettings
from millrace.learner.vector_env.order_coordinator import OrderCoordinator
from millrace.learner.vector_env.spec import requested_copies
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.description import read_description
from millrace.protocol.messages import Heartbeat, Hello
from millrace.protocol.space_spec import DiscreteSpace, EnvDescription
from millrace.protocol.wire.plain_values import pack
from tests.support.conversation.example_messages import example

SMALL = DiscreteSpace(2, 0, "int64")
DESCRIPTION = EnvDescription(SMALL, SMALL, np.frombuffer(pack({}), np.uint8), "", 0, "")
WORKER = b"w0"


@pytest.mark.parametrize("worker_timeout_s", [0.5, 5.0])
def test_a_worker_that_beats_as_asked_outlives_a_short_worker_timeout(worker_timeout_s: float) -> None:
    config = Config(env="Any-v0", inference="learner", worker_timeout_s=worker_timeout_s)
    copies = settings_of_run(config, EnvSpec("Any-v0"), BindSettings(), 1).copies
    requested = requested_copies(copies)
    wait, step = requested.wait, requested.description(read_description(DESCRIPTION)).step
    for spec, coordinator in (
        (wait, DescribeCoordinator(wait, 1, worker_timeout_s=worker_timeout_s, decliners_to_end=0)),
        (step, OrderCoordinator(step, 1, copies.worker_timeout_s)),
    ):
        coordinator.receive(WORKER, example(Hello, worker=WORKER.decode()), 0.0)
        assert coordinator.members[WORKER].session == 1
        for beat in range(1, 20):
            coordinator.remove_silent(beat * spec.heartbeat_s - 0.01)
            coordinator.receive(WORKER, example(Heartbeat, session=1), beat * spec.heartbeat_s)
            assert WORKER in coordinator.members, f"{type(spec).__name__}: removed before its Heartbeat number {beat}"
