"""`import millrace` refuses a package that is too old, and a module of the user's own is never taken for one of ours."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from millrace.oldest_versions import OLDEST, VERSION

ROOT = Path(__file__).parents[2]


def python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Python in this folder, with millrace installed (on the path, behind the folder of the script)."""
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


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


def test_modules_of_the_user_s_are_in_nobody_s_way(tmp_path: Path) -> None:
    """Modules of millrace have these names, and none of them is taken from here."""
    for name in ("learner", "workers", "protocol", "testing", "runs"):
        (tmp_path / f"{name}.py").write_text("raise AssertionError\n")
    (tmp_path / "script.py").write_text("import millrace; print(millrace.testing.__name__)\n")
    assert python(tmp_path, "script.py").stdout == "millrace.testing\n"
    done = python(tmp_path, "-m", "millrace", "presets")
    assert (done.returncode, done.stderr) == (0, "")


def test_the_check_imports_nothing(tmp_path: Path) -> None:
    code = "import sys, millrace; print(sys.modules.keys() & {'gymnasium', 'numpy', 'torch', 'zmq'})"
    assert python(tmp_path, "-c", code).stdout == "set()\n"
