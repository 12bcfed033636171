"""The rooms and their doors: who may import whom, and what stands nowhere but in its one place."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = ("protocol", "workers", "learner", "millrace")
FORBIDDEN = {
    "protocol": {"workers", "learner", "millrace"},
    "workers": {"learner", "millrace"},
    "learner": {"workers", "millrace"},
    "millrace": set[str](),
}
MAY_PRINT = {"millrace/cli/main.py", "millrace/terminal.py"}
MAY_UNPICKLE = {"protocol/env_spec.py"}
MAY_IMPORT_TORCH = {f"protocol/policy/{name}.py" for name in ("encoder", "networks", "torch_distributions", "torch_policy")}


def sources(*folders: str) -> list[str]:
    return sorted(str(path.relative_to(ROOT)) for folder in folders for path in (ROOT / folder).rglob("*.py"))


@cache
def tree(source: str) -> ast.Module:
    return ast.parse((ROOT / source).read_text(), source)


def imported(source: str) -> set[str]:
    """Top-level names of all that a file imports, wherever in the file it does so."""
    found = set()
    for node in ast.walk(tree(source)):
        match node:
            case ast.Import(names=names):
                found |= {alias.name.partition(".")[0] for alias in names}
            case ast.ImportFrom(module=str(module), level=0):
                found.add(module.partition(".")[0])
            case ast.ImportFrom():
                raise AssertionError(f"{source}:{node.lineno} imports relatively")
    return found


def calls(source: str, name: str) -> list[str]:
    """Where a function of this name is called, by itself or as an attribute of something."""
    found = []
    for node in ast.walk(tree(source)):
        match node:
            case ast.Call(func=ast.Name(id=called)) if called == name:
                found.append(f"{source}:{node.lineno}")
            case ast.Call(func=ast.Attribute(attr=called, value=ast.Name(id=owner))) if called == name:
                found.append(f"{source}:{node.lineno} of {owner}")
    return found


@pytest.mark.parametrize("room", ROOMS)
def test_the_arrows_point_one_way(room: str) -> None:
    assert sources(room)
    for source in sources(room):
        assert not imported(source) & FORBIDDEN[room], source


def test_torch_stays_with_the_learner() -> None:
    for source in sources(*ROOMS):
        if not source.startswith("learner/") and source not in MAY_IMPORT_TORCH:
            assert "torch" not in imported(source), source


def test_nothing_is_pickled_but_in_the_one_guarded_place() -> None:
    for source in sources(*ROOMS):
        if source not in MAY_UNPICKLE:
            assert not imported(source) & {"pickle", "cloudpickle", "dill", "shelve", "marshal", "joblib"}, source
        for node in ast.walk(tree(source)):
            match node:
                case ast.Call(func=ast.Attribute(attr="load", value=ast.Name(id="torch"))):
                    flags = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
                    assert flags.get("weights_only") == "True", f"{source}:{node.lineno}"
                case ast.keyword(arg="allow_pickle"):
                    assert ast.unparse(node.value) == "False", f"{source}:{node.lineno}"


def test_only_the_command_line_prints() -> None:
    for source in sources(*ROOMS):
        if source not in MAY_PRINT:
            assert not [where for where in calls(source, "print") if " of " not in where]


def test_tests_do_not_sleep() -> None:
    for source in sources("tests"):
        if not source.startswith("tests/system/"):
            assert not calls(source, "sleep")


def test_no_folder_is_a_drawer_for_everything() -> None:
    for source in sources(*ROOMS, "tests"):
        assert not set(Path(source).parts) & {"utils", "common", "misc", "helpers"}, source


def test_every_file_says_first_what_it_holds() -> None:
    for source in sources(*ROOMS, "tests"):
        assert ast.get_docstring(tree(source)) or not (ROOT / source).read_text().strip(), source


@pytest.mark.parametrize(
    "module",
    [
        "workers.__main__",
        "millrace.cli.main",
        "learner.algorithms",
        "learner.config.command_line",
        "learner.report.learning_curves",
        "learner.evaluate",
    ],
)
def test_what_must_start_quickly_imports_no_torch(module: str) -> None:
    asks = f"import sys, {module}; assert not sys.modules.keys() & {{'torch', 'matplotlib', 'tensorboard'}}"
    done = subprocess.run([sys.executable, "-c", asks], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
