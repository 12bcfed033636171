"""Starts a vector environment, with worker processes on this machine or with workers that are started elsewhere.

Rule: whatever happens, no worker, socket file or folder is left behind.
"""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from typing import Literal

from gymnasium.vector import AutoresetMode

from millrace.arguments import checked
from millrace.launch.crew import Crew, InheritedByWorkers
from millrace.launch.worker_pool import ActingPool, open_worker_pool
from millrace.learner.members.bound import Bound
from millrace.learner.members.events import Failed
from millrace.learner.members.failure_count import FailureCount
from millrace.learner.members.lobby import Lobby, LobbySettings
from millrace.learner.members.who_may_connect import BindSettings
from millrace.learner.vector_env.env import ZmqVectorEnv
from millrace.learner.vector_env.settings import ObservationMode, VectorEnvSettings
from millrace.learner.vector_env.shared_steps import SharedSteps
from millrace.learner.vector_env.spec import RequestedCopies, observation_spaces, requested_copies
from millrace.learner.vector_env.step_hub import StepHub
from millrace.protocol.address import advertised_address, check_address
from millrace.protocol.call_timeouts import CallTimeouts
from millrace.protocol.env_spec import EnvLike
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.envs.wrappers import WrapperLike
from millrace.protocol.errors import UsageError
from millrace.protocol.machine.cpu_cores import usable_cores
from millrace.protocol.specs import StepSpec, WaitSpec
from millrace.protocol.wire.shared_memory import SUPPORTED, SharedMemory, new_memory
from millrace.protocol.wire.wake_up import SPIN_S, WakePipe

CLOSE_TIMEOUT_S = 5.0  # time for workers to leave at `close`; after it, remaining local workers are killed
JOIN_TIMEOUT_S = 60.0  # time for local workers to join
LEARNER_TIMEOUT_S = 600.0  # a worker elsewhere joins again if it receives nothing from the learner for this long
STEP_TIMEOUT_LEAST_S = 60.0
STEP_TIMEOUT_MOST_S = 1e6


@checked
def make_vec(
    env: EnvLike | Sequence[EnvLike],
    num_envs: int | None = None,
    *,
    workers: int | None = None,
    lanes: int | None = None,
    bind: str = "",
    keys: str | os.PathLike[str] = "",
    insecure: bool = False,
    advertise: str = "",
    transport: Literal["ipc", "tcp", "inproc"] = "ipc",
    shared_memory: bool = True,
    autoreset_mode: AutoresetMode | str = "NextStep",
    observation_mode: ObservationMode = "same",
    on_worker_loss: Literal["truncate", "raise"] = "truncate",
    timeout: float = 60.0,
    max_env_failures: int = 3,
    copy: bool = True,
    render_mode: str | None = None,
    wrappers: Sequence[WrapperLike] = (),
    **kwargs: bool | int | float | str,
) -> ZmqVectorEnv:
    """Make a `gymnasium.vector.VectorEnv` whose env copies live in worker processes.

    For the same seeds and actions, its results are bit for bit those of `gymnasium.vector.SyncVectorEnv`.

    Args:
        env: anything that `gymnasium.make` accepts, a callable that returns an environment, or a list with one of these for
            each env copy. If the environment is defined only in your script or notebook (as a callable or a registered id),
            it is sent to the workers as code. Over TCP, code is sent only to workers that have a key.
        num_envs: number of env copies; by default 1, or the length of the list. If the environment has several agents, as
            PettingZoo's have, each agent of a copy has its own row, and the attribute `num_envs` counts rows; see `step`.
        workers: number of worker processes to start on this machine; by default one for each core that this process may
            use, at most `num_envs`. They end with the vector environment.
        lanes: number of groups of env copies; by default one for each worker. Each group is stepped by one worker.
        bind: an address at which workers join; start them elsewhere with `millrace worker ADDRESS`. By default, local
            workers are started.
        keys: the folder of the keys. An address that other machines can reach needs keys; if there are none, they are made.
        insecure: use no keys.
        advertise: the host name by which other machines reach this machine.
        transport: how messages are sent to local workers. With `inproc`, the worker is a thread of this process, so the
            environment runs in this process; otherwise it runs only in worker processes.
        shared_memory: pass actions and results of local workers through shared memory, which is faster and gives the same
            results.
        autoreset_mode: as in gymnasium: "NextStep", "SameStep" or "Disabled".
        observation_mode: as in gymnasium: "same"; "different", if the bounds of observations may differ between env copies;
            or a tuple of the observation spaces of the batch and of a single copy.
        on_worker_loss: what to do if a worker is lost. "truncate" returns its env copies as truncated, with `worker_lost` in
            their infos, and continues with new copies on another worker. "raise" raises `WorkerLost`.
        timeout: how many seconds a worker may take to answer before it counts as lost.
        max_env_failures: how often workers may die in the environment's code. As in a training run, there is a limit on
            consecutive deaths and one on deaths within an hour, which grows with env copies and hours.
        copy: return copies of the observations. If False, the next step overwrites them.
        render_mode: passed on to the environment.
        wrappers: applied to every env copy in its worker, the first one innermost: classes, functions, or names such as
            "gymnasium.wrappers:FlattenObservation".
        kwargs: passed on to the environment.

    A worker elsewhere also counts as lost if it sends no heartbeat for 5 s while this process waits for it. A long step does
    not stop heartbeats, unless it holds Python's global interpreter lock. Local workers wait for the next call without a
    limit. Workers elsewhere wait for ten minutes; then they join again, and their env copies are lost.

    Raises:
        UsageError: an argument is wrong.
        NoWorkers: too few workers joined in time.
        EnvironmentFailed: an environment raised (the error has the worker's traceback), or killed its worker too often, or
            the env copies have different spaces.
        WorkerLost: see `on_worker_loss`.

    >>> import millrace
    >>> envs = millrace.make_vec("CartPole-v1", 4, workers=2)
    >>> observations, infos = envs.reset(seed=1)
    >>> observations, rewards, terminated, truncated, infos = envs.step([0, 1, 0, 1])
    >>> observations.shape
    (4, 4)
    >>> envs.close()
    """
    settings = VectorEnvSettings(
        env,
        num_envs,
        workers=workers,
        lanes=lanes,
        listen=BindSettings(bind, os.fspath(keys), insecure, advertise),
        transport=transport,
        shared_memory=shared_memory,
        autoreset_mode=autoreset_mode,
        observation_mode=observation_mode,
        on_worker_loss=on_worker_loss,
        timeout_s=timeout,
        call_timeouts=call_timeouts_of(timeout),
        max_env_failures=max_env_failures,
        copy=copy,
        render_mode=render_mode,
        kwargs=kwargs,
        wrappers=wrappers,
    )
    return start_vector_env(settings, Crew())


