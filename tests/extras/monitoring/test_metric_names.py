"""The catalogue of metrics has what the core logs."""

from __future__ import annotations

from millrace.extras.monitoring.metric_names import METRICS
from millrace.learner.run_folder.results import METRICS_BESIDE_FACTS
from millrace.protocol.specs import SCORE


def test_every_other_metric_beside_the_facts_is_known() -> None:
    logged = [name.partition("/") for group in METRICS.values() for name in group]
    beside = {name for where, _, name in logged if where in ("rollout", "eval") and "NAME" not in name and name != SCORE}
    assert beside == METRICS_BESIDE_FACTS
