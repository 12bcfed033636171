"""The parts of a run that every object in this package works on. `open_run` creates them."""

from __future__ import annotations

from typing import NamedTuple

from millrace.learner.algorithms import Algorithm
from millrace.learner.between_updates.tally import Tally
from millrace.learner.config.config import Config
from millrace.learner.rollouts.hub import Hub
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.specs import RunSpec


class RunParts(NamedTuple):
    """The parts of one run."""

    config: Config
    spec: RunSpec
    folder: RunFolder
    algorithm: Algorithm
    hub: Hub
    tally: Tally
