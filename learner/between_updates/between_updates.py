"""The objects that work between two updates, which the training loop calls."""

from __future__ import annotations

from typing import NamedTuple

from millrace.learner.between_updates.audience import Audience
from millrace.learner.between_updates.evaluations import Evaluations
from millrace.learner.between_updates.run_files import RunFiles
from millrace.learner.between_updates.run_parts import RunParts
from millrace.learner.between_updates.tally import Tally
from millrace.learner.callbacks.callbacks import Callbacks
from millrace.learner.run_folder.callback_requests import Requests
from millrace.learner.run_folder.env_attributes import EnvAttributes
from millrace.protocol.envs.kinds_of_copies import has_attributes


class BetweenUpdates(NamedTuple):
    """What a run does between two updates: it counts, writes, tells and evaluates."""

    tally: Tally
    files: RunFiles
    audience: Audience
    evaluations: Evaluations


def open_files(run: RunParts, callbacks: Callbacks, time_limit: int | None) -> BetweenUpdates:
    """Open the metrics, and bring the files of a resumed run back to its state. Raises `RunError`.

    `time_limit`: env steps after which an episode of an evaluation is truncated, if any.
    """
    requests = Requests(EnvAttributes(run.tally.state.env_attributes, _why_no_attributes(run.spec.vector)))
    evaluations = Evaluations(run, time_limit)
    files = RunFiles(run, evaluations, requests.attributes)
    return BetweenUpdates(run.tally, files, Audience(run, callbacks, files, requests), evaluations)


def _why_no_attributes(vector: str) -> str:
    """Why attributes of the env copies can't be set; empty if they can."""
    if has_attributes(vector):
        return ""
    return f"the env copies of vector {vector} have no attributes"
