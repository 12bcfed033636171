"""The layers of the tests: each test is in one, and each whole run of `make test` is a test that exists."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.layers import NO_PROCESS, OF_EXTRAS, OF_TOOLS, REAL_PROCESSES, SELECTED, Layer, layer_of
from tests.whole_runs import COMMANDS, FAULTS, FEATURES, WHOLE_RUNS

ROOT = Path(__file__).parents[1]


def functions(path: Path) -> set[str]:
    return {node.name for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)}


def test_a_whole_run_is_named_once_and_is_the_only_test_of_its_name() -> None:
    assert len(WHOLE_RUNS) == len(FAULTS) + len(COMMANDS) + len(FEATURES)
    for run in WHOLE_RUNS:
        file, _, name = run.partition("[")[0].partition("::")
        found = [path for path in (ROOT / "tests").rglob(file) if name in functions(path)]
        assert len(found) == 1, (run, found)


@pytest.mark.parametrize("place", [*NO_PROCESS, OF_EXTRAS, OF_TOOLS, REAL_PROCESSES])
def test_the_folders_of_the_rule_exist(place: str) -> None:
    assert (ROOT / place).exists()


@pytest.mark.parametrize(
    ("nodeid", "marks", "expected"),
    [
        ("tests/system/faults/test_failure_table.py::test_a_slow_learner_loses_no_worker", set(), Layer.TEST),
        ("tests/extras/any/test_failure_table.py::test_a_slow_learner_loses_no_worker", set(), Layer.TEST),
        ("tests/system/faults/test_failure_table.py::test_another", set(), Layer.REST),
        ("tests/extras/launchers/test_slurm.py::test_it", set(), Layer.REST),
        ("tests/protocol/test_row_law.py::test_it", set(), Layer.CHECK),
        ("tests/protocol/test_row_law.py::test_it", {"rest"}, Layer.REST),
        ("tests/protocol/test_row_law.py::test_it", {"process"}, Layer.TEST),
        ("tests/millrace/test_sb3.py::test_it", set(), Layer.TEST),
    ],
)
def test_the_rule(nodeid: str, marks: set[str], expected: Layer) -> None:
    assert layer_of(nodeid, marks) is expected


def test_what_make_test_leaves_out_make_test_rest_runs() -> None:
    assert SELECTED["test"] | SELECTED["rest"] == SELECTED["all"]
    assert not SELECTED["test"] & SELECTED["rest"]
    assert SELECTED["check"] < SELECTED["test"]
