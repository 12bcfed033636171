"""millrace: worker processes step copies of a gymnasium environment; one learner trains a policy in PyTorch.

User code imports this package only.

    run = millrace.train("CartPole-v1", seed=1)
    policy = millrace.load(run)

>>> import millrace
>>> installed = millrace.__version__
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

from millrace.import_conflict import check_imports

check_imports()

from protocol.errors import (  # noqa: E402
    CheckpointError,
    EnvironmentFailed,
    MillraceError,
    NoWorkers,
    PolicyFailed,
    RunError,
    Stalled,
    UsageError,
    UserFacingError,
    WorkerLost,
)

if TYPE_CHECKING:
    from gymnasium.vector import AutoresetMode

    from learner.algorithms.moments import Moments
    from learner.callbacks.callback import Callback
    from learner.recording.record import RecordedDataset
    from learner.run_folder.progress import Progress
    from learner.run_folder.results import Evaluation, Summary
    from learner.vector_env.env import ZmqVectorEnv
    from millrace.acting import LoadedPolicy, load
    from millrace.own_policy import OwnPolicy
    from millrace.playing import evaluate, record
    from millrace.policies import CNN, MLP, Piece, PolicyParameters, Recurrent
    from millrace.rollout_service import RolloutBatch, RolloutService
    from millrace.runs import Metrics, Run, train
    from protocol.env_spec import EnvLike
    from protocol.envs.wrappers import WrapperLike
    from workers.envs.reset_ahead import ResetAhead

__all__ = [
    "CNN",
    "MLP",
    "Callback",
    "CheckpointError",
    "EnvironmentFailed",
    "Evaluation",
    "LoadedPolicy",
    "Metrics",
    "MillraceError",
    "Moments",
    "NoWorkers",
    "OwnPolicy",
    "Piece",
    "PolicyFailed",
    "PolicyParameters",
    "Progress",
    "RecordedDataset",
    "Recurrent",
    "ResetAhead",
    "RolloutBatch",
    "RolloutService",
    "Run",
    "RunError",
    "Stalled",
    "Summary",
    "UsageError",
    "UserFacingError",
    "WorkerLost",
    "__version__",
    "algorithms",
    "evaluate",
    "integrations",
    "load",
    "make_vec",
    "record",
    "testing",
    "train",
]

_IMPORTED_WHEN_USED = {
    "CNN": "millrace.policies",
    "Callback": "learner.callbacks.callback",
    "Evaluation": "learner.run_folder.results",
    "LoadedPolicy": "millrace.acting",
    "MLP": "millrace.policies",
    "Moments": "learner.algorithms.moments",
    "OwnPolicy": "millrace.own_policy",
    "Metrics": "millrace.runs",
    "Piece": "millrace.policies",
    "PolicyParameters": "millrace.policies",
    "Progress": "learner.run_folder.progress",
    "RecordedDataset": "learner.recording.record",
    "Recurrent": "millrace.policies",
    "ResetAhead": "workers.envs.reset_ahead",
    "RolloutBatch": "millrace.rollout_service",
    "RolloutService": "millrace.rollout_service",
    "Run": "millrace.runs",
    "Summary": "learner.run_folder.results",
    "evaluate": "millrace.playing",
    "load": "millrace.acting",
    "record": "millrace.playing",
    "train": "millrace.runs",
}
"""Public names, and the module of each. They are imported when they are used, because that takes longer than this file."""

_MODULES = ("algorithms", "integrations", "testing")
"""Public modules, which are imported when they are used, too"""


def make_vec(
    env: EnvLike | Sequence[EnvLike],
    num_envs: int | None = None,
    *,
    workers: int | None = None,
    lanes: int | None = None,
    bind: str = "",
    keys: str = "",
    insecure: bool = False,
    advertise: str = "",
    transport: Literal["ipc", "tcp", "inproc"] = "ipc",
    shared_memory: bool = True,
    autoreset_mode: AutoresetMode | str = "NextStep",
    on_worker_loss: Literal["truncate", "raise"] = "truncate",
    timeout: float = 60.0,
    copy: bool = True,
    render_mode: str | None = None,
    wrappers: Sequence[WrapperLike] = (),
    **kwargs: bool | int | float | str,
) -> ZmqVectorEnv:
    """Make a `gymnasium.vector.VectorEnv` whose env copies live in worker processes.

    Its results are, bit for bit, those of `gymnasium.vector.SyncVectorEnv` for the same seeds and actions.

    Args:
        env: anything `gymnasium.make` takes, a callable that returns an environment, or a list with one of these for each
            env copy. What only your script or notebook has (a callable, an id that it registers) is code: it is sent over
            TCP only to workers that have a key.
        num_envs: number of env copies; by default 1, or the length of the list.
        workers: number of worker processes to start on this machine; by default one for each core, at most `num_envs`.
            They end with the vector environment.
        lanes: number of groups of env copies. A group lives in one worker. By default there is one for each worker.
        bind: an address for workers that are started elsewhere with `millrace worker ADDRESS`. The default is local workers.
        keys: the folder of the keys. An address that other machines can reach needs keys; they are made if there are none.
        insecure: use no keys.
        advertise: the host name by which other machines reach this one.
        transport: how messages travel to local workers. With `inproc` the worker is a thread of this process,
            which then runs the environment. Otherwise only workers do.
        shared_memory: local workers get actions and return results through shared memory. It is faster; results are equal.
        autoreset_mode: as in gymnasium: "NextStep", "SameStep" or "Disabled".
        on_worker_loss: "truncate" returns the env copies of a lost worker as truncated, with `worker_lost` in their infos,
            and continues with new copies on another worker. "raise" raises `WorkerLost`.
        timeout: seconds that a worker may take to answer; then it is given up.
        copy: return copies of the observations. Without it the next step overwrites them.
        render_mode: passed on to the environment.
        wrappers: applied to every env copy in its worker, the first one innermost: classes, functions, or names as
            "gymnasium.wrappers:FlattenObservation".
        kwargs: passed on to the environment.

    A worker elsewhere is also given up if it sends no heartbeat for 5 s while this process waits for it. A long step does
    not stop heartbeats, unless it holds Python's global interpreter lock. The time between two calls is not limited for
    local workers. Workers elsewhere wait for ten minutes; then they join again, and their env copies are lost.

    Raises:
        UsageError: an argument is wrong.
        NoWorkers: too few workers joined in time.
        EnvironmentFailed: an environment raised, and the error has the worker's traceback; or env copies have different spaces.
        WorkerLost: see `on_worker_loss`.

    >>> import millrace
    >>> envs = millrace.make_vec("CartPole-v1", 4, workers=2)
    >>> observations, infos = envs.reset(seed=1)
    >>> observations, rewards, terminated, truncated, infos = envs.step([0, 1, 0, 1])
    >>> observations.shape
    (4, 4)
    >>> envs.close()
    """
    from learner.members.endpoint import BindSettings
    from learner.vector_env.settings import VectorEnvSettings
    from millrace.launch import vector

    return vector.make_vec(
        VectorEnvSettings(
            env,
            num_envs,
            workers=workers,
            lanes=lanes,
            listen=BindSettings(bind, keys, insecure, advertise),
            transport=transport,
            shared_memory=shared_memory,
            autoreset_mode=autoreset_mode,
            on_worker_loss=on_worker_loss,
            timeout_s=timeout,
            copy=copy,
            render_mode=render_mode,
            kwargs=kwargs,
            wrappers=wrappers,
        )
    )


def __getattr__(name: str) -> Any:
    """Import a public name, or look up `__version__`, when it is first used."""
    if (module := _IMPORTED_WHEN_USED.get(name)) is not None:
        return getattr(import_module(module), name)
    if name in _MODULES:
        return import_module(f"millrace.{name}")
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import metadata

    try:
        return metadata.version("millrace-rl")
    except metadata.PackageNotFoundError:
        return "0+uninstalled"


def __dir__() -> list[str]:
    return sorted(__all__)
