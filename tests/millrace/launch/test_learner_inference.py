"""Workers that only step env copies follow the run's terms, although their specs aren't made from the run's settings."""

from __future__ import annotations

import numpy as np
import pytest

from millrace.launch.learner_inference import WorkerWaits, settings_of_run
from millrace.learner.config.config import Config
from millrace.learner.members.describe_coordinator import DescribeCoordinator
from millrace.learner.members.who_may_connect import BindSettings
from millrace.learner.vector_env.order_coordinator import OrderCoordinator
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.learner.vector_env.spec import requested_copies
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.description import read_description
from millrace.protocol.errors import NoWorkers
from millrace.protocol.messages import Heartbeat, Hello
from millrace.protocol.space_spec import DiscreteSpace, EnvDescription
from millrace.protocol.wire.plain_values import pack
from millrace.workers.collect.collector import Collector
from millrace.workers.copies.split_vector_env import SplitVectorEnv
from tests.support.conversation.example_messages import example
from tests.support.in_process.any_order import any_order
from tests.support.in_process.collectors import collect, random_policy, run_of

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


def test_that_no_worker_is_left_is_raised_once_to_whoever_asks() -> None:
    """However long an order may take."""
    run = run_of("CartPole-v1")
    with any_order(VectorEnvSettings(run.env.id, run.copies, lanes=1), 1, shared=False) as (env, link):
        waits = WorkerWaits(env, workers=1, timeout_s=0.0)
        split = SplitVectorEnv(env, run, wait=waits)
        collector = Collector(run, random_policy(run.policy), split.open_lane, split)
        collect(collector, run)
        assert waits.take_no_workers() is None
        link.leave("w0")
        with pytest.raises(
            NoWorkers, match=r"^waited 0 s for 1 worker at .*, 0 joined \(the last one left: killed\)"
        ) as caught:
            collect(collector, run, 1)
        assert waits.take_no_workers() is caught.value
        assert waits.take_no_workers() is None