def start_vector_env(settings: VectorEnvSettings, crew: Crew, check: Callable[[], None] = lambda: None) -> ZmqVectorEnv:
    """Start a vector environment and wait for its workers, which get the log files and cores of `crew`.

    `check` is called now and then while this function, or later the vector environment, waits for workers. An exception that
    it raises ends the wait.

    Raises `UsageError`, `NoWorkers` and `EnvironmentFailed`.
    """
    deaths = FailureCount(settings.max_env_failures, len(settings.envs), time.monotonic())

    def died(event: Failed) -> None:
        for lane in event.lanes if event.worked_s is not None else ():
            deaths.collected(lane)  # the worker has taken steps, and here each step counts as a result
        if line := deaths.count(event, time.monotonic()):
            logging.getLogger("millrace.learner").warning("%s", line)

    def check_waiting() -> None:
        deaths.check()
        check()

    local_workers = settings.local_workers
    join_timeout_s = JOIN_TIMEOUT_S if local_workers else settings.timeout_s
    before = LobbySettings(
        wait=WaitSpec(),
        worker_timeout_s=math.inf if local_workers else settings.worker_timeout_s,
        no_workers_timeout_s=join_timeout_s,
        stall_timeout_s=max(join_timeout_s, settings.timeout_s),
        max_env_failures=0,
    )
    resources = ExitStack()
    try:
        pool = open_vector_env_pool(settings, resources)
        lobby = resources.enter_context(pool.start(crew, before))
        made = pool.vector_env(lobby.describe(pool.requested.to_describe, check))
        made.hub.on_death = died
        made.hub.while_waiting = check_waiting
        made.hub.wait_for(local_workers or settings.lane_count, join_timeout_s)
        spaces = made.single_observation_space, made.single_action_space
        found = observation_spaces(settings.observation_mode, spaces, made.calls.make(), max(1, len(made.seats)))
        made.single_observation_space, made.observation_space = found
        return made
    except BaseException:
        resources.close()
        raise


