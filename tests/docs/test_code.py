"""Every block of Python in README.md and docs/ runs: the blocks of a page in their order, as one program.

Rule: a block whose first line is `# NAME.py` is also the file of that name, for the blocks after it. A block that needs an
extra that is not installed ends the page with a skip. A block below the comment `<!-- fragment -->` is not run.

Each page is a program of its own in a folder of its own, and has a deadline. Pages that take seconds run in `make site`.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.docs import pages
from tests.docs.surroundings import missing_extra, variables
from website.pages import ROOT

DEADLINE_S = 100
FILE_NAME = re.compile(r"^# (\w+\.py)\b")
FRAGMENT = "fragment"
QUICK = {
    "docs/explanation/rows.md", "docs/how-to/simulators.md",
    "docs/tutorial/your_environment.md",
}  # fmt: skip
"""Pages that take a second or two. They run in `make test`, too."""


def python_blocks(text: str) -> list[pages.Block]:
    found = [block for block in pages.blocks(text) if block.language.split(" ")[0] == "python"]
    return [block for block in found if not block.about.startswith(FRAGMENT)]


def program(text: str) -> str:
    """The blocks of a page as one program, each at its own lines, so that a traceback names the line of the page."""
    lines = [""] * (text.count("\n") + 1)
    for block in python_blocks(text):
        for number, line in enumerate(block.text.split("\n"), block.line - 1):
            lines[number] = line
    return "\n".join(lines) + "\n"


def run_page(path: str, text: str, folder: Path) -> str:
    """Run the blocks of a page in this folder. Returns what went wrong, or "needs EXTRA", or nothing."""
    (folder / "page.py").write_text(program(text), encoding="utf-8")
    for block in python_blocks(text):
        if name := FILE_NAME.match(block.text):
            (folder / name[1]).write_text(block.text + "\n", encoding="utf-8")
    python_path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]).strip(os.pathsep)
    done = subprocess.run(
        [sys.executable, "page.py"],
        cwd=folder,
        env={**os.environ, **variables(folder), "PYTHONPATH": python_path},
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    if done.returncode == 0:
        return ""
    if extra := missing_extra(done.stderr):
        return f"needs {extra}"
    return f"{path}: exit code {done.returncode}\n{done.stderr.replace(str(folder / 'page.py'), path)}"


def with_blocks() -> list[Any]:
    """The pages that have blocks of Python; those that take long are marked."""
    return [
        pytest.param(path, marks=() if path in QUICK else pytest.mark.docs, id=path)
        for path, text in pages.manuals().items()
        if python_blocks(text)
    ]


@pytest.mark.parametrize("path", with_blocks())
def test_its_blocks_run(path: str, tmp_path: Path) -> None:
    complaint = run_page(path, pages.manuals()[path], tmp_path)
    if complaint.startswith("needs "):
        pytest.skip(f"{path} {complaint}")
    assert not complaint, complaint


@pytest.mark.parametrize("path", pages.manuals())
def test_its_blocks_are_python(path: str) -> None:
    """Also in the pages that `make test` does not run."""
    for block in python_blocks(pages.manuals()[path]):
        compile(block.text, f"{path}:{block.line}", "exec")


def test_a_block_that_raises_is_found(tmp_path: Path) -> None:
    text = "# Page\n\n```python\nx = 1\n```\n\ntext\n\n```python\n\nassert x == 2\n```\n"
    complaint = run_page("docs/page.md", text, tmp_path)
    assert 'File "docs/page.md", line 11' in complaint or 'docs/page.md", line 11' in complaint
    assert "AssertionError" in complaint


def test_blocks_share_names_and_files(tmp_path: Path) -> None:
    text = (
        "```python\n# own.py\nx = 1\n```\n```python\nimport own\nassert own.x == x\n```\n"
        "<!-- fragment: why -->\n```python\nno_such_name\n```\n```text\nnothing\n```\n"
        '=== "In a tab"\n\n    ```python\n    if x:\n        x = 2\n    ```\n'
    )
    assert run_page("docs/page.md", text, tmp_path) == ""


def test_an_extra_that_is_not_installed_skips_the_page(tmp_path: Path) -> None:
    assert run_page("page.md", "```python\nimport mujoco.no_such_part\n```\n", tmp_path) == "needs mujoco"
    assert missing_extra("    ModuleNotFoundError: No module named 'optuna'\n") == "optuna", "as doctest shows it"
    assert missing_extra("    ValueError: No module named 'optuna'\n") == ""
    assert "no_such_module" in run_page("page.md", "```python\nimport no_such_module\n```\n", tmp_path)
