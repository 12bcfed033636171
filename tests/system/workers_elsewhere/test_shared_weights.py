"""`millrace worker --processes 3`: its workers share the weights that their supervisor gets."""

from __future__ import annotations

import signal
from typing import Any

import numpy as np
import pytest

import millrace
from millrace.protocol.policy.layout import acting_size
from tests.system.stage.processes import START_S, Stage, free_port, wait_for

SMALL: dict[str, Any] = {"envs": 6, "lanes": 3, "rollout_steps": 8, "worker_timeout_s": 60.0}
WORKERS = ["m-w0", "m-w1", "m-w2"]
UPDATES = 4


def batches(seed: int, **settings: Any) -> list[Any]:
    """What is collected under weights that follow from the seed. With workers elsewhere, it is counted what was sent."""
    random, found = np.random.default_rng(seed), []
    with millrace.RolloutService("CartPole-v1", millrace.MLP(256, 256), **SMALL, **settings) as service:
        link, members = service._hub.link, service._hub.coordinator.members
        if settings.get("bind"):
            wait_for(lambda: sorted(service.workers()) == WORKERS, START_S, "three workers")
            wait_for(lambda: all(each.supervisor for each in members.values()), START_S, "the word of their supervisor")
        weights_bytes = 4 * acting_size(service.run.policy)
        for _ in range(UPDATES):
            before = link.sent.bytes
            service.publish(0.1 * random.standard_normal(service.policy.size).astype(np.float32))
            batch = service.gather()
            found.append([batch.obs, batch.action, batch.log_prob, batch.version])
            if settings.get("bind"):
                sent = link.sent.bytes - before
                assert weights_bytes < sent < 1.5 * weights_bytes, f"{sent} bytes for weights of {weights_bytes}"
    return found


def test_each_version_comes_once_and_acts_bit_for_bit_in_one_run_after_another(stage: Stage) -> None:
    """The versions of the second run have the numbers of the first, and other weights."""
    address = f"tcp://127.0.0.1:{free_port()}"
    machine = stage.worker(address, "m", "--processes", "3", "--stay")
    for seed in (1, 2):
        elsewhere, here = batches(seed, bind=address), batches(seed, workers=1)
        for got, expected in zip(elsewhere, here, strict=True):
            assert all(np.array_equal(one, other) for one, other in zip(got, expected, strict=True))
    machine.signal(signal.SIGTERM)
    assert machine.ends() == 0


@pytest.mark.parametrize("fault", ["stopped", "killed"])
def test_workers_whose_supervisor_is_gone_are_served_or_replaced(stage: Stage, fault: str) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    machine = stage.worker(address, "m", "--processes", "3")
    with millrace.RolloutService("CartPole-v1", bind=address, **SMALL) as service:
        members = service._hub.coordinator.members
        wait_for(lambda: sorted(service.workers()) == WORKERS, START_S, "three workers")
        wait_for(lambda: all(each.supervisor for each in members.values()), START_S, "the word of their supervisor")
        if fault == "stopped":
            machine.signal(signal.SIGSTOP)
        else:
            machine.process.kill()
            stage.worker(address, "other")
        for version in range(3):
            service.publish(service.policy.initial())
            assert set(service.gather().version.tolist()) == {version}
        if fault == "stopped":
            assert sorted(service.workers()) == WORKERS
            machine.go_on()
