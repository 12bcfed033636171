"""A user's own `learner.py`, `workers.py` or `protocol.py` that hides ours is named when `millrace` is imported."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from millrace.import_conflict import OLDEST, PACKAGES, VERSION

ROOT = Path(__file__).parents[2]


def python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Python in this folder, with millrace installed (on the path, behind the folder of the script)."""
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


def message(file: Path, name: str) -> str:
    return f"{file} is in the way: millrace has its own package {name}; rename yours, or run from another folder"


@pytest.mark.parametrize("name", PACKAGES)
def test_a_script_beside_such_a_file_is_told_its_name(tmp_path: Path, name: str) -> None:
    (tmp_path / f"{name}.py").touch()
    (tmp_path / "script.py").write_text("import millrace\n")
    done = python(tmp_path, "script.py")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith(f"ImportConflict: {message(tmp_path / f'{name}.py', name)}")


def test_a_package_is_in_the_way_too_and_the_error_is_an_import_error(tmp_path: Path) -> None:
    (tmp_path / "workers").mkdir()
    (tmp_path / "workers" / "__init__.py").touch()
    code = "try:\n    import millrace\nexcept ImportError as error:\n    print(error.name, error.path)"
    assert python(tmp_path, "-c", code).stdout == f"workers {tmp_path / 'workers'}\n"


def test_a_module_that_was_imported_before_is_in_the_way_too(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "protocol.py").touch()
    code = "import sys; sys.path.insert(0, 'mine'); import protocol; del sys.path[0]; import millrace"
    assert message(tmp_path / "mine" / "protocol.py", "protocol") in python(tmp_path, "-c", code).stderr


def test_python_m_millrace_says_one_line_without_a_traceback(tmp_path: Path) -> None:
    (tmp_path / "learner.py").touch()
    done = python(tmp_path, "-m", "millrace", "--help")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"millrace: {message(tmp_path / 'learner.py', 'learner')}\n"


@pytest.mark.parametrize(("name", "text"), [("gymnasium", '__version__ = "0.29.1"'), ("numpy", 'version = "1.26.4"')])
@pytest.mark.parametrize("command", ["train", "worker"])
def test_a_package_that_is_too_old_is_said_in_one_line(tmp_path: Path, name: str, text: str, command: str) -> None:
    version = text.split('"')[1]
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").touch()
    (tmp_path / name / OLDEST[name].file).write_text(f"{text}\n")
    done = python(tmp_path, "-m", "millrace", command, "CartPole-v1")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith(f"millrace: {name} {version} is too old")
    oldest = f"{name}>={'.'.join(map(str, OLDEST[name].version))}"
    assert f"pip install '{oldest}'" in done.stderr
    assert "'An older gymnasium' in docs/how-to/third_party_environments.md" in done.stderr
    assert "\n## An older gymnasium" in (ROOT / "docs" / "how-to" / "third_party_environments.md").read_text()
    assert f'"{oldest}",' in (ROOT / "pyproject.toml").read_text()


@pytest.mark.parametrize("name", OLDEST)
def test_the_version_of_an_installed_package_is_found(name: str) -> None:
    folder = Path(importlib.import_module(name).__file__ or "").parent
    found = VERSION.search((folder / OLDEST[name].file).read_text())
    assert found is not None
    assert importlib.import_module(name).__version__.startswith(found[1])


def test_the_installed_command_searches_the_current_folder_last(tmp_path: Path) -> None:
    for name in PACKAGES:
        (tmp_path / f"{name}.py").write_text("raise AssertionError\n")
    done = python(tmp_path, "-P", "-c", "from millrace.__main__ import command; command()", "presets")
    assert done.returncode == 0, done.stderr
    assert "millrace train" in done.stdout


def test_a_folder_without_python_files_is_not_in_the_way_and_the_check_imports_nothing(tmp_path: Path) -> None:
    (tmp_path / "learner").mkdir()
    (tmp_path / "learner" / "notes.txt").touch()
    code = "import sys, millrace; print(sys.modules.keys() & {'learner', 'workers', 'numpy', 'torch', 'zmq'})"
    assert python(tmp_path, "-c", code).stdout == "set()\n"
