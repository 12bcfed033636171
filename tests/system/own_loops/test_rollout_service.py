"""`millrace.RolloutService` with worker processes: what a learner of one's own survives."""

from __future__ import annotations

import itertools
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

import millrace
from tests.system.stage.preloaded import command_line
from tests.system.stage.processes import Stage, free_port, wait_for

SMALL: dict[str, Any] = {"envs": 4, "lanes": 2, "rollout_steps": 16}


def children() -> list[psutil.Process]:
    """The worker processes of this process that run."""
    return [child for child in psutil.Process().children() if "millrace.workers" in command_line(child)]


def test_a_long_computation_loses_no_worker() -> None:
    settings: dict[str, Any] = {"workers": 2, "worker_timeout_s": 1.0}
    with millrace.RolloutService("CartPole-v1", **SMALL, **settings) as service:
        service.publish(service.policy.initial())
        for _ in itertools.islice(service, 2):
            time.sleep(2.5)
            service.publish(service.policy.initial())
        service.gather()
        assert service.ledger()["lost"] == 0
        assert service.workers() == ["w0", "w1"]
    assert not children()


def test_workers_are_served_while_the_user_computes() -> None:
    with millrace.RolloutService("CartPole-v1", workers=1, **SMALL) as service:
        service.publish(service.policy.initial())
        (worker,) = children()
        worker.kill()
        wait_for(lambda: any(child.pid != worker.pid for child in children()), 30, "a new worker, without a call of ours")


def test_a_killed_worker_is_replaced_and_no_batch_is_missing() -> None:
    with millrace.RolloutService("CartPole-v1", workers=2, worker_timeout_s=2.0, **SMALL) as service:
        service.publish(service.policy.initial())
        for number, batch in enumerate(itertools.islice(service, 8)):
            if number == 2:
                children()[0].kill()
            assert batch.lane.tolist() == [0, 0, 1, 1]
            assert batch.version.tolist() == [number] * 4
            service.publish(service.policy.initial())
        wait_for(lambda: service.workers() == ["w0", "w1"], 60, "the worker that replaces the killed one")
        counts = service.ledger()
        assert counts["used"] == 16
        assert counts["issued"] == counts["used"] + counts["outstanding"] + counts["lost"]
    assert not children()


def test_workers_elsewhere_join_with_a_token(stage: Stage) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    keys, token = stage.keys()
    worker = stage.worker(address, "far", "--token", str(token))
    with millrace.RolloutService("CartPole-v1", bind=address, keys=str(keys), **SMALL) as service:
        service.publish(service.policy.initial())
        assert service.gather().lane.tolist() == [0, 0, 1, 1]
        assert service.workers() == ["far"]
    assert worker.ends() == 0


def test_ctrl_c_ends_a_wait_and_the_workers(tmp_path: Path) -> None:
    kwargs = {"seconds": 3600.0}
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
    began_s = 0.0
    with (
        pytest.raises(KeyboardInterrupt),
        millrace.RolloutService("tests.support.envs.toy:Slow-v0", workers=1, env_kwargs=kwargs, **SMALL) as service,
    ):
        service.publish(np.zeros(service.policy.size, np.float32))
        began_s = time.monotonic()
        timer.start()
        service.gather()
    assert time.monotonic() - began_s < 30
    assert not children()
