"""A pool whose workers only step env copies. The policy acts here, for one half of the copies while the other half steps.

The learner collects from a single worker, which is a thread of this process. This worker's env copies belong to a vector
environment, whose workers are processes. Tickets, ledger, rows, checkpoints and errors therefore work as in any other run,
and a lane gets the same seeds and random numbers as in a worker that acts itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from time import monotonic
from typing import TypeVar

from millrace.launch.crew import Crew
from millrace.launch.vector import VectorEnvPool, open_vector_env_pool
from millrace.launch.worker_pool import STOP_BEFORE_RUN_S, ActingPool, open_worker_pool
from millrace.learner.config.config import Config
from millrace.learner.config.local_workers import local_workers
from millrace.learner.members.bound import Bound
from millrace.learner.members.events import Failed
from millrace.learner.members.lobby import Lobby, LobbySettings
from millrace.learner.members.member import Member
from millrace.learner.members.who_may_connect import BindSettings
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.learner.torch_setup import torch_device
from millrace.learner.vector_env.env import ZmqVectorEnv
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.protocol.alive import StartFailed, WorkerActivity, WorkerExit
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.errors import NoWorkers
from millrace.protocol.messages import Status
from millrace.protocol.policy.policy import Policy, make_policy
from millrace.protocol.specs import PolicySpec, RunSpec
from millrace.protocol.wire.weight_dtypes import ActingDtype
from millrace.workers.actors import Actors
from millrace.workers.collect.collector import Collector
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.split_vector_env import SplitVectorEnv
from millrace.workers.evaluate.evaluator import Evaluator
from millrace.workers.supervise.supervisor import Supervisor
from millrace.workers.worker_thread import WorkerThread

NEVER_S = 1e9  # timeout of an order that may take any length of time
Result = TypeVar("Result")


@dataclass(frozen=True)
class ActingSettings:
    """Settings for acting in this process, and for the env copies."""

    copies: VectorEnvSettings
    workers: int
    """number of workers to wait for before the first step"""
    no_workers_timeout_s: float
    device: Callable[[], str]
    """returns the device of the policy; called once the run begins, because it may import PyTorch"""


def settings_of_run(config: Config, env: EnvSpec, where: BindSettings, workers: int) -> ActingSettings:
    """The settings of a training run. Workers that are started elsewhere join at `where`.

    `workers`: how many to wait for.
    """
    copies = VectorEnvSettings(
        env,
        config.envs,
        workers=None if where.bind else local_workers(config),
        lanes=config.lanes,
        listen=where,
        transport=config.transport,
        timeout_s=_longest_order_s(config),
        worker_timeout_s=config.worker_timeout_s,
        call_timeouts=config.call_timeouts(),
        copy=False,
        single_lanes=config.eval_copies,
    )
    return ActingSettings(
        copies,
        workers=workers,
        no_workers_timeout_s=config.no_workers_timeout_s,
        device=lambda: torch_device(config),
    )


def _longest_order_s(config: Config) -> float:
    """How long an order that makes and resets every copy may take. If the environment hangs, the worker is ended earlier."""
    timeouts = config.call_timeouts()
    each_s = 2 * timeouts.start_s + timeouts.step_s
    return each_s * config.envs if timeouts.start_s and timeouts.step_s else NEVER_S


class SteppingPool:
    """A pool whose policy acts in a thread of this process. It is a `millrace.launch.worker_pool.WorkerPool`."""

    def __init__(self, settings: ActingSettings, stepping: VectorEnvPool, own: ActingPool) -> None:
        """`stepping`: the pool of stepping workers. `own`: the pool that the thread joins."""
        self._settings = settings
        self._stepping = stepping
        self._own = own
        self._before: LobbySettings | None = None
        self._thread: Supervisor | None = None
        self._env: ZmqVectorEnv | None = None

    @property
    def bound(self) -> Bound:
        """The address where the stepping workers join."""
        return self._stepping.bound

    @contextmanager
    def start(self, crew: Crew, before: LobbySettings) -> Iterator[Lobby]:
        """A context manager that starts the crew's workers, but no more than there are copies, and yields their lobby."""
        self._before = before
        with self._stepping.start(crew, before) as lobby:
            try:
                yield lobby
            finally:
                self.stop(STOP_BEFORE_RUN_S)

    def begin(self, described: DescribedEnv) -> Lobby:
        """The lobby in which the thread joins."""
        assert self._before is not None, "start comes first"
        settings = self._settings
        env = self._env = self._stepping.vector_env(described)
        waits = WorkerWaits(env, settings.workers, settings.no_workers_timeout_s)
        self._thread = self._acting_thread(env, waits)
        processes = _ActingProcesses(self._thread, waits, env, self._stepping.expected)
        return Lobby(self._own.bound.link, processes, self._before)

    def report(self, status: Callable[[float], Status]) -> None:
        """Answer `millrace status` at the address where workers join, because the run's hub listens elsewhere."""
        assert self._env is not None, "begin comes first"
        self._env.hub.status_of_run = status

    def stop(self, within_s: float) -> None:
        """Stop the thread, then the workers that step for it."""
        if self._thread is not None:
            self._thread.ask_to_leave()  # `stop` asks a second time, so that the worker leaves at once
            self._thread.stop(within_s)
        if self._env is not None:
            self._env.close()

    def _acting_thread(self, env: ZmqVectorEnv, waits: WorkerWaits) -> Supervisor:
        def actors(run: RunSpec) -> Actors:
            copies = SplitVectorEnv(env, run, self._stepping.requested.evaluation_copies, waits)
            policy = acting_policy(run.policy, self._settings.device(), run.images_dtype)
            evaluator = Evaluator(run, policy, lambda run, count, render_mode, pulse: copies.evaluation_lane())
            return Actors(Collector(run, policy, copies.open_lane, copies), evaluator)

        def start(name: str) -> WorkerThread:
            return WorkerThread(self._own.bound.link.address, name, self._own.bound.context, actors)

        return Supervisor(start, 1, prefix="inference")


