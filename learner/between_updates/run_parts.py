"""What every object between two updates works on. `open_run` makes it."""

from __future__ import annotations

from typing import NamedTuple

from learner.algorithms import Algorithm
from learner.between_updates.tally import Tally
from learner.config.config import Config
from learner.rollouts.hub import Hub
from learner.run_folder.run_folder import RunFolder
from protocol.specs import RunSpec


class RunParts(NamedTuple):
    """The parts of one run."""

    config: Config
    spec: RunSpec
    folder: RunFolder
    algorithm: Algorithm
    hub: Hub
    tally: Tally