class VectorEnvPool:
    """The workers of a vector environment. `vector_env` makes the environment once a worker has described its copies."""

    def __init__(
        self, settings: VectorEnvSettings, requested: RequestedCopies, pool: ActingPool, resources: ExitStack
    ) -> None:
        """Closing `resources` closes the pool."""
        self.requested = requested
        self._settings = settings
        self._pool = pool
        self._resources = resources
        self._inherited = self._new_inherited()

    @property
    def bound(self) -> Bound:
        """The address where workers join, and which workers may join."""
        return self._pool.bound

    @property
    def expected(self) -> int:
        """Number of workers that are started on this machine."""
        return self._settings.local_workers

    def start(self, crew: Crew, before: LobbySettings) -> AbstractContextManager[Lobby]:
        """Start as many workers as the settings say, with the log files and cores of `crew`. Call it once.

        Returns a context manager: the lobby of these workers.
        """
        crew = replace(crew, count=self.expected, inherited=self._inherited)
        return self._pool.start(crew, replace(before, wait=self.requested.wait))

    def vector_env(self, described: DescribedEnv) -> ZmqVectorEnv:
        """Make the vector environment, without waiting until workers have joined. Call it once."""
        settings = self._settings
        lobby = self._pool.lobby
        assert lobby is not None, "start comes first"
        description = self.requested.description(described)
        hub = StepHub(
            self.bound.link,
            description.step,
            first_session=lobby.first_session,
            processes=self._pool.processes,
            shared=self._shared_steps(description.step),
            worker_timeout_s=settings.worker_timeout_s if settings.listen.bind else math.inf,
        )
        self._resources.callback(hub.close, CLOSE_TIMEOUT_S)
        hub.take_over(lobby.hand_over(), lobby.described_in_s)
        return ZmqVectorEnv(
            description,
            hub,
            timeout_s=settings.timeout_s,
            on_worker_loss=settings.on_worker_loss,
            copy=settings.copy,
            on_close=self._resources.close,
        )

    def _new_inherited(self) -> InheritedByWorkers | None:
        """Shared memory and wake pipes for local worker processes; None if they can't or shouldn't use them."""
        settings = self._settings
        if not (settings.shared_memory and SUPPORTED and self.expected) or settings.transport == "inproc":
            return None
        memory_fd = new_memory()
        self._resources.callback(os.close, memory_fd)  # the memory itself is freed once its last view is gone
        to_workers = {f"w{n}": self._new_pipe() for n in range(self.expected)}
        return InheritedByWorkers(memory_fd, to_workers, self._new_pipe())

    def _new_pipe(self) -> WakePipe:
        pipe = WakePipe()
        self._resources.callback(pipe.close)
        return pipe

    def _shared_steps(self, spec: StepSpec) -> SharedSteps | None:
        inherited = self._inherited
        if inherited is None:
            return None
        memory = SharedMemory(spec, inherited.memory_fd, resize=True)
        spin_s = SPIN_S if self.expected < usable_cores() else 0.0  # spin only if a core stays free for the learner
        return SharedSteps(memory, inherited.to_workers, inherited.to_learner, spin_s)


def open_vector_env_pool(settings: VectorEnvSettings, resources: ExitStack) -> VectorEnvPool:
    """Bind the address where workers join. Closing `resources`, or the vector environment, releases everything.

    Raises `UsageError`.
    """
    where = settings.listen
    if where.bind and settings.workers:
        raise UsageError(f"workers: expected 0, got {settings.workers}; with a bind address, start the workers yourself")
    # Local workers need no timeout, because they end with this process, and this process notices at once if one of them
    # ends.
    requested = requested_copies(settings, LEARNER_TIMEOUT_S if where.bind else math.inf)
    if where.bind:
        check_address(advertised_address("tcp://*:1", where.advertise, "machine"))
    code = next((env.called_code for env in requested.envs if env.called_code), "")
    pool = resources.enter_context(open_worker_pool(where, settings.transport, code))
    return VectorEnvPool(settings, requested, pool, resources)


def call_timeouts_of(timeout_s: float) -> CallTimeouts:
    """How long a call to the environment may take before the worker's supervisor ends the worker.

    This is longer than `timeout_s`, after which the learner treats the worker as lost and kills a local one. This limit
    therefore matters only for a worker elsewhere, and while the learner isn't waiting.
    """
    seconds = max(STEP_TIMEOUT_LEAST_S, 2 * timeout_s) if timeout_s < STEP_TIMEOUT_MOST_S else 0.0
    return CallTimeouts(seconds, seconds)
