"""Which command runs a test: `make check`, `make test`, or only `make test-all`.

Rule: a test is in the first of these layers that holds it.

* `test`: a whole run that is named in `tests/whole_runs.py`.
* `rest`: other tests with real processes, tests of an extra or of the benchmarks, and tests that are marked `rest` because
  another test holds their fact in the default run, for another case.
* `check`: files that start no process (`NO_PROCESS`), but for a test that is marked `process` because it starts one.
* `test`: everything else.

`make test` runs `check` and `test`. `make test-rest` runs the others, and every property again with all its examples.
`make test-all` runs both.
"""

from __future__ import annotations

from collections.abc import Collection
from enum import StrEnum

from tests.whole_runs import WHOLE_RUNS


class Layer(StrEnum):
    """Part of the tests. The value is that of pytest's option `--layer`."""

    CHECK = "check"
    TEST = "test"
    REST = "rest"


SELECTED: dict[str, frozenset[Layer]] = {
    "check": frozenset({Layer.CHECK}),
    "test": frozenset({Layer.CHECK, Layer.TEST}),
    "rest": frozenset({Layer.REST}),
    "all": frozenset(Layer),
}
"""What each value of `--layer` runs."""

OF_EXTRAS = "tests/extras/"
REAL_PROCESSES = "tests/system/"
OF_TOOLS = "tests/benchmarks/"
"""Tests of what users do not install."""
NO_PROCESS = (
    "tests/learner/algorithms/bodies/test_networks.py",
    "tests/learner/algorithms/replay/",
    "tests/learner/algorithms/test_a2c.py",
    "tests/learner/algorithms/test_action_masks.py",
    "tests/learner/algorithms/test_running_statistics.py",
    "tests/learner/algorithms/test_out_of_order.py",
    "tests/learner/algorithms/test_ppo.py",
    "tests/learner/algorithms/test_reinforce.py",
    "tests/learner/algorithms/test_returns.py",
    "tests/learner/algorithms/test_vtrace.py",
    "tests/learner/config/",
    "tests/learner/members/test_endpoint.py",
    "tests/learner/members/test_failure_count.py",
    "tests/learner/rollouts/test_evaluation_dealer.py",
    "tests/learner/rollouts/test_evaluation_rows.py",
    "tests/learner/rollouts/test_hub.py",
    "tests/learner/rollouts/test_opponent_pool.py",
    "tests/learner/rollouts/test_status.py",
    "tests/learner/rollouts/test_ticket_coordinator.py",
    "tests/learner/rollouts/test_waiting.py",
    "tests/learner/rollouts/test_lag_statistics.py",
    "tests/learner/run_folder/test_checkpoint.py",
    "tests/learner/run_folder/test_run_folder.py",
    "tests/learner/run_folder/test_run_format.py",
    "tests/learner/run_folder/test_run_lock.py",
    "tests/learner/vector_env/test_order_coordinator.py",
    "tests/millrace/planning/",
    "tests/protocol/",
    "tests/test_layers.py",
    "tests/workers/collect/",
    "tests/workers/conversation/",
    "tests/workers/copies/",
    "tests/workers/evaluate/",
    "tests/workers/lanes/",
    "tests/workers/supervise/test_supervisor.py",
)
"""Folders and files whose tests start no process and take little time."""


def may_hold(path: str, selected: str) -> bool:
    """Whether a file may hold tests of a value of `--layer`. Others need not be imported. `path`: from the repository."""
    match selected:
        case "check":
            return path.startswith(NO_PROCESS)
        case "test":
            holds_whole_run = any(run.startswith(f"{path.rpartition('/')[2]}::") for run in WHOLE_RUNS)
            return holds_whole_run or not path.startswith((REAL_PROCESSES, OF_TOOLS, OF_EXTRAS))
        case _:
            return True


def short_name(nodeid: str) -> str:
    """File and name of a test, without its folder, as in the table of whole runs."""
    path, _, name = nodeid.partition("::")
    return f"{path.rpartition('/')[2]}::{name}"


def layer_of(nodeid: str, marks: Collection[str]) -> Layer:
    """The layer of a test with these marks."""
    if short_name(nodeid) in WHOLE_RUNS:
        return Layer.TEST
    path = nodeid.partition("::")[0]
    if "rest" in marks or path.startswith((REAL_PROCESSES, OF_TOOLS, OF_EXTRAS)):
        return Layer.REST
    return Layer.CHECK if path.startswith(NO_PROCESS) and "process" not in marks else Layer.TEST
