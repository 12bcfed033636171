"""THE loop. Everything else is called from here; `hub.gather` is the only place that waits.

`max_lag` 0: publish, collect, learn, in turn. `max_lag` 1: while the learner learns from one batch, the tickets dealt before
let the workers collect the next. The loop is the same; the roster deals more or fewer tickets.
"""

from __future__ import annotations

import time

from learner.algorithms import Algorithm
from learner.journal import Journal
from learner.rollouts.hub import Hub
from learner.run_folder.run_folder import Interrupted
from protocol.errors import RunError
from protocol.rollout import stack


def train(algorithm: Algorithm, hub: Hub, journal: Journal, workers: int) -> str:
    """Learn until the journal says stop; why it stopped. `workers`: how many to wait for before the first rollout.

    When the run cannot go on (nobody left, the environment raised too often, the user interrupted), the state after the last
    whole update is saved, then the error goes on.
    """
    journal.save()
    if journal.stop_reason() is None:
        hub.wait_for(workers)
        hub.publish(journal.version, *algorithm.weights())
    while (reason := journal.stop_reason()) is None:
        try:
            arrived = hub.gather()
        except (RunError, Interrupted):
            journal.save()
            raise
        journal.gathered(arrived)
        began_s = time.monotonic()
        batch = stack([one.rollout for one in arrived])
        metrics = algorithm.update(batch, hub.pulse)
        hub.publish(journal.version + 1, *algorithm.weights())
        journal.updated(batch, metrics, time.monotonic() - began_s)
    journal.save()
    hub.drain(reason)
    journal.conclude()
    journal.finish(reason)
    return reason
