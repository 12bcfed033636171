"""Measures how long an algorithm's update takes on this machine, with its settings, on batches that the caller collects.

Rule: the algorithm is created and used exactly as in a run, with the same number of threads and on the same device. Only an
algorithm with a replay buffer differs: it takes gradient steps from the first update on, and has a small buffer.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import msgspec

from millrace.learner.algorithms import algorithm_class
from millrace.learner.algorithms.algorithm import acting_weights
from millrace.learner.config.config import Config
from millrace.learner.config.hyperparameters import AlgorithmConfig, OffPolicyConfig
from millrace.learner.torch_setup import one_thread, threads, torch_device
from millrace.protocol.arrays import Floats
from millrace.protocol.machine.core_delay import CoreDelay
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec

SMALL_REPLAY = 20_000  # the largest capacity of the replay buffer, in transitions
LEAST_UPDATES = 2
AT_MOST = 4.0  # no update begins after more than this multiple of the given seconds


class UpdateTime(NamedTuple):
    """The time that updates take."""

    per_step_s: float
    """the median of an update's time, without delays caused by other processes, divided by the env steps in its batch"""
    cores: float
    """the median, over the updates, of an update's CPU time divided by its duration"""


def update_time(
    config: Config, policy: PolicySpec, collect: Callable[[Floats, Floats], Batch], seconds: float, workers: int
) -> UpdateTime:
    """Learn from batches for about `seconds`, and measure the updates.

    `collect` is called with parameters and buffers, and returns a batch. `workers` is the number of workers on this machine.
    The first update, which allocates memory and has an almost empty replay buffer, is not counted if there are others.
    Raises `MillraceError` if the device is missing, or if collecting or learning fails.
    """
    algorithm_config = _from_the_first_step_on(config.algorithm)
    with one_thread():
        import torch

        rows = config.algorithm.minibatch_rows(config.envs)
        torch.set_num_threads(config.torch_threads or threads(policy, rows, config.max_lag, workers).number)
        algorithm = algorithm_class(config.algo)(
            algorithm_config, policy, total_steps=config.steps, seed=config.seed, device=torch_device(config)
        )
        delay = CoreDelay()
        per_step_s: list[float] = []
        cores: list[float] = []
        began_s = time.monotonic()
        while len(per_step_s) <= LEAST_UPDATES or time.monotonic() < began_s + seconds:
            batch = collect(*acting_weights(algorithm, policy))
            delayed_s = delay.seconds()
            cpu_s = time.process_time()
            update_began_s = time.monotonic()
            algorithm.remember()
            algorithm.update(batch, lambda: None)
            acting_weights(algorithm, policy)
            took_s = time.monotonic() - update_began_s - (delay.seconds() - delayed_s)
            per_step_s.append(took_s / batch.env_steps)
            cores.append((time.process_time() - cpu_s) / took_s)
            if time.monotonic() > began_s + AT_MOST * seconds:
                break
        delay.close()
    counted = slice(min(1, len(per_step_s) - 1), None)
    return UpdateTime(statistics.median(per_step_s[counted]), statistics.median(cores[counted]))


def _from_the_first_step_on(config: AlgorithmConfig) -> AlgorithmConfig:
    match config:
        case OffPolicyConfig():
            return msgspec.structs.replace(config, learning_starts=0, replay_size=min(config.replay_size, SMALL_REPLAY))
    return config
