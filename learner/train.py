"""The training loop. Everything else is called from here; `service.gather` is the only place that waits for rollouts.

With `max_lag` 0 the learner publishes weights, gathers rollouts and learns, one after the other. With `max_lag` 1 the
workers already collect the next rollouts while the learner learns. The loop is the same: only the number of tickets differs.
"""

from __future__ import annotations

import time

from learner.algorithms import Algorithm
from learner.journal import Journal
from learner.run_folder.run_folder import Interrupted
from learner.service import RolloutService
from protocol.errors import RunError
from protocol.rollout import stack_rollouts


def train(algorithm: Algorithm, service: RolloutService, journal: Journal, workers: int) -> str:
    """Learn until the journal gives a reason to stop; return that reason.

    `workers`: how many to wait for before the first rollout. When the run cannot go on (no worker is left, the environment
    raised too often, the user interrupted it), the state after the last whole update is saved before the error is raised.
    """
    journal.save()
    if journal.stop_reason() is None:
        service.wait_for_workers(workers)
        service.publish(journal.version, *algorithm.weights())
    while (reason := journal.stop_reason()) is None:
        try:
            arrived = service.gather()
        except (RunError, Interrupted):
            journal.save()
            raise
        journal.gathered(arrived)
        began_s = time.monotonic()
        batch = stack_rollouts([one.rollout for one in arrived])
        metrics = algorithm.update(batch, service.pulse)
        service.publish(journal.version + 1, *algorithm.weights())
        journal.updated(batch, metrics, time.monotonic() - began_s)
    journal.save()
    service.drain(reason)
    journal.conclude()
    journal.finish(reason)
    return reason
