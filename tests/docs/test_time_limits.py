"""The table of docs/explanation/faults.md of how long a worker may take to leave has each constant, with its value."""

from __future__ import annotations

import re
from pathlib import Path

from millrace.extras.conformance.conform import STOP_CLIENT_WITHIN_S
from millrace.launch.vector import CLOSE_TIMEOUT_S
from millrace.launch.worker_pool import STOP_BEFORE_RUN_S
from millrace.learner.rollouts.hub import GOODBYE_IF_CUT_SHORT_S, GOODBYE_WITHIN_S
from millrace.learner.vector_env.step_hub import BUSY_S
from millrace.workers.program import LEAVE_ORPHANED_WITHIN_S
from millrace.workers.supervise.supervisor import FINISH_ROLLOUT_WITHIN_S, HANGS_AFTER_S, STOP_WITHIN_S
from millrace.workers.supervise.worker_process import CLOSE_ENVS_WITHIN_S, KILLED_WITHIN_S

FAULTS = Path(__file__).parents[2] / "docs/explanation/faults.md"
LIMITS = {
    "GOODBYE_WITHIN_S": GOODBYE_WITHIN_S,
    "GOODBYE_IF_CUT_SHORT_S": GOODBYE_IF_CUT_SHORT_S,
    "STOP_WITHIN_S": STOP_WITHIN_S,
    "STOP_BEFORE_RUN_S": STOP_BEFORE_RUN_S,
    "CLOSE_TIMEOUT_S": CLOSE_TIMEOUT_S,
    "BUSY_S": BUSY_S,
    "FINISH_ROLLOUT_WITHIN_S": FINISH_ROLLOUT_WITHIN_S,
    "HANGS_AFTER_S": HANGS_AFTER_S,
    "CLOSE_ENVS_WITHIN_S": CLOSE_ENVS_WITHIN_S,
    "LEAVE_ORPHANED_WITHIN_S": LEAVE_ORPHANED_WITHIN_S,
    "KILLED_WITHIN_S": KILLED_WITHIN_S,
    "STOP_CLIENT_WITHIN_S": STOP_CLIENT_WITHIN_S,
}


def test_the_table_has_each_limit_with_its_value() -> None:
    stated = re.findall(r"`([A-Z_]+_S)`, ([0-9.]+) s\b", FAULTS.read_text())
    assert {name: float(value) for name, value in stated} == LIMITS
