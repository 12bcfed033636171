"""Trains a run to its end, and tells the workers, the callbacks and the user how it ended.

Rule: of several errors, the one that ended the run is raised. Errors that occur while workers and callbacks are told are
only logged.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from millrace.learner.algorithms.prior_data import PriorData
from millrace.learner.between_updates.crowded_cores import CrowdedCores
from millrace.learner.extras import started_by
from millrace.learner.rollouts.hub import GOODBYE_IF_CUT_SHORT_S
from millrace.learner.run import OpenRun
from millrace.learner.run_folder.run_folder import Interrupted
from millrace.learner.torch_setup import torch_device
from millrace.learner.train import train
from millrace.protocol.bounds import one_line
from millrace.protocol.errors import MillraceError, RunTakenOver, first_line

log = logging.getLogger("millrace.learner")


def train_to_the_end(run: OpenRun, workers: int) -> None:
    """Wait for this many workers, then train to the end.

    `run.setup.interrupts` must be entered. Raises `Interrupted` if the user interrupts the run, and `MillraceError`, with a
    one-line message, if the run fails.
    """
    setup = run.setup
    hub = run.parts.hub
    try:
        if run.prior is not None and run.parts.tally.state.version == 0:
            _learn_from_prior(run, run.prior)
        train(run, workers, _watched_cores(run))
    except RunTakenOver as error:
        reason = str(error)
        hub.drain(reason, timeout_s=GOODBYE_IF_CUT_SHORT_S)
        _tell_of_error(lambda: run.audience.leave(reason))
        raise
    except BaseException as error:
        if line := run.files.saved():
            error.add_note(line)
        reason = "interrupted" if isinstance(error, KeyboardInterrupt) else _why(error)
        hub.drain(reason, timeout_s=setup.interrupts.at_most(GOODBYE_IF_CUT_SHORT_S))
        _tell_of_error(lambda: run.audience.finish(reason, cut_short=True))
        raise
    finally:
        run.files.close()


def _watched_cores(run: OpenRun) -> CrowdedCores:
    """The run's `CrowdedCores`, which watches PyTorch's threads unless a GPU computes the updates."""
    config = run.setup.config
    return CrowdedCores((config.torch_threads or 1) if torch_device(config) == "cpu" else 0)


def _learn_from_prior(run: OpenRun, prior: PriorData) -> None:
    """Take the gradient steps that precede the first rollouts. Writes checkpoints when due, and when interrupted."""
    algorithm = run.parts.algorithm

    def pulse() -> None:
        run.parts.hub.pulse()
        run.files.save_if_due()
        run.setup.check_running()

    try:
        if run.setup.config.algorithm.clone_epochs:
            if metrics := started_by("clone_epochs")(algorithm, prior.batches(), pulse):
                run.audience.cloned(metrics)
            state = run.parts.tally.state
            if state.newest_evaluation is None and state.pending is None:
                state.next_evaluation = 0  # so that an evaluation is due, if the run makes any
        algorithm.learn_from_prior(pulse)
    except Interrupted:
        run.files.save()
        run.files.confirm_saved()
        raise


def _tell_of_error(end: Callable[[], None]) -> None:
    """Call `end`, which tells the callbacks. If it raises, only log this, because the error that ended the run matters."""
    try:
        end()
    except Exception as later:
        log.warning("%s", _why(later))


def _why(error: BaseException) -> str:
    """One line that says why the run ended. The user's code may have raised the error, with any message."""
    text = first_line(error, type(error).__name__)
    return one_line(text if isinstance(error, MillraceError) else f"{type(error).__name__}: {text}")
