"""Measures the time that millrace itself needs on this machine for collecting and updates.

For this, it collects from an environment that does nothing.

Rule: the environment that does nothing takes no slot of this machine, so no limit on env copies applies to it, and it waits
for no other program.

Rule: nothing is assumed about the machine. Rounds of different sizes are timed, and the time per row, lane, copy and rollout
is computed from the differences. CPU time is measured, so that other programs on this machine hardly affect the result.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import gymnasium
import msgspec

from millrace.learner.algorithms import algorithm_class
from millrace.learner.config.config import Config
from millrace.learner.config.local_workers import local_workers
from millrace.learner.update_time import UpdateTime, update_time
from millrace.planning.measurements import Overheads
from millrace.planning.stand_in import StandIn, StandInOfAgents
from millrace.policies import PolicyChoice
from millrace.protocol.arrays import Floats
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, ExtraArray, Leaf, PolicySpec
from millrace.rollout_service import RolloutBatch, RolloutService
from millrace.workers.machine_slots import FILE_VARIABLE, LIMIT_VARIABLE

EACH_S = 0.4  # how long rounds of each size are measured
LEAST_ROUNDS = 3
OF_UPDATES_S = 1.5  # how long updates are measured
MINIBATCHES = 4  # number of minibatches in a measured update
COPIES = 8
LONG, SHORT = 48, 8  # numbers of steps in a rollout
MOST_WAITING_S = 0.001
TORCH_BYTES = 200 << 20  # additional memory of a worker that acts on images, because it imports torch


class StoodFor(NamedTuple):
    """The environment that a stand-in replaces during the measurement."""

    observation: gymnasium.Space[Any]
    action: gymnasium.Space[Any]
    seats: tuple[str, ...] = ()
    wait_s: float = 0.0
    """how long a step of the environment waits for something other than a core"""

    def stand_in(self) -> Callable[[], Any]:
        """A factory that makes a stand-in with these spaces."""
        wait_s = min(self.wait_s, MOST_WAITING_S)
        if self.seats:
            return partial(StandInOfAgents, self.observation, self.action, wait_s, agents=self.seats)
        return partial(StandIn, self.observation, self.action, wait_s)


class _PolicyOf(NamedTuple):
    """The policy that the configured algorithm trains, in the form that `RolloutService` accepts."""

    config: Config

    @property
    def extra_arrays(self) -> tuple[ExtraArray, ...]:
        return ()

    def spec(self, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        return algorithm_class(self.config.algo).policy_spec(self.config.algorithm, observation, action)


class _Size(NamedTuple):
    lanes: int
    copies: int
    steps: int


class _Round(NamedTuple):
    """The time that a round takes, in one worker and in the learner."""

    worker_s: float
    """CPU time of the worker"""
    learner_s: float
    """CPU time of the learner"""
    wall_s: float
    """wall time of the shortest of several rounds"""


def overheads(config: Config, env: StoodFor) -> Overheads:
    """Measure the overheads for runs with these settings. This takes a few seconds. Raises `UserFacingError` if it fails."""
    with _slots_of_their_own():
        return _overheads(config, env)


@contextmanager
def _slots_of_their_own() -> Iterator[None]:
    """Workers that this process starts meanwhile use another file of slots than the machine's, without a limit."""
    with TemporaryDirectory(prefix="millrace-plan-") as folder:
        before = {name: os.environ.pop(name, None) for name in (FILE_VARIABLE, LIMIT_VARIABLE)}
        os.environ[FILE_VARIABLE] = str(Path(folder, "slots"))
        try:
            yield
        finally:
            del os.environ[FILE_VARIABLE]
            os.environ.update({name: value for name, value in before.items() if value is not None})


