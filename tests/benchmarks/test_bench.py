"""`millrace bench`: every benchmark that it lists exists, and errors are one line."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from benchmarks.memory import Tree
from benchmarks.program import BENCHMARKS, overview
from benchmarks.writing import bars, circumstances
from millrace.cli.main import main

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", sorted(BENCHMARKS))
def test_each_benchmark_is_a_module_with_a_main(name: str) -> None:
    tree = ast.parse((ROOT / "benchmarks" / f"{BENCHMARKS[name].module}.py").read_text())
    assert any(isinstance(node, ast.FunctionDef) and node.name == "main" for node in tree.body)
    assert isinstance(tree.body[-1], ast.If)  # __name__ == "__main__"
    assert f"bench {name} " in overview()


def test_an_unknown_benchmark_is_refused(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "speed"]) == 2
    assert "bench speed: expected one of collect, vector" in capfd.readouterr().err


def test_where_they_are_not_installed_a_line_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("millrace.cli.bench.INSTALLED_IN", tmp_path)
    monkeypatch.chdir(tmp_path)
    assert main(["bench"]) == 2
    assert capsys.readouterr().err.splitlines() == [
        "millrace: bench: not part of the installed package; run it in a clone of the repository (make bench)"
    ]
    with pytest.raises(SystemExit) as stop:
        main(["bench", "--help"])
    assert not stop.value.code
    assert capsys.readouterr().out.startswith("usage: millrace bench")


def test_an_installed_millrace_finds_them_in_the_clone_that_is_the_current_folder(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("millrace.cli.bench.INSTALLED_IN", tmp_path)
    monkeypatch.chdir(ROOT)
    assert main(["bench", "--help"]) == 0
    assert capfd.readouterr().out == f"{overview()}\n"


def test_what_is_written_tells_where_it_came_from() -> None:
    found = circumstances()
    assert found["cores"]
    assert "torch" in str(found["versions"])
    assert found["commit"]


def test_bars() -> None:
    rows: list[dict[str, object]] = [{"copies": 8, "who": "a", "rate": 1}, {"copies": 64, "who": "a", "rate": 2}]
    assert bars(rows, "who", "rate", 64) == {"a": 2.0}


def test_memory_of_a_process_that_has_ended_is_nothing() -> None:
    tree = Tree()
    tree.measure(2**22 + 1)  # no such process
    assert (tree.own, tree.processes) == (0.0, 0)
