"""What settings start of the extras: the only place where the core names them. It imports an extra when a setting asks.

Rule: each entry is `module:name`. The caller says which type of the core the object has.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

STARTED_BY = {
    "clone_epochs": "millrace.extras.datasets.cloning:clone",
    "prior": "millrace.learner.recording.prior_dataset:PriorDataset",
    "record": "millrace.learner.recording.training_recorder:TrainingRecorder",
}
"""setting -> `module:name`"""


def started_by(setting: str) -> Any:
    """Import the object that this setting starts."""
    module, name = STARTED_BY[setting].split(":")
    return getattr(import_module(module), name)
