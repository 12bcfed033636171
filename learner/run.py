"""An open run, whose learner listens to its workers. `open_run.py` opens a run; `whole_run.py` trains it to its end."""

from __future__ import annotations

from dataclasses import dataclass

from millrace.learner.algorithms.prior_data import PriorData
from millrace.learner.between_updates.audience import Audience
from millrace.learner.between_updates.evaluations import Evaluations
from millrace.learner.between_updates.run_files import RunFiles
from millrace.learner.between_updates.run_parts import RunParts
from millrace.learner.run_folder.run_folder import Interrupted
from millrace.learner.run_setup import RunSetup


@dataclass(frozen=True)
class OpenRun:
    """A run: its parts, and everything that happens between two updates."""

    setup: RunSetup
    parts: RunParts
    files: RunFiles
    """writes the run's files"""
    audience: Audience
    """reports the run's progress"""
    evaluations: Evaluations
    """evaluates the policy"""
    prior: PriorData | None = None
    """the dataset that the run learns from in addition to its own rollouts, if there is one"""

    def check_time(self) -> None:
        """Raise `Interrupted` if the run was interrupted and its grace time is up."""
        if self.setup.interrupts.time_is_up(self.files.longest_save_s):
            raise Interrupted(self.setup.folder.shown)
