"""millrace: worker processes step copies of a gymnasium environment; one learner trains a policy in PyTorch.

User code imports only this package.

    run = millrace.train("CartPole-v1", seed=1)
    policy = millrace.load(run)

>>> import millrace
>>> installed = millrace.__version__
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from millrace.oldest_versions import check_versions

check_versions()

import millrace.protocol.machine.waiting_threads  # noqa: E402, F401  # sets a variable that torch reads when it is imported
from millrace.protocol.errors import (  # noqa: E402
    CheckpointError,
    EnvironmentFailed,
    LearnerLost,
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
    from millrace import algorithms, testing
    from millrace.launch.vector import make_vec
    from millrace.learner.algorithms.normalizer import Normalizer
    from millrace.learner.callbacks.callback import Callback
    from millrace.learner.run_folder.progress import Progress
    from millrace.learner.run_folder.results import Evaluation, RecordedDataset, Summary
    from millrace.loaded_policy import LoadedPolicy, load
    from millrace.own_policy import OwnPolicy
    from millrace.planning.plan import plan
    from millrace.planning.run_plan import RunPlan
    from millrace.playing import evaluate, record
    from millrace.policies import CNN, MLP, Piece, PolicyParameters, Recurrent
    from millrace.protocol.envs.tuple_of_agents import TupleOfAgents
    from millrace.protocol.envs.which_copy import EnvCopy
    from millrace.rollout_service import RolloutBatch, RolloutService
    from millrace.runs import Metrics, Run, train
    from millrace.workers.copies.reset_ahead import ResetAhead
    from millrace.workers.copies.stack_images import StackImages
    from millrace.workers.copy_slots import env_copy

    __version__: str

__all__ = [
    "CNN",
    "MLP",
    "Callback",
    "CheckpointError",
    "EnvCopy",
    "EnvironmentFailed",
    "Evaluation",
    "LearnerLost",
    "LoadedPolicy",
    "Metrics",
    "MillraceError",
    "NoWorkers",
    "Normalizer",
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
    "RunPlan",
    "StackImages",
    "Stalled",
    "Summary",
    "TupleOfAgents",
    "UsageError",
    "UserFacingError",
    "WorkerLost",
    "__version__",
    "algorithms",
    "env_copy",
    "evaluate",
    "load",
    "make_vec",
    "plan",
    "record",
    "testing",
    "train",
]

_IMPORTED_WHEN_USED = {
    "CNN": "millrace.policies",
    "Callback": "millrace.learner.callbacks.callback",
    "EnvCopy": "millrace.protocol.envs.which_copy",
    "Evaluation": "millrace.learner.run_folder.results",
    "LoadedPolicy": "millrace.loaded_policy",
    "MLP": "millrace.policies",
    "Normalizer": "millrace.learner.algorithms.normalizer",
    "OwnPolicy": "millrace.own_policy",
    "Metrics": "millrace.runs",
    "Piece": "millrace.policies",
    "PolicyParameters": "millrace.policies",
    "Progress": "millrace.learner.run_folder.progress",
    "RecordedDataset": "millrace.learner.run_folder.results",
    "Recurrent": "millrace.policies",
    "ResetAhead": "millrace.workers.copies.reset_ahead",
    "RolloutBatch": "millrace.rollout_service",
    "RolloutService": "millrace.rollout_service",
    "Run": "millrace.runs",
    "RunPlan": "millrace.planning.run_plan",
    "StackImages": "millrace.workers.copies.stack_images",
    "Summary": "millrace.learner.run_folder.results",
    "TupleOfAgents": "millrace.protocol.envs.tuple_of_agents",
    "env_copy": "millrace.workers.copy_slots",
    "evaluate": "millrace.playing",
    "load": "millrace.loaded_policy",
    "make_vec": "millrace.launch.vector",
    "plan": "millrace.planning.plan",
    "record": "millrace.playing",
    "train": "millrace.runs",
}
"""The module that defines each public name. A module is imported when one of its names is first used, to save time."""

_MODULES = ("algorithms", "testing")
"""Public modules, also imported at first use"""


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
