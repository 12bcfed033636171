"""The objects in extras that settings and public functions start. The core imports an extra only when it is needed.

Rule: each entry is `module:name`. The core defines the type of each object, and the caller declares it. The core has
similar tables for what else extras contribute: commands (`millrace/cli/commands.py`), kinds of env copies
(`protocol/envs/kinds_of_copies.py`) and environments (`protocol/env_spec.py`). It names extras nowhere else.
"""

from __future__ import annotations

from importlib.util import find_spec
from pkgutil import resolve_name
from typing import Any, NamedTuple

from millrace.learner.config.config import Config
from millrace.protocol.errors import UsageError

STARTED_BY = {
    "clone_epochs": "millrace.extras.datasets.cloning:clone",
    "millrace.record": "millrace.extras.datasets.record:write_dataset",
    "prior": "millrace.extras.datasets.prior_dataset:PriorDataset",
    "record": "millrace.extras.datasets.training_recorder:TrainingRecorder",
    "video": "millrace.extras.datasets.video:prepare_videos",
    "Run.plot": "millrace.extras.monitoring.report.picture:draw",
    "dashboard": "millrace.extras.monitoring.dashboard.page_beside:page_of_run",
    "metrics_bind": "millrace.extras.monitoring.prometheus:metrics_server",
    "tensorboard": "millrace.extras.monitoring.tensorboard:TensorBoardCallback",
}
"""The `module:name` of the object that each setting or public function starts."""


class Packages(NamedTuple):
    """Packages that a setting needs and that `pip install .` doesn't install."""

    modules: tuple[str, ...]
    """the modules that must be importable"""
    install: str
    """the arguments of `pip install`"""


MINARI = Packages(("minari", "h5py", "PIL"), "'minari[hdf5]' pillow")
NEEDED_BY = {
    "metrics_bind": Packages(("prometheus_client",), "prometheus-client"),
    "prior": MINARI,
    "record": MINARI,
    "tensorboard": Packages(("tensorboard",), "tensorboard"),
}


def check_packages(config: Config) -> None:
    """Raise `UsageError` if a setting needs a package that is not installed. This is quick, because it imports nothing."""
    for setting, (modules, install) in NEEDED_BY.items():
        missing = [module for module in modules if find_spec(module) is None]
        if getattr(config, setting) and missing:
            flag = setting.replace("_", "-")
            raise UsageError(f"--{flag} needs {missing[0]}, which is not installed; pip install {install}")


def started_by(setting: str) -> Any:
    """Import and return the object that this setting or public function starts."""
    return resolve_name(STARTED_BY[setting])
