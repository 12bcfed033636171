"""The training loop. Everything else is called from here; `hub.gather` is the only place that waits for rollouts.

An evaluation belongs to one version of the weights. It is played after that version's checkpoint is written, and before the
next rollouts are collected. With `eval_workers`, it runs alongside training: see `evaluations.py`.

With `max_lag` 0, the learner publishes weights, gathers rollouts and learns, one after the other. With `max_lag` 1, the
workers already collect the next rollouts while the learner learns. The loop is the same; only the number of tickets differs.

Rule: whatever ends the run, the state after the last complete update is saved first; if it can't be saved, the run fails. An
update is undone if it raises, if the new weights are not finite or no worker could act with them, if it returns metrics that
aren't numbers, or if a callback doesn't accept its rollouts.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from millrace.learner.algorithms import Algorithm
from millrace.learner.algorithms.algorithm import acting_weights, numbers
from millrace.learner.between_updates.crowded_cores import CrowdedCores
from millrace.learner.between_updates.run_files import RunFiles
from millrace.learner.rollouts.hub import Hub
from millrace.learner.rollouts.rollout_dealer import AcceptedRollout
from millrace.learner.run import OpenRun
from millrace.learner.run_folder.progress import Row
from millrace.protocol.arrays import Floats
from millrace.protocol.errors import RunError
from millrace.protocol.rollout import stack_rollouts

ADVICE = "try a lower learning_rate, or normalize_observations"


def train(run: OpenRun, workers: int, cores: CrowdedCores) -> str:
    """Train until the tally gives a reason to stop. Returns that reason.

    `workers` is the number of workers to wait for before the first rollout. `cores` watches the updates.

    If the run cannot continue, the state after the last complete update is saved, and then the error is raised. This happens
    if no worker is left, the environment raised too often, the user interrupted the run, a loss is not finite, or the user's
    code raised.
    """
    algorithm = run.parts.algorithm
    policy = run.parts.spec.policy
    hub = run.parts.hub
    tally = run.parts.tally
    files = run.files
    audience = run.audience
    evaluations = run.evaluations

    def pulse() -> None:
        """Called between gradient steps. If it raises, the update is undone."""
        hub.pulse()
        run.check_time()

    def publish(weights: tuple[Floats, Floats]) -> None:
        deal = tally.training_goes_on()
        state = tally.state
        attributes = audience.env_attributes()
        hub.publish(state.version, *weights, deal=deal, env_attributes=attributes, env_steps=state.env_steps)

    def tell(metrics: Row | None) -> None:
        """Report the metrics of an evaluation, if one has ended, and save its result."""
        if metrics is not None:
            audience.evaluated(metrics)
            files.save()

    def evaluate() -> None:
        """Make or begin the evaluation that is due. The previous one's result comes first, because it may end the run."""
        tell(evaluations.end_pending(audience.show_now))
        tell(evaluations.evaluate_when_due(audience.show_now))

    files.save()
    try:
        hub.wait_for(workers)
        audience.start()
        tell(evaluations.begin_again(audience.env_attributes(), audience.show_now))
        publish(acting_weights(algorithm, policy))
        if tally.evaluation_is_due():  # because the run was interrupted before this evaluation
            evaluate()
        while (reason := tally.stop_reason()) is None:
            arrived = hub.gather(audience.show_now)
            began_s = time.monotonic()
            with _whole_update(algorithm, hub, files, arrived):
                if not audience.gathered(arrived):
                    hub.not_used(arrived)
                    continue
                batch = stack_rollouts([one.rollout for one in arrived], [one.fresh for one in arrived])
                with cores.watching():
                    metrics = numbers(algorithm.update(batch, pulse), type(algorithm).__name__)
                weights = acting_weights(algorithm, policy)
                if not algorithm.is_finite():
                    raise RunError(f"learner: update {tally.state.version}: the weights are not finite after it; {ADVICE}")
            tally.count(batch)
            files.write_images(batch)
            publish(weights)
            tally.updated(time.monotonic() - began_s)
            audience.updated(metrics | tally.ratings())
            if tally.evaluation_is_due():
                files.save()  # before the evaluation, which may take a long time
                evaluate()
            else:
                files.save_if_due()
        tally.training_ended()
        files.save()
        tell(evaluations.end_pending(audience.show_now))
        if evaluations.conclude(audience.show_now):
            audience.evaluated()
        files.save_unless_saved()  # needed if the final policy turned out to be the best
    except BaseException as error:
        files.save_after_error(error)
        raise
    hub.drain(reason)
    files.confirm_saved()  # before the summary, because a run with a summary counts as finished
    audience.finish(reason)
    return reason


@contextmanager
def _whole_update(algorithm: Algorithm, hub: Hub, files: RunFiles, arrived: list[AcceptedRollout]) -> Iterator[None]:
    """A context for an update that uses the rollouts in `arrived`. If the body raises, the update is undone.

    A second or third Ctrl-C may end `remember` or `roll_back`. The rollouts wait again nevertheless, and an algorithm that
    is neither updated nor rolled back is not saved.
    """

    def roll_back() -> None:
        algorithm.roll_back()
        files.is_whole = True

    with ExitStack() as undo:
        undo.callback(hub.not_used, arrived)
        algorithm.remember()
        undo.callback(roll_back)
        files.is_whole = False
        yield
        files.is_whole = True
        undo.pop_all()