def _overheads(config: Config, env: StoodFor) -> Overheads:
    one_long = _round(config, env, _Size(1, 1, LONG))
    one_short = _round(config, env, _Size(1, 1, SHORT))
    many_long = _round(config, env, _Size(COPIES, COPIES, LONG))
    many_short = _round(config, env, _Size(COPIES, COPIES, SHORT))
    one_lane = _round(config, env, _Size(1, COPIES, LONG))
    awake = _round(config, env._replace(wait_s=0.0), _Size(1, 1, SHORT))
    # For l lanes, n copies and T steps, a worker's CPU time is
    # base + l · per_lane + T · (row_s + l · lane_row_s + n · copy_row_s).
    row_of_one_s = _slope(one_long.worker_s - one_short.worker_s, LONG - SHORT)
    row_of_many_s = _slope(many_long.worker_s - many_short.worker_s, LONG - SHORT)
    base_s = max(0.0, one_long.worker_s - LONG * row_of_one_s)
    row_of_one_lane_s = _slope(one_lane.worker_s - base_s, LONG)
    copy_row_s = _slope(row_of_one_lane_s - row_of_one_s, COPIES - 1)
    lane_row_s = _slope(row_of_many_s - row_of_one_lane_s, COPIES - 1)
    sending_s = _slope(many_long.worker_s - LONG * row_of_many_s - base_s, COPIES - 1)
    # The learner's CPU time is base + l · taken_in_s + n · T · received_s.
    received_s = _slope(many_long.learner_s - many_short.learner_s, COPIES * (LONG - SHORT))
    taken_in_s = _slope(many_short.learner_s - one_short.learner_s - (COPIES - 1) * SHORT * received_s, COPIES - 1)
    on_the_way_s = max(0.0, awake.wall_s - awake.worker_s - awake.learner_s)
    update, convolves = _update(config, env)
    return Overheads(
        row_s=max(0.0, row_of_one_s - lane_row_s - copy_row_s),
        lane_row_s=lane_row_s,
        copy_row_s=copy_row_s,
        sent_s=sending_s,
        round_s=max(0.0, one_short.learner_s - SHORT * received_s - taken_in_s) + base_s + on_the_way_s,
        rollout_s=taken_in_s,
        received_s=received_s,
        update_s=update.per_step_s,
        update_cores=update.cores,
        acting_bytes=TORCH_BYTES if convolves else 0,
    )


def _slope(difference: float, by: float) -> float:
    """A difference of measured times, divided by `by`. If noise has made the difference negative, the slope is 0."""
    return max(0.0, difference) / by


def _service(config: Config, env: StoodFor, size: _Size) -> RolloutService:
    policy: PolicyChoice = _PolicyOf(config)
    return RolloutService(env.stand_in(), policy, rollout_steps=size.steps, workers=1, envs=size.copies, lanes=size.lanes)


def _round(config: Config, env: StoodFor, size: _Size) -> _Round:
    """Measure the time of a round of this size."""
    found: list[_Round] = []
    with _service(config, env, size) as service:
        parameters = service.policy.initial()
        service.publish(parameters)
        service.gather()
        end_at_s = time.monotonic() + EACH_S
        while len(found) < LEAST_ROUNDS or time.monotonic() < end_at_s:
            cpu_s = time.process_time()
            began_s = time.monotonic()
            service.publish(parameters)
            batch = service.gather()
            wall_s = time.monotonic() - began_s
            found.append(_Round(float(batch.reward.sum(dtype=float)), time.process_time() - cpu_s, wall_s))
    return _Round(
        worker_s=statistics.median(each.worker_s for each in found),
        learner_s=statistics.median(each.learner_s for each in found),
        wall_s=min(each.wall_s for each in found),
    )


def _update(config: Config, env: StoodFor) -> tuple[UpdateTime, bool]:
    """Measure the time of updates. Also returns whether the policy has convolutions."""
    size = _Size(1, config.envs, _steps_of_update(config))
    with _service(config, env, size) as service:

        def collect(parameters: Floats, buffers: Floats) -> Batch:
            service.publish(parameters, buffers)
            return _as_algorithms_take_it(service.gather())

        policy = service.run.policy
        taken = msgspec.structs.replace(config, torch_threads=None)
        return update_time(taken, policy, collect, OF_UPDATES_S, local_workers(config)), policy.convolves


def _steps_of_update(config: Config) -> int:
    """Number of steps in a measured rollout. It is smaller than in a run if an update's time is proportional to it."""
    steps = config.algorithm.rollout_steps
    if config.algorithm.gradient_steps is not None:  # a setting determines their number in an update
        return steps
    if config.algorithm.replays:
        return max(1, steps // 4)
    of_minibatches = -(-MINIBATCHES * config.algorithm.minibatch_rows(config.envs) // config.envs)
    return min(steps, max(SHORT, of_minibatches))


def _as_algorithms_take_it(batch: RolloutBatch) -> Batch:
    """The same batch, with the leaves of its observations in a tuple, as algorithms expect them."""
    leaves = tuple(batch.obs.values()) if isinstance(batch.obs, dict) else (batch.obs,)
    return Batch(**{name: getattr(batch, name) for name in Batch.__struct_fields__} | {"obs": leaves})
