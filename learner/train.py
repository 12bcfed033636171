"""The training loop. Everything else is called from here; `service.gather` is the only place that waits for rollouts.

An evaluation belongs to one version: it comes after that version's checkpoint, and before the next rollouts are collected.

With `max_lag` 0 the learner publishes weights, gathers rollouts and learns, one after the other. With `max_lag` 1 the
workers already collect the next rollouts while the learner learns. The loop is the same: only the number of tickets differs.

Rule: whatever ends the run, the state after the last whole update is saved first, and the run fails if the disk refuses it.
An update is taken back if it raises, or makes weights that are not finite or that no worker could act with, or returns
metrics that are no numbers; so is one whose rollouts a callback does not accept.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from learner.algorithms import Algorithm
from learner.algorithms.algorithm import numbers
from learner.rollout_service.service import RolloutService
from learner.rollouts.lanes import AcceptedRollout
from learner.run_recorder import RunRecorder
from protocol.arrays import Floats
from protocol.errors import RunError
from protocol.rollout import stack_rollouts

ADVICE = "try a lower learning_rate, or normalize_observations"


def train(
    algorithm: Algorithm,
    service: RolloutService,
    recorder: RunRecorder,
    workers: int,
    check_time: Callable[[], None] = lambda: None,
) -> str:
    """Train until `recorder` gives a reason to stop. Returns that reason.

    `workers`: number of workers to wait for before the first rollout. If the run cannot go on (no worker is left, the
    environment raised too often, the user interrupted the run, a loss is not finite, the user's code raised), the state
    after the last whole update is saved. Then the error is raised. `check_time` is called between gradient steps: what it
    raises takes the update back.
    """

    def pulse() -> None:
        service.pulse()
        check_time()

    def publish(weights: tuple[Floats, Floats]) -> None:
        attributes = recorder.env_attributes()
        service.publish(recorder.version, *weights, deal=recorder.training_goes_on(), env_attributes=attributes)

    recorder.save()
    try:
        service.wait_for_workers(workers)
        recorder.start()
        publish(recorder.weights())
        recorder.evaluate_if_due()
        while (reason := recorder.stop_reason()) is None:
            arrived = service.gather(recorder.show_now)
            began_s = time.monotonic()
            with _whole_update(algorithm, service, arrived):
                if not recorder.gathered(arrived):
                    service.not_used(arrived)
                    continue
                batch = stack_rollouts([one.rollout for one in arrived], [one.fresh for one in arrived])
                metrics = numbers(algorithm.update(batch, pulse), type(algorithm).__name__)
                weights = recorder.weights()
                if not algorithm.is_finite():
                    raise RunError(f"learner: update {recorder.version}: the weights are not finite after it; {ADVICE}")
            recorder.count(batch)
            publish(weights)
            recorder.updated(metrics, time.monotonic() - began_s)
        recorder.save()
        recorder.conclude()
        recorder.save_unless_saved()  # the final policy may be the best
    except BaseException as error:
        recorder.save_after_error(error)
        raise
    service.drain(reason)
    recorder.confirm_saved()  # before the summary: with one, a run counts as finished
    recorder.finish(reason)
    return reason


@contextmanager
def _whole_update(algorithm: Algorithm, service: RolloutService, arrived: list[AcceptedRollout]) -> Iterator[None]:
    """An update of the rollouts that have arrived. If the body raises, it is taken back."""
    algorithm.remember()
    try:
        yield
    except BaseException:
        algorithm.roll_back()
        service.not_used(arrived)
        raise