@contextmanager
def open_stepping_pool(settings: ActingSettings) -> Iterator[SteppingPool]:
    """Bind the address where the stepping workers join. Raises `UsageError` if it can't be bound."""
    with open_worker_pool(BindSettings(), "inproc") as own, ExitStack() as of_env:
        yield SteppingPool(settings, open_vector_env_pool(settings.copies, of_env), own)


class _ActingProcesses(WorkerProcesses):
    """The thread that acts, and the workers that step for it."""

    def __init__(self, thread: Supervisor, waits: WorkerWaits, env: ZmqVectorEnv, expected: int) -> None:
        """`expected`: number of workers that were started here to step."""
        self.expected = expected
        self._thread = thread
        self._waits = waits
        self._hub = env.hub
        self._failures: list[Failed] = []
        env.hub.on_death = self._failures.append

    def ended(self) -> Sequence[WorkerExit | StartFailed]:
        if (error := self._waits.take_no_workers()) is not None:
            raise error
        return self._thread.poll()

    def activities(self) -> Sequence[WorkerActivity]:
        return self._thread.activities()

    def stepping(self) -> Sequence[Member]:
        return list(self._hub.coordinator.members.values())

    def take_failures(self) -> Sequence[Failed]:
        failures = self._failures.copy()
        self._failures.clear()
        return failures


def acting_policy(spec: PolicySpec, device: str, images: ActingDtype) -> Policy:
    """The policy that acts. If numpy can compute the policy, it runs in numpy on the CPU, with the same bits as on a worker.

    Otherwise it runs in torch on the device, for all lanes in one pass.
    """
    if device == "cpu" and not spec.needs_torch:
        return make_policy(spec)
    from millrace.protocol.policy.torch_policy import TorchPolicy

    return TorchPolicy(spec, device, together=True, images=images)


class WorkerWaits:
    """Makes the calls that may wait for the workers of `env`. It is a `millrace.workers.copies.split_vector_env.PulsedWait`.

    The first call waits for workers to join. Rule: a call raises `NoWorkers` once there has been no worker for `timeout_s`,
    however long an order may take.
    """

    def __init__(self, env: ZmqVectorEnv, workers: int, timeout_s: float) -> None:
        """`workers`: number of workers to wait for."""
        self._env = env
        self._workers = workers
        self._timeout_s = timeout_s
        self._there_s = 0.0  # the last time when there was a worker, or the beginning of the call
        self._no_workers: NoWorkers | None = None

    def __call__(self, call: Callable[[], Result], pulse: Pulse) -> Result:
        """Make the call."""
        self._there_s = monotonic()
        hub = self._env.hub
        hub.while_waiting = partial(self._during, pulse)
        try:
            if self._workers:
                hub.wait_for(self._workers, self._timeout_s)
                self._workers = 0
            return call()
        except NoWorkers as error:
            self._no_workers = error
            raise

    def take_no_workers(self) -> NoWorkers | None:
        """The error if a call ended because no worker was left. Returns it once, to the learner, which ends the run."""
        error = self._no_workers
        self._no_workers = None
        return error

    def _during(self, pulse: Pulse) -> None:
        pulse()
        now = monotonic()
        if self._env.hub.coordinator.members:
            self._there_s = now
        elif now - self._there_s > self._timeout_s:
            raise self._env.hub.no_workers(self._timeout_s)
