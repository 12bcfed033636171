"""How many env copies may run at the same time, because of licences or because more have failed, and how many train. Pure.

Rule: copies that play evaluations count, because training copies stay open during evaluations.
"""

from __future__ import annotations

from typing import NamedTuple

from millrace.learner.config.config import Config
from millrace.planning.in_words import counted, enumerated
from millrace.planning.measurements import Measurements
from millrace.planning.recommendation import ChosenSetting

EVALUATION_COPIES = Config().eval_copies


class AllowedCopies(NamedTuple):
    """The numbers of env copies that may run at the same time. 0: any number."""

    here: int
    """on this machine"""
    of_run: int
    """on all machines together"""
    why: str = "with those of evaluations"
    """the reason for `of_run`"""
    apart: bool = False
    """whether each copy that trains has a worker of its own"""
    failed_in_one_worker: bool = False
    """whether several copies in one worker did not work"""

    @classmethod
    def of(cls, max_env_copies: int, per_machine: int) -> AllowedCopies:
        """What the setting `max_env_copies` and this machine's limit allow; 0 is no limit."""
        return cls(min([number for number in (max_env_copies, per_machine) if number], default=0), max_env_copies)

    def after(self, measured: Measurements) -> AllowedCopies:
        """What these measurements allow.

        If more copies have failed than worked at the same time, only the latter number; if several have failed because they
        were in one worker, as few as possible there.
        """
        allowed = self._replace(apart=measured.best_apart, failed_in_one_worker=bool(measured.failed_in_one_worker))
        if not measured.copies_failed or 0 < self.here <= measured.copies_worked:
            return allowed
        return allowed._replace(here=measured.copies_worked, of_run=measured.copies_worked, why=_why(measured))

    @property
    def training(self) -> int:
        """How many copies may train on this machine; 0: any number. One trains even if none is left for evaluations."""
        return max(1, self.here - self._evaluating) if self.here else 0

    @property
    def settings(self) -> list[ChosenSetting]:
        """The settings that limit a run to these copies."""
        found = []
        if self.of_run > 1:  # evaluations need a second one
            found.append(ChosenSetting("max_env_copies", self.of_run, self.why))
        if self._evaluating < EVALUATION_COPIES:
            found.append(ChosenSetting("eval_copies", self._evaluating, self._why_few_evaluate))
        return found

    @property
    def _evaluating(self) -> int:
        """How many copies of a worker play evaluations: the default number, or 1 if that is more than a third of the allowed
        ones, or if training copies have a worker each. Several copies in one worker would wait one after the other.
        """
        return 1 if self.apart or self._is_scarce else EVALUATION_COPIES

    @property
    def _is_scarce(self) -> bool:
        return 0 < self.here < 3 * EVALUATION_COPIES

    @property
    def _why_few_evaluate(self) -> str:
        if self._is_scarce and self.here > 1:
            return f"so that {self.training} of {counted(self.here, 'copy', 'copies')} train"
        if self._is_scarce or self.failed_in_one_worker:
            return "as few as possible"
        return "each worker plays one episode at a time, so more workers take part in an evaluation"


def _why(measured: Measurements) -> str:
    """Why a run has only as many copies as have worked at the same time."""
    worked = [number for number in measured.copies_tried if 1 < number <= measured.copies_worked]
    failed = [number for number in measured.copies_tried if number > measured.copies_worked]
    return (
        f"{enumerated(worked)} copies worked at the same time, {enumerated(failed)} did not, and evaluations need copies "
        "too; if you know how many may run, plan with --max-env-copies"
    )
