"""The objects that work between two updates, which the training loop calls."""

from __future__ import annotations

from typing import NamedTuple

from millrace.learner.between_updates.audience import Audience
from millrace.learner.between_updates.evaluations import Evaluations
from millrace.learner.between_updates.run_files import RunFiles
from millrace.learner.between_updates.run_parts import RunParts
from millrace.learner.between_updates.tally import Tally
from millrace.learner.callbacks.callbacks import Callbacks
from millrace.learner.recording.training_recorder import TrainingRecorder
from millrace.learner.run_folder.env_attributes import EnvAttributes
from millrace.learner.run_folder.requests import Requests


class BetweenUpdates(NamedTuple):
    """What a run does between two updates: it counts, writes, tells and evaluates."""

    tally: Tally
    files: RunFiles
    audience: Audience
    evaluations: Evaluations


def open_files(
    run: RunParts, callbacks: Callbacks, dataset: TrainingRecorder | None, time_limit: int | None
) -> BetweenUpdates:
    """Open the metrics, and bring the files of a resumed run back to its state. Raises `RunError`.

    `time_limit`: env steps after which an episode of an evaluation is truncated, if any.
    """
    refusal = "envpool's env copies have no attributes" if run.spec.vector == "envpool" else ""
    requests = Requests(EnvAttributes(run.tally.state.env_attributes, refusal))
    evaluations = Evaluations(run, time_limit)
    files = RunFiles(run, evaluations, requests.attributes)
    return BetweenUpdates(run.tally, files, Audience(run, callbacks, files, requests, dataset), evaluations)
