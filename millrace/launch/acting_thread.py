"""A worker that is a thread of this process: it acts for the env copies of a vector environment, whose workers only step.

It is the only worker of its learner. So the learner's tickets, rollouts, evaluations and errors are those of every run, and
a lane gets the same seeds and random numbers as in a worker that acts itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from time import monotonic

from millrace.launch.endpoint import Endpoint
from millrace.learner.members.member import Member
from millrace.learner.members.process_callbacks import ProcessCallbacks
from millrace.learner.vector_env.env import GymnasiumStep, ZmqVectorEnv
from millrace.protocol.alive import StartFailed, WorkerExit
from millrace.protocol.arrays import Array
from millrace.protocol.policy.policy import Policy, make_policy
from millrace.protocol.specs import PolicySpec, RunSpec
from millrace.protocol.wire.weight_dtypes import ActingDtype
from millrace.workers.actors import Actors
from millrace.workers.collect.collector import Collector
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.split_vector_env import SplitLane, SplitVectorEnv
from millrace.workers.evaluate.evaluator import Evaluator
from millrace.workers.supervise.supervisor import Supervisor
from millrace.workers.worker_thread import WorkerThread

NEVER_S = 1e9  # the timeout of an order that may take any time


def lanes_of(
    env: ZmqVectorEnv, lanes: int, facts: Sequence[str], workers: int, no_workers_timeout_s: float, *, masked: bool
) -> SplitVectorEnv:
    """The copies of `env` as lanes. The first wait for them is until this number of `workers` has joined.

    `facts`: names of the facts that are read; `masked`: whether masks of the allowed actions are.
    """
    before_wait = _BeforeWaits(env, workers, no_workers_timeout_s)
    return SplitVectorEnv(env, lanes, before_wait, partial(_step_lanes, env), facts, masked=masked)


def acting_thread(
    endpoint: Endpoint, lanes: SplitVectorEnv, evaluation_copies: SplitLane, device: Callable[[], str]
) -> Supervisor:
    """Start the thread. `device`: that of the policy."""

    def actors(spec: RunSpec) -> Actors:
        policy = acting_policy(spec.policy, device(), spec.images_dtype)
        evaluator = Evaluator(spec, policy, lambda run, count, render_mode, pulse: evaluation_copies)
        return Actors(Collector(spec, policy, lanes.open_lane, lanes.step_all), evaluator)

    def start(name: str) -> WorkerThread:
        return WorkerThread(endpoint.link.address, name, endpoint.context, actors)

    return Supervisor(start, 1, prefix="inference")


def acting_processes(thread: Supervisor, lanes: SplitVectorEnv, env: ZmqVectorEnv, expected: int) -> ProcessCallbacks:
    """The thread, and the workers that step the copies of `env`. `expected`: number of these that the user asked for."""

    def ended() -> list[WorkerExit | StartFailed]:
        lanes.raise_if_no_workers()
        return thread.poll()

    def stepping() -> list[Member]:
        return list(env.hub.coordinator.members.values())

    processes = ProcessCallbacks(
        ended, thread.activities, count=lambda: len(stepping()), stepping=stepping, expected=expected
    )
    env.hub.on_death = processes.failed.append
    return processes


def _step_lanes(env: ZmqVectorEnv, lanes: Sequence[int], actions: Array) -> GymnasiumStep:
    """Step the copies of these lanes only. Actions and results have a row for every copy, which other copies ignore."""
    env.step_async(actions, lanes)
    return env.step_wait()


def acting_policy(spec: PolicySpec, device: str, images: ActingDtype) -> Policy:
    """The policy that acts. If numpy can compute it, it runs in numpy on the CPU and gives the same bits as on a worker.

    Otherwise it runs in torch on the device, for all lanes in one pass.
    """
    if device == "cpu" and not spec.needs_torch:
        return make_policy(spec)
    from millrace.protocol.policy.torch_policy import TorchPolicy

    return TorchPolicy(spec, device, together=True, images=images)


class _BeforeWaits:
    """Call it before each wait for `env`: it calls the pulse during the wait. The first wait is for workers to join.

    Rule: a wait raises `NoWorkers` once no worker has been there for `timeout_s`, however long an order may take.
    """

    def __init__(self, env: ZmqVectorEnv, workers: int, timeout_s: float) -> None:
        self._env = env
        self._workers = workers
        self._timeout_s = timeout_s
        self._there_s = 0.0  # when a worker was there, or the wait began

    def __call__(self, pulse: Pulse) -> None:
        """A wait begins."""
        self._there_s = monotonic()
        self._env.hub.while_waiting = partial(self._during, pulse)
        if self._workers:
            self._env.hub.wait_for(self._workers, self._timeout_s)
            self._workers = 0

    def _during(self, pulse: Pulse) -> None:
        pulse()
        now = monotonic()
        if self._env.hub.coordinator.members:
            self._there_s = now
        elif now - self._there_s > self._timeout_s:
            raise self._env.hub.no_workers(self._timeout_s)
